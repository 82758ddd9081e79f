"""The entry of the command line: ``hdbridge``, or ``python -m hdbridge``."""

import os
import sys

# The matrices here are small: threads of the linear algebra cost more than they give, on a busy machine
# several times the work. Whoever wants them sets these variables.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")


def main() -> None:
    """Run it; Ctrl-C while it still loads is no error in hdbridge."""
    try:
        from hdbridge.cli import main as run  # noqa: PLC0415 - loading takes a second, in which Ctrl-C may come

        run()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
