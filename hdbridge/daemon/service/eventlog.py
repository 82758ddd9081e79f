"""Event log for clients: the control process's events and the service's notes, bounded. Thread-safe.

It omits routine events (`_routine`), because the thousands of motions of a calibration must not displace
yesterday's stop. `EventLogger` writes the log lines of the control process, which itself writes none.
"""

import logging
import threading
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import takewhile
from typing import NamedTuple

from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Event, EventKind, RingReader, SampleArray
from hdbridge.daemon.memory.layout import LEVELS
from hdbridge.drive.supervision import Reaction
from hdbridge.motion import MotionMode

ENTRIES_KEPT = 4096
_log = logging.getLogger(__name__)


class Entry(NamedTuple):
    """Entry for clients."""

    sequence: int
    """Number of the entry, from 1 at the start of the service."""
    date: datetime
    axis: int
    """Index of the axis; -1 is the machine."""
    event: Event | None
    """Event of the control process; None for a note of the service."""
    text: str


class EventLog:
    """Newest `ENTRIES_KEPT` entries for clients."""

    def __init__(self, reader: RingReader[Event]) -> None:
        self._reader = reader
        self._lock = threading.Lock()
        self._entries: deque[Entry] = deque(maxlen=ENTRIES_KEPT)
        self.newest = 0
        """Number of the newest entry; 0 before the first."""

    def poll(self) -> list[Event]:
        """Reads new events of the control process and returns them."""
        with self._lock:
            events, _ = self._reader.read()
            for event in events:
                if not _routine(event):
                    self._add(event.axis, event, event.text)
        return events

    def note(self, text: str, axis: int = -1) -> None:
        """Adds a note of the service."""
        with self._lock:
            self._add(axis, None, text)

    def since(self, sequence: int) -> list[Entry]:
        """Returns the retained entries after number ``sequence``, oldest first."""
        with self._lock:
            new = list(takewhile(lambda each: each.sequence > sequence, reversed(self._entries)))
        new.reverse()
        return new

    def _add(self, axis: int, event: Event | None, text: str) -> None:
        self.newest += 1
        self._entries.append(Entry(self.newest, datetime.now(UTC), axis, event, text))


def _routine(event: Event) -> bool:
    """Returns True for a completed command and the end of a stream, which concern only their client."""
    stream = event.kind is EventKind.MOTION_ENDED and event.code == MotionMode.STREAM
    return stream or event.kind is EventKind.DONE


class EventLogger:
    """Sink of the observer that logs one line per event, with the name of its axis."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        if lost:
            _log.warning("cycles lost", {"cycles": lost})
        for event in events:
            level = LEVELS.get(event.kind, logging.INFO)
            if _log.isEnabledFor(level):
                _log.log(level, event.kind.name.lower().replace("_", " "), self._fields(event))

    def _fields(self, event: Event) -> dict[str, object]:
        facts: dict[str, object] = {"cycle": event.cycle}
        if 0 <= event.axis < len(self._names):
            facts["axis"] = self._names[event.axis]
        if event.kind is EventKind.STATE:
            facts["state"] = AxisState(event.code).name.lower().replace("_", "-")
        if event.kind is EventKind.FAULT and (fault := fault_of(event.code)) is not None:
            facts["fault"] = fault.name
            facts["reaction"] = Reaction(event.id).name.lower()
        if event.text:
            facts["text"] = event.text
        return facts
