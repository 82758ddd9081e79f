"""What hdbridge does on the bus, for whoever has to find out why: on standard error, or as lines of JSON.

The library tells events through `logging`: a name, and a dictionary of facts. None is logged within the
control cycle; what happened there is logged when the axis rests.
"""

from __future__ import annotations

import json
import logging
import sys
from datetime import datetime
from pathlib import Path

from hdbridge.errors import InputError, OutputError
from hdbridge.files.outputs import Kind, Output, check_outputs

_ROOT = logging.getLogger("hdbridge")


class _ForPeople(logging.Formatter):
    """``12:30:01.250 sdo write  node=1 object=6060h:00 value=8``"""

    def format(self, record: logging.LogRecord) -> str:
        facts = " ".join(f"{name}={value}" for name, value in _facts(record).items())
        return f"{_date(record):%H:%M:%S}.{int(record.msecs):03d} {record.msg}  {facts}".rstrip()


class _ForMachines(logging.Formatter):
    """A JSON object: date, level, where, event, and the event's facts."""

    def format(self, record: logging.LogRecord) -> str:
        about = {
            "date": _date(record).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "where": record.name,
            "event": record.msg,
        }
        return json.dumps({**about, **_facts(record)}, default=str)


class _LogFile(logging.FileHandler):
    """Ends, with one line, where its disk is full: the axis is worth more than its log."""

    failed = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's own
        self._fail(sys.exc_info()[1])

    def emit(self, record: logging.LogRecord) -> None:
        if not self.failed:
            super().emit(record)

    def close(self) -> None:
        try:
            super().close()
        except OSError as problem:
            self._fail(problem)

    def _fail(self, problem: BaseException | None) -> None:
        if not self.failed:
            self.failed = True
            why = problem.strerror if isinstance(problem, OSError) else problem
            print(f"hdbridge: {self.baseFilename}: cannot be written: {why}", file=sys.stderr)


def begin(verbose: int, path: Path | None) -> None:
    """Tell events from now on; InputError where the file cannot be written."""
    _ROOT.propagate = False
    if verbose:
        people = logging.StreamHandler()
        people.setFormatter(_ForPeople())
        people.setLevel(logging.INFO if verbose == 1 else logging.DEBUG)
        _ROOT.addHandler(people)
    if path is not None:
        check_outputs([Output("--log", path, Kind.LOG)])
        try:
            machines = _LogFile(path, encoding="utf-8")
        except OSError as problem:
            raise InputError(f"{path}: cannot be written: {problem.strerror}") from None
        machines.setFormatter(_ForMachines())
        _ROOT.addHandler(machines)
    _ROOT.setLevel(logging.DEBUG)


def tell(event: str, **facts: object) -> None:
    """An event of the command line itself."""
    logging.getLogger(__name__).debug(event, facts)


def end(exit_status: int) -> int:
    """The last event; nothing is told after it. The exit status: another, where only the log failed."""
    tell("end", exit_status=exit_status)
    for each in tuple(_ROOT.handlers):
        _ROOT.removeHandler(each)
        each.close()
        if isinstance(each, _LogFile) and each.failed:
            exit_status = exit_status or OutputError.exit_status
    _ROOT.setLevel(logging.NOTSET)
    _ROOT.propagate = True
    return exit_status


def _facts(record: logging.LogRecord) -> dict[str, object]:
    return dict(record.args) if isinstance(record.args, dict) else {}


def _date(record: logging.LogRecord) -> datetime:
    return datetime.fromtimestamp(record.created).astimezone()
