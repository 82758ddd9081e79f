"""The daemon's log: an event per line, as JSON or, on a terminal, in words; the same event not too often.

Each process logs for itself to what it was given: standard error, which under systemd is the journal, and
with ``--log`` a file. The control process logs how it begins, and nothing while it turns.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdbridge.files.logformat import ForMachines, ForPeople, LogFile

_ROOT = logging.getLogger("hdbridge")
BURST: Final = 20
"""So many of one event are logged within `WINDOW_S`; then it is said how many were left out."""
WINDOW_S: Final = 10.0
_LEVELS: Final = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}
"""Priorities of syslog, which the journal takes from the beginning of a line."""


@dataclass(frozen=True, slots=True)
class LogSettings:
    """Where the processes of the daemon log."""

    verbose: int = 0
    """From 1 on every SDO transfer, too."""
    file: Path | None = None
    """Appended to, everything, a JSON object per line."""


class RateLimit(logging.Filter):
    """Lets `BURST` records of an event through in each window, and tells of the others when it is over."""

    def __init__(self, burst: int = BURST, window_s: float = WINDOW_S) -> None:
        super().__init__()
        self._burst, self._window_s = burst, window_s
        self._seen: dict[tuple[str, str], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is logged; the first after a gap says how many were left out."""
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
    """JSON with the priority before it, where the journal reads along."""

    def format(self, record: logging.LogRecord) -> str:
        return f"<{_LEVELS.get(record.levelno, 6)}>{super().format(record)}"


def begin_log(settings: LogSettings) -> None:
    """Log from now on, in this process."""
    _ROOT.propagate = False
    to_journal = "JOURNAL_STREAM" in os.environ
    stderr = logging.StreamHandler()
    stderr.setFormatter(_Journal() if to_journal else ForPeople() if sys.stderr.isatty() else ForMachines())
    stderr.setLevel(logging.DEBUG if settings.verbose else logging.INFO)
    stderr.addFilter(RateLimit())
    _ROOT.addHandler(stderr)
    if settings.file is not None:
        file = LogFile(settings.file, encoding="utf-8")
        file.setFormatter(ForMachines())
        file.addFilter(RateLimit())
        _ROOT.addHandler(file)
    _ROOT.setLevel(logging.DEBUG)


def log_once(settings: LogSettings, where: str, event: str, facts: dict[str, object]) -> None:
    """One event of a process that logs nothing afterwards, its library neither."""
    before = tuple(_ROOT.handlers)
    begin_log(settings)
    logging.getLogger(where).info(event, facts)
    for each in set(_ROOT.handlers) - set(before):
        _ROOT.removeHandler(each)
        each.close()
    _ROOT.setLevel(logging.CRITICAL)
