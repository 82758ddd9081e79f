"""The command line: one entry point, `hdbridge`; each command is one file and a thin layer over the library.

Exit status: 0 done; 1 an error in hdbridge itself; 2 bad input (nothing was written, nothing moved); 3 the
bus; 4 the drive; 5 the supervision stopped the axis; 130 Ctrl-C (the axis was stopped, the record kept).
"""

from __future__ import annotations

import os
import sys
from typing import Annotated, Final

import typer

from hdbridge import __version__
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

PANELS: Final = {
    "Without hardware": (demo, simulate),
    "Before the first move": (check, scan, doctor, latency),
    "The model of an axis": (calibrate, fit, report, diagnose, improve, model),
    "Positioning": (step,),
}
"""Every command, under the heading that `hdbridge --help` gives it."""

app = typer.Typer(
    name="hdbridge",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog=(
        "Exit status: 0 done, 2 bad input (nothing moved, nothing written), 3 bus, 4 drive, "
        "5 stopped by supervision, 130 Ctrl-C (axis stopped, record kept)."
    ),
)
for _panel, _commands in PANELS.items():
    for _command in _commands:
        _command.register(app)
        # A module registers a command or a group of them; the heading is given here, where the others are.
        _registered = app.registered_groups[-1] if _command is model else app.registered_commands[-1]
        _registered.rich_help_panel = _panel


def _tell_version(asked: bool) -> None:
    if asked:
        print(f"hdbridge {__version__}")
        raise typer.Exit


@app.callback()
def _hdbridge(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_tell_version)
    ] = False,
) -> None:
    """Make a harmonic-drive axis point where it is told: a CANopen master that knows its gear.

    To begin: `hdbridge demo`, then docs/tutorial.md.
    """


def main() -> None:
    """Run the command line; errors raised on purpose are one line and their exit status."""
    try:
        app()
    except HdbridgeError as error:
        print(f"hdbridge: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except BrokenPipeError:  # `hdbridge ... | head`: who reads has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


if __name__ == "__main__":
    main()
