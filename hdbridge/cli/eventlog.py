"""Event log of hdbridge's actions on the bus: on standard error, or as lines of JSON.

The library reports events through `logging`, with a name and a dictionary of facts. Nothing is logged within
the control cycle; its events are logged once the axis is at rest.
"""

import logging
from pathlib import Path

from hdbridge.errors import InputError, OutputError
from hdbridge.files.logformat import ForMachines, ForPeople, LogFile
from hdbridge.files.outputs import Kind, Output, check_outputs

_ROOT = logging.getLogger("hdbridge")


_given: tuple[int, Path | None] = (0, None)
"""Requested settings: verbosity on standard error, and path of the log file."""


def begin(verbose: int, path: Path | None) -> None:
    """Begins logging; raises `InputError` if the file cannot be written."""
    global _given  # noqa: PLW0603 - the handlers are the process's as well
    _given = verbose, path
    _ROOT.propagate = False
    if verbose:
        people = logging.StreamHandler()
        people.setFormatter(ForPeople())
        people.setLevel(logging.INFO if verbose == 1 else logging.DEBUG)
        _ROOT.addHandler(people)
    if path is not None:
        check_outputs([Output("--log", path, Kind.LOG)])
        try:
            machines = LogFile(path, encoding="utf-8")
        except OSError as problem:
            raise InputError(f"{path}: cannot be written: {problem.strerror}") from None
        machines.setFormatter(ForMachines())
        _ROOT.addHandler(machines)
    _ROOT.setLevel(logging.DEBUG)


def write(event: str, **facts: object) -> None:
    """Logs an event of the command line itself."""
    logging.getLogger(__name__).debug(event, facts)


def handed_over() -> tuple[int, Path | None]:
    """Returns the settings, for a command with its own logging, and stops logging here."""
    for each in tuple(_ROOT.handlers):
        _ROOT.removeHandler(each)
        each.close()
    verbose, path = _given
    return verbose, path.absolute() if path is not None else None


def end(exit_status: int) -> int:
    """Logs the last event and stops; returns the exit status, changed only if nothing but the log failed."""
    write("end", exit_status=exit_status)
    for each in tuple(_ROOT.handlers):
        _ROOT.removeHandler(each)
        each.close()
        if isinstance(each, LogFile) and each.failed:
            exit_status = exit_status or OutputError.exit_status
    _ROOT.setLevel(logging.NOTSET)
    _ROOT.propagate = True
    return exit_status
