"""Event log of the service: the control process's events and the service's own notes, in words.

The control process itself logs nothing, so its events are logged here, one line each. For clients, the newest
are kept without routine events (`_routine`), because the thousands of motions of a calibration must not
displace yesterday's stop.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from itertools import takewhile
from typing import Final

from hdbridge.client import messages
from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.memory import Event, EventKind, SampleArray
from hdbridge.daemon.memory.layout import LEVELS
from hdbridge.drive.supervision import EXPLAINED_HINT, ROWS, Reaction
from hdbridge.motion import MotionMode

ENTRIES_KEPT = 4096
STATES: Final = tuple(messages.ControlState)
MODES: Final = tuple(messages.MotionMode)
_log = logging.getLogger(__name__)


class EventLog:
    """Newest `ENTRIES_KEPT` events and notes for clients; a sink of `Core`. Thread-safe."""

    def __init__(self, names: Sequence[str]) -> None:
        """``names`` are those of the axes."""
        self._names = names
        self._lock = threading.Lock()
        self._entries: deque[messages.Event] = deque(maxlen=ENTRIES_KEPT)
        self.newest = 0
        """Number of the newest entry, counted from the start of the service; 0 before the first."""
        self.record: Callable[[str, str], None] = lambda *_: None
        """Adds a note to the flight recorder, if there is one."""

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Logs the events and the loss of cycles, and keeps the events for clients."""
        if lost:
            _log.warning("cycles lost", {"cycles": lost})
        for event in events:
            level = LEVELS.get(event.kind, logging.INFO)
            if _log.isEnabledFor(level):
                _log.log(level, event.kind.name.lower().replace("_", " "), self._fields(event))
            if not _routine(event):
                self._add(event)

    def note(self, text: str, axis: int = -1, kind: str = "") -> None:
        """Adds a note of the service on the machine, or on the axis of this index.

        A note with a ``kind``, such as a mark, is recorded as well.
        """
        name = self._name(axis)
        with self._lock:
            self._append(messages.EventKind.NOTE, name, text)
        if kind:
            self.record(kind, f"{name}: {text}" if name is not None else text)

    def since(self, sequence: int) -> list[messages.Event]:
        """Returns the retained entries after number ``sequence``, oldest first."""
        with self._lock:
            new = list(takewhile(lambda each: each.sequence > sequence, reversed(self._entries)))
        new.reverse()
        return new

    def _add(self, event: Event) -> None:
        axis, text, hint, fault = self._name(event.axis), event.text, None, fault_of(event.code)
        match event.kind:
            case EventKind.STATE:
                text = STATES[event.code].value
            case EventKind.MOTION_ENDED:
                text = MODES[event.code].value
            case EventKind.FAULT if fault is not None:
                detail = f" ({text})" if text else ""
                text = f"{fault.value}{detail}: {Reaction(event.id).name.lower().replace('_', ' ')}"
                hint = ROWS[fault].hint
            case EventKind.STOPPED:
                hint = stop_hint(event, axis or "AXIS")
        with self._lock:
            self._append(messages.EventKind[event.kind.name], axis, text, event.cycle, hint)

    def _append(
        self,
        kind: messages.EventKind,
        axis: str | None,
        text: str,
        cycle: int | None = None,
        hint: str | None = None,
    ) -> None:
        self.newest += 1
        date = datetime.now(UTC)
        self._entries.append(
            messages.Event(
                sequence=self.newest, kind=kind, date=date, cycle=cycle, axis=axis, text=text, hint=hint
            )
        )

    def _name(self, axis: int) -> str | None:
        return self._names[axis] if 0 <= axis < len(self._names) else None

    def _fields(self, event: Event) -> dict[str, object]:
        facts: dict[str, object] = {"cycle": event.cycle}
        if (axis := self._name(event.axis)) is not None:
            facts["axis"] = axis
        if event.kind is EventKind.STATE:
            facts["state"] = STATES[event.code].value
        if event.kind is EventKind.FAULT and (fault := fault_of(event.code)) is not None:
            facts["fault"] = fault.name
            facts["reaction"] = Reaction(event.id).name.lower()
        if event.text:
            facts["text"] = event.text
        return facts


def _routine(event: Event) -> bool:
    """Returns True for a completed command and the end of a stream, which concern only their client."""
    stream = event.kind is EventKind.MOTION_ENDED and event.code == MotionMode.STREAM
    return stream or event.kind is EventKind.DONE


def stop_hint(stopped: Event, axis: str) -> str:
    """Returns advice on how to recover from a stop."""
    fault = fault_of(stopped.code)
    if stopped.id:
        return EXPLAINED_HINT
    return ROWS[fault].hint if fault is not None else reset_hint(axis)


def reset_hint(axis: str) -> str:
    """Returns advice on how to recover from a commanded stop."""
    return f"reset it when the axis may move again: hdbridge ctl reset {axis}"
