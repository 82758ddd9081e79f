"""The command line: one entry point, `hdbridge`; each command is one file and a thin layer over the library.

Exit status: 0 done; 1 an error in hdbridge itself; 2 bad input (nothing was written, nothing moved); 3 the
bus; 4 the drive; 5 the supervision stopped the axis; 130 Ctrl-C (the axis was stopped, the record kept).
"""

from __future__ import annotations

import sys

import typer

from hdbridge.cli import (
    calibrate,
    check,
    demo,
    diagnose,
    doctor,
    fit,
    improve,
    latency,
    model,
    report,
    scan,
    simulate,
    step,
)
from hdbridge.errors import HdbridgeError

app = typer.Typer(
    name="hdbridge",
    help="Make a harmonic-drive axis point where it is told: a CANopen master that knows its gear.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog=(
        "Exit status: 0 done, 2 bad input (nothing moved, nothing written), 3 bus, 4 drive, "
        "5 stopped by supervision, 130 Ctrl-C (axis stopped, record kept)."
    ),
)
for command in (
    demo,
    check,
    scan,
    doctor,
    simulate,
    step,
    calibrate,
    fit,
    diagnose,
    improve,
    model,
    report,
    latency,
):
    command.register(app)


def main() -> None:
    """Run the command line; errors raised on purpose are one line and their exit status."""
    try:
        app()
    except HdbridgeError as error:
        print(f"hdbridge: {error}", file=sys.stderr)
        sys.exit(error.exit_status)


if __name__ == "__main__":
    main()
