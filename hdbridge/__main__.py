"""The entry of the command line: ``hdbridge``, or ``python -m hdbridge``."""

import sys


def main() -> None:
    """Run it; Ctrl-C while it still loads is no error in hdbridge."""
    try:
        from hdbridge.cli import main as run  # noqa: PLC0415 - loading takes a second, in which Ctrl-C may come

        run()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
