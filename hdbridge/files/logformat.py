"""Formats of a logged event: text for people, a JSON object for programs.

The library reports events through `logging`, with the event's name as the message and a dictionary of facts
as its argument.
"""

import json
import logging
import sys
from datetime import datetime


class ForPeople(logging.Formatter):
    """Formats events as text: ``12:30:01.250 sdo write  node=1 object=6060h:00 value=8``."""

    def format(self, record: logging.LogRecord) -> str:
        facts = " ".join(f"{name}={value}" for name, value in _facts(record).items())
        return f"{_date(record):%H:%M:%S}.{int(record.msecs):03d} {_event(record)}  {facts}".rstrip()


class ForMachines(logging.Formatter):
    """Formats events as JSON objects with date, level, logger, event, and the event's facts."""

    def format(self, record: logging.LogRecord) -> str:
        about = {
            "date": _date(record).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "where": record.name,
            "event": _event(record),
        }
        return json.dumps({**about, **_facts(record)}, default=str)


class LogFile(logging.FileHandler):
    """Log file that stops logging at the first error, such as a full disk, so that the axis continues."""

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


def _event(record: logging.LogRecord) -> str:
    """Returns the event's name; of a record of another library, its message."""
    return str(record.msg) if record.name.startswith("hdbridge") else record.getMessage()


def _facts(record: logging.LogRecord) -> dict[str, object]:
    facts = dict(record.args) if isinstance(record.args, dict) else {}
    if record.exc_info:
        facts["traceback"] = logging.Formatter().formatException(record.exc_info)
    return facts


def _date(record: logging.LogRecord) -> datetime:
    return datetime.fromtimestamp(record.created).astimezone()
