"""Command line: one entry point, `hdbridge`; a command is a thin layer over the library.

Exit status: 0 done; 1 an error in hdbridge itself; 2 bad input (nothing was written, nothing moved); 3 the
bus; 4 the drive; 5 the supervision stopped the axis; 6 a result could not be written (the measured figures
are printed); 7 the daemon cannot be reached, or refuses this client now; 130 Ctrl-C (the axis was stopped,
the record kept).
"""

import codecs
import errno
import io
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_group

from hdbridge import __version__
from hdbridge.cli import eventlog, usage
from hdbridge.errors import HdbridgeError, InputError, OutputError

PANELS: Final = {
    "Without hardware": ("demo", "simulate"),
    "Before the first move": ("setup", "new", "check", "scan", "doctor", "conform", "sdo", "latency"),
    "The model of an axis": (
        "calibrate", "measure", "fit", "report", "diagnose", "improve", "twin", "model",
    ),
    "Many joints": ("fleet",),
    "Day and night": ("run", "ctl", "gateway", "record", "install-service"),
    "Positioning": ("move", "reset", "home", "step", "motion"),
}  # fmt: skip
"""All commands under their headings in `hdbridge --help`.

A command is imported only for help or to be run, and it imports its dependencies when it runs."""
_GROUPS: Final = {
    "sdo": "Read or write an object of the drive by SDO, typed by its EDS.",
    "model": "Manage the models of an axis: the active one, a pending one, and all earlier ones.",
    "fleet": "Diagnose recordings of many joints on Dask; report the joints to inspect first.",
    "ctl": "Control a running daemon: state, motion, stop, compensation.",
    "gateway": "The axes of a machine as drives of another master.",
    "record": "Flight recordings and bus logs: list, mend, and make records for fit and diagnose.",
}
"""Summaries of the groups of commands."""
_MODULES: Final = {
    "bringup": ("new", "check", "scan", "doctor", "latency"),
    "calibration": ("calibrate", "measure", "fit", "report"),
    "diagnosis": ("diagnose", "improve"),
    "drive": ("reset", "home", "sdo"),
    "machine": ("run", "gateway", "simulate", "install-service"),
    "positioning": ("demo", "move", "step", "motion"),
    "recordings": ("record",),
}
"""Modules that define several commands; any other command is in the module of the same name.

A module's ``COMMANDS`` contains the function of each command, or the functions of a group of commands."""
SIGNED: Final = {"move", "sdo set", "ctl move", "ctl jog", "ctl queue", "ctl set"}
"""Commands with a number that may be negative and would otherwise be parsed as an option."""


def load(name: str) -> typer.Typer:
    """Imports a command; returns an app with only that command, which checks its outputs before it runs."""
    place = next((module for module, commands in _MODULES.items() if name in commands), name)
    command = import_module(f"{__name__}.{place}").COMMANDS[name]
    guarded = import_module(f"{__name__}.options").guarded
    loaded = typer.Typer(rich_markup_mode="markdown")

    def add(group: typer.Typer, called: str, path: str, function: Callable[..., None]) -> None:
        settings = {"ignore_unknown_options": True} if path in SIGNED else None
        group.command(called, context_settings=settings)(guarded(function))

    if callable(command):
        add(loaded, name, name, command)
        return loaded
    group = typer.Typer(help=_GROUPS[name], no_args_is_help=True, rich_markup_mode="markdown")
    for each, function in command.items():
        add(group, each, f"{name} {each}", function)
    loaded.add_typer(group, name=name)
    return loaded


class _Overview(TyperGroup):
    """Command group that replaces placeholders with the real commands."""

    def get_command(self, ctx: Any, name: str) -> Any:
        placeholder: Any = super().get_command(ctx, name)
        return placeholder and _built(name, placeholder.rich_help_panel)


@cache
def _built(name: str, panel: str) -> Any:
    """Builds a command with its options; cached, because a process may run the command several times."""
    command = usage.strict(get_group(load(name)).commands[name])
    command.rich_help_panel = panel
    return command


app = typer.Typer(
    name="hdbridge",
    cls=_Overview,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog=(
        "Exit status: 0 done, 2 bad input (nothing moved, nothing written), 3 bus, 4 drive, "
        "5 stopped by supervision, 6 a result could not be written (a full disk; the figures are printed), "
        "7 the daemon cannot be reached or refuses the request, 130 Ctrl-C (axis stopped, record kept)."
    ),
)


for _panel, _names in PANELS.items():
    for _name in _names:
        app.command(_name, rich_help_panel=_panel)(lambda: None)


def _print_version(asked: bool) -> None:
    if asked:
        print(f"hdbridge {__version__}")
        raise typer.Exit


@app.callback()
def _hdbridge(
    version: Annotated[  # noqa: ARG001 - its callback has printed it by then
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version)
    ] = False,
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose", "-v", count=True, help="Report actions on the bus; -vv: every SDO transfer."
        ),
    ] = 0,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log", metavar="FILE", help="Append everything that -vv reports, one JSON object per line."
        ),
    ] = None,
) -> None:
    """Position a harmonic-drive axis accurately: a CANopen master that compensates for its gear.

    To begin: `hdbridge demo`, then docs/tutorial.md.
    """
    if verbose or log is not None:
        eventlog.begin(verbose, log)
        eventlog.write("command", arguments=sys.argv[1:], version=__version__)


_HANDLER: Final = "hdbridge.plain"
"""Name of the codec error handler that replaces characters outside the encoding of the output."""
_PLAIN: Final = str.maketrans(
    {"σ": "s", "±": "~", "→": ">", "°": " ", "²": "2", "µ": "u", "–": "-", "…": "~"}
)
"""Single-character replacements, so that a table stays aligned."""


def _replaced(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end].translate(_PLAIN)
    return text.encode("ascii", errors="replace").decode("ascii"), error.end


codecs.register_error(_HANDLER, _replaced)


class _Remarks(io.FileIO):
    """Standard error; discards what cannot be written, because no remark is worth a measurement."""

    def write(self, data: Any) -> int:
        """Writes the data, or discards them (full disk)."""
        with suppress(OSError):
            return super().write(data)
        return len(data)


def _prepare_streams() -> None:
    """Makes both standard streams usable, whatever their state and encoding."""
    for name in ("stdout", "stderr"):  # closed by the parent process: output is discarded
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)
    if sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        remarks = io.BufferedWriter(_Remarks(sys.stderr.fileno(), "w", closefd=False))
        sys.stderr = io.TextIOWrapper(remarks, sys.stderr.encoding, _HANDLER, line_buffering=True)


def main() -> None:
    """Runs the command line; an error of hdbridge becomes one line and its exit status."""
    _prepare_streams()
    try:
        status = app(prog_name="hdbridge", standalone_mode=False)
        sys.stdout.flush()
    except HdbridgeError as error:
        print(f"hdbridge: {error}", file=sys.stderr)
        status = error.exit_status
    except usage.UsageError as error:
        if usage.asks_for_help(error):
            print(error.format_message())
        else:
            print(f"hdbridge: {usage.refusal(error)}", file=sys.stderr)
        status = InputError.exit_status
    except typer.Abort:
        status = 130
    except (BrokenPipeError, SystemExit):  # `hdbridge ... | head`, which typer turns into an exit
        _close_output()
        status = 0
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _close_output()
        print(f"hdbridge: the standard output cannot be written: {error.strerror}", file=sys.stderr)
        status = OutputError.exit_status
    status = status if isinstance(status, int) else 0
    sys.exit(eventlog.end(status))


def _close_output() -> None:
    """Discards the output buffer, which cannot be written, so that exit does not fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
