"""Event log: the control process's events and the service's notes, in two bounded lists. Thread-safe.

One list has every entry, for the service itself. Clients see the other list, which omits routine entries
(`_routine`), because the thousands of motions of a calibration must not displace yesterday's stop. Each list
has its own numbering. `EventLogger` writes the log lines of the control process, which itself writes none.
"""

import logging
import threading
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Event, EventKind, RingReader, SampleArray
from hdbridge.daemon.memory.layout import LEVELS
from hdbridge.drive.supervision import Reaction
from hdbridge.motion import MotionMode

ENTRIES_KEPT = 4096
ANSWERS_KEPT = 1024
_ANSWERS = (EventKind.DONE, EventKind.REFUSED)
_log = logging.getLogger(__name__)


class Entry(NamedTuple):
    """Entry of the event log."""

    number: int
    """Number within its list, from 1 at the start of the service."""
    date: datetime
    axis: int
    """Index of the axis; -1 is the machine."""
    event: Event | None
    """Event of the control process; None for a note of the service."""
    text: str


class EventLog:
    """Newest `ENTRIES_KEPT` entries, and the answers to the newest commands."""

    def __init__(self, reader: RingReader[Event]) -> None:
        self._reader = reader
        self._lock = threading.Lock()
        self._entries: deque[Entry] = deque(maxlen=ENTRIES_KEPT)
        self._public: deque[Entry] = deque(maxlen=ENTRIES_KEPT)
        self._answers: dict[int, Event] = {}
        self.newest = self.newest_public = 0
        """Numbers of the newest entry, and of the newest for clients; 0 before the first."""

    def poll(self) -> None:
        """Reads new events of the control process."""
        with self._lock:
            events, _ = self._reader.read()
            for event in events:
                self._add(event.axis, event, event.text)
                if event.id and event.kind in _ANSWERS:
                    self._answers[event.id] = event
            while len(self._answers) > ANSWERS_KEPT:
                del self._answers[next(iter(self._answers))]

    def note(self, text: str, axis: int = -1) -> None:
        """Adds a note of the service."""
        with self._lock:
            self._add(axis, None, text)

    def answer(self, command_id: int) -> Event | None:
        """Returns the DONE or REFUSED event of a command; None until it arrives."""
        return self._answers.get(command_id)

    def since(self, number: int) -> list[Entry]:
        """Returns the retained entries after ``number``, oldest first."""
        with self._lock:
            return _newest(self._entries, self.newest - number)

    def public(self, number: int) -> list[Entry]:
        """Returns the entries for clients after ``number``, oldest first."""
        with self._lock:
            return _newest(self._public, self.newest_public - number)

    def of_axis(self, axis: int, since: int) -> list[Event]:
        """Returns the control process's events of one axis and of the machine after number ``since``."""
        entries = self.since(since)
        return [each.event for each in entries if each.event is not None and each.axis in {axis, -1}]

    def _add(self, axis: int, event: Event | None, text: str) -> None:
        date = datetime.now(UTC)
        self.newest += 1
        self._entries.append(Entry(self.newest, date, axis, event, text))
        if event is None or not _routine(event):
            self.newest_public += 1
            self._public.append(Entry(self.newest_public, date, axis, event, text))


def _newest(entries: deque[Entry], count: int) -> list[Entry]:
    new = min(max(count, 0), len(entries))
    return [entries[place] for place in range(len(entries) - new, len(entries))]


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
