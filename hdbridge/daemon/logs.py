"""Log of the daemon: one line per event, as JSON, or as text on a terminal, with a rate limit per event.

Each process logs to standard error, which under systemd is the journal, and with ``--log`` to a file. The
control process logs its start, and nothing while the loop runs.
"""

import logging
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdbridge.files.logformat import ForMachines, ForPeople, LogFile

_ROOT = logging.getLogger("hdbridge")
_ALL = logging.getLogger()
"""Logger of all libraries, of which only warnings and errors are logged."""
BURST: Final = 20
"""Maximum number of records of one event per `WINDOW_S`; the number of omitted records is reported."""
WINDOW_S: Final = 10.0
_LEVELS: Final = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}
"""Syslog priorities, which the journal reads from the start of a line."""


@dataclass(frozen=True, slots=True)
class LogSettings:
    """Log settings of the daemon's processes."""

    verbose: int = 0
    """Verbosity; from 1 on, SDO transfers are logged as well."""
    file: Path | None = None
    """File to which all records are appended, one JSON object per line."""


class RateLimit(logging.Filter):
    """Passes `BURST` records of an event per window, and then reports the number omitted."""

    def __init__(self, burst: int = BURST, window_s: float = WINDOW_S) -> None:
        super().__init__()
        self._burst, self._window_s = burst, window_s
        self._seen: dict[tuple[str, str], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns True if the record is logged; the first after a gap includes the number omitted."""
        key = (record.name, str(record.msg))
        now_s = time.monotonic()
        since_s, count = self._seen.get(key, (now_s, 0))
        left_out = 0
        if now_s - since_s >= self._window_s:
            left_out = max(count - self._burst, 0)
            since_s, count = now_s, 0
        self._seen[key] = since_s, count + 1
        if count >= self._burst:
            return False
        if left_out:
            facts = record.args if isinstance(record.args, dict) else {}
            record.args = {**facts, "left_out_before": left_out}
        return True


class _Journal(ForMachines):
    """Formatter for the journal: JSON preceded by the priority."""

    def format(self, record: logging.LogRecord) -> str:
        return f"<{_LEVELS.get(record.levelno, 6)}>{super().format(record)}"


def begin_log(settings: LogSettings) -> None:
    """Starts logging in this process."""
    _ROOT.propagate = False
    to_journal = "JOURNAL_STREAM" in os.environ
    stderr = logging.StreamHandler()
    stderr.setFormatter(_Journal() if to_journal else ForPeople() if sys.stderr.isatty() else ForMachines())
    stderr.setLevel(logging.DEBUG if settings.verbose else logging.INFO)
    stderr.addFilter(RateLimit())
    for each in (_ROOT, _ALL):
        each.addHandler(stderr)
    if settings.file is not None:
        file = LogFile(settings.file, encoding="utf-8")
        file.setFormatter(ForMachines())
        file.addFilter(RateLimit())
        for each in (_ROOT, _ALL):
            each.addHandler(file)
    _ROOT.setLevel(logging.DEBUG)


def log_once(settings: LogSettings, where: str, event: str, facts: dict[str, object]) -> None:
    """Logs one event, then removes its handlers and logs nothing more of hdbridge in this process."""
    before = tuple(_ROOT.handlers)
    begin_log(settings)
    logging.getLogger(where).info(event, facts)
    for each in set(_ROOT.handlers) - set(before):
        _ROOT.removeHandler(each)
        _ALL.removeHandler(each)
        each.close()
    _ROOT.setLevel(logging.CRITICAL)
