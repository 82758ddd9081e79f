"""Distribution of samples and events to the event log, recorder, watch, adaptation and metrics."""

import logging
from collections.abc import Sequence
from typing import Protocol

from hdbridge.clock import Clock
from hdbridge.daemon.memory import Cell, Event, Memory, SampleArray

PERIOD_S = 0.02
DEAD_S = 3.0
"""Time without a cycle after which the control process counts as hung or dead."""
_log = logging.getLogger(__name__)


class Sink(Protocol):
    """Receiver of samples and events. It must not block; slow work requires a thread and a bounded queue."""

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes the samples and events since the last call, oldest first, and the number of lost cycles."""
        ...


class Observer:
    """Reads the rings every `PERIOD_S` and passes new samples and events to the sinks."""

    def __init__(self, memory: Memory, clock: Clock) -> None:
        self._reader, self._events = memory.reader(), memory.event_reader()
        self._clock = clock
        self._status = memory.status
        self._turns = -1
        self._turned_s = clock.now()
        self._sinks: list[Sink] = []
        self._failed_sinks: set[int] = set()
        self.newest: SampleArray | None = None
        """Newest sample, shape (1,); None before the first."""
        self.lost = 0
        """Cycles lost because this process was too slow."""

    def add(self, sink: Sink) -> None:
        self._sinks.append(sink)

    @property
    def cycle(self) -> int:
        """Number of the newest cycle; -1 before the first."""
        return int(self.newest[0]["cycle"]) if self.newest is not None else -1

    @property
    def alive(self) -> bool:
        """True if the control process has completed a cycle within the last `DEAD_S`."""
        return self._clock.now() - self._turned_s < DEAD_S

    def poll(self) -> None:
        """Reads the rings and calls the sinks. An error of a sink is logged once and affects no other."""
        samples, lost = self._reader.read()
        events, _ = self._events.read()
        turns = self._status[Cell.LOOP_COUNT]
        if turns != self._turns:
            self._turns, self._turned_s = turns, self._clock.now()
        self.lost += lost
        if len(samples):
            self.newest = samples[-1:].copy()
        if not (len(samples) or events or lost):
            return
        for sink in self._sinks:
            try:
                sink.take(samples, events, lost)
            except Exception:
                if id(sink) not in self._failed_sinks:
                    self._failed_sinks.add(id(sink))
                    _log.exception("a sink failed", extra={"sink": type(sink).__name__})
