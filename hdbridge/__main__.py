"""Entry point of the command line: ``hdbridge``, or ``python -m hdbridge``."""

import os
import sys

# Threads in linear algebra cost more than they gain, because the matrices are small. Fits and diagnoses use
# one thread in any program (`on_one_thread`); these variables extend that to the rest of the command.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")


def main() -> None:
    """Runs the command line; Ctrl-C while hdbridge is loading does not print a traceback."""
    try:
        from hdbridge.cli import main as run  # noqa: PLC0415 - loading takes a second, and Ctrl-C may come

        run()
    except (KeyboardInterrupt, RuntimeError) as error:
        # Python 3.11 turns an interrupt during the creation of a class into a RuntimeError.
        if not isinstance(error.__cause__ or error, KeyboardInterrupt):
            raise
        sys.exit(130)


if __name__ == "__main__":
    main()
