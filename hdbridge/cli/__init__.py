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
    "Without hardware": {
        "demo": "Step a simulated axis 240 times each way under four compensation schemes.",
        "simulate": "Run the simulated drive of a profile on its bus, in real time, until Ctrl-C.",
    },
    "Before the first move": {
        "setup": "Set up an axis in one sitting: bus, axis file, checks, calibration, model, first move.",
        "new": "Make the folder of an axis: a copy of a bundled profile, or from the data of a drive on the "
        "bus.",
        "check": "Check the files of an axis or of a machine; report their meaning, or the errors with "
        "their location.",
        "scan": "List the nodes on a CAN bus: type, identity, state, and lines for an axis file.",
        "doctor": "Check an axis before its first long motion: files, bus, drive, encoders, directions, "
        "ratio, stops.",
        "conform": "Check a node against CiA 301 and CiA 402: NMT, SDO, PDO, SYNC, EMCY, its EDS, the drive "
        "profile.",
        "sdo": "Read or write an object of the drive by SDO, typed by its EDS.",
        "latency": "Measure timer latency; print its histogram and the shortest cycle that this computer "
        "sustains.",
    },
    "The model of an axis": {
        "calibrate": "Measure an axis by a plan, fit its model, test it on the axis, and keep it as pending.",
        "measure": "Move an axis by a plan and keep the recording, for diagnose, twin and fit.",
        "fit": "Fit a model to recordings; report parameter intervals and what the data cannot determine.",
        "report": "Fit a recording again and report the result; nothing moves.",
        "diagnose": "Compare records with a model; name the causes that it lacks, and those that are not "
        "separable.",
        "improve": "Diagnose the active model, extend it, step with both, and keep the better one as "
        "pending.",
        "twin": "Fit the simulated drive to recordings of an axis; report its errors, and keep the twin as "
        "pending.",
        "model": "Manage the models of an axis: the active one, a pending one, and all earlier ones.",
    },
    "Many joints": {
        "fleet": "Diagnose recordings of many joints on Dask; report the joints to inspect first."
    },
    "Day and night": {
        "run": "Run the daemon: control the drives of a machine and accept load angles from clients.",
        "ctl": "Control a running daemon: state, motion, stop, compensation.",
        "gateway": "The axes of a machine as drives of another master.",
        "record": "Flight recordings and bus logs: list, mend, and make records for fit and diagnose.",
        "install-service": "Show, write or remove the systemd files that run a machine's daemon from the "
        "start of the computer.",
    },
    "Positioning": {
        "move": "Move the load to one angle or to several, compensated by the active model, and hold the "
        "last.",
        "reset": "Reset a fault of the drive once its cause is gone; power stays off.",
        "home": "Home the drive by one of its own methods (CiA 402, mode HM); print the position of the "
        "axis.",
        "step": "Step the axis both ways under each compensation scheme; print the results at "
        "the load encoder.",
        "motion": "Run the axis at several speeds; print the ripple of the load without and with "
        "compensation.",
    },
}
"""All commands under their headings in `hdbridge --help`, with their summaries there.

A command is imported only for its own help or to be run, and it imports its dependencies when it runs."""
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
    summary = next(commands[name] for commands in PANELS.values() if name in commands)
    group = typer.Typer(help=summary, no_args_is_help=True, rich_markup_mode="markdown")
    for each, function in command.items():
        add(group, each, f"{name} {each}", function)
    loaded.add_typer(group, name=name)
    return loaded


class _LoadedToRun(TyperGroup):
    """Command group that replaces the placeholders of the overview with the real commands."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, _, rest = super().resolve_command(ctx, args)
        assert name is not None
        return name, _built(name), rest


@cache
def _built(name: str) -> Any:
    """Builds a command with its options; cached, because a process may run the command several times."""
    return usage.strict(get_group(load(name)).commands[name])


app = typer.Typer(
    name="hdbridge",
    cls=_LoadedToRun,
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


def _in_overview() -> None:
    """Placeholder for a command that has not been imported."""


for _panel, _commands in PANELS.items():
    for _name, _summary in _commands.items():
        app.command(_name, help=_summary, rich_help_panel=_panel)(_in_overview)


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
