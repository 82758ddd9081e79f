"""Distribution of samples and events to the recorder, the watch, the adaptation and live clients."""

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from hdbridge.clock import Clock
from hdbridge.daemon.memory import Event, Memory, SampleArray, joined_samples, sample_dtype
from hdbridge.daemon.service.eventlog import EventLog

PERIOD_S = 0.02
GONE_S = 3.0
"""Time without a turn after which the control process counts as hung or dead."""
_log = logging.getLogger(__name__)


class Sink(Protocol):
    """Receiver of samples and events. It must not block; slow work requires a thread and a bounded queue."""

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes the samples and events since the last call, oldest first, and the number of lost cycles."""
        ...


class Observer:
    """Reads the rings every `PERIOD_S` and passes new samples and events to the sinks."""

    def __init__(self, memory: Memory, log: EventLog, clock: Clock) -> None:
        self._reader = memory.reader()
        self._clock = clock
        self._status = memory.status
        self._turns = -1
        self._turned_s = clock.now()
        self._log = log
        self._seen = log.newest
        self._sinks: list[Sink] = []
        self._broken: set[int] = set()
        self.none: SampleArray = np.empty(0, sample_dtype(memory.axes))
        self.newest: SampleArray | None = None
        """Newest sample, shape (1,); None before the first."""
        self.lost = 0
        """Cycles lost because this process was too slow."""

    def add(self, sink: Sink) -> None:
        self._sinks.append(sink)

    def remove(self, sink: Sink) -> None:
        self._sinks.remove(sink)

    @property
    def cycle(self) -> int:
        """Number of the newest cycle; -1 before the first."""
        return int(self.newest[0]["cycle"]) if self.newest is not None else -1

    @property
    def alive(self) -> bool:
        """True if the control process has completed a turn within `GONE_S`."""
        return self._clock.now() - self._turned_s < GONE_S

    def poll(self) -> None:
        """Reads the rings and calls the sinks. An error of a sink is logged once and affects no other."""
        samples, lost = self._reader.read()
        self._log.poll()
        turns = self._status.loop_count
        if turns != self._turns:
            self._turns, self._turned_s = turns, self._clock.now()
        entries = self._log.since(self._seen)
        self._seen = entries[-1].number if entries else self._seen
        events = [each.event for each in entries if each.event is not None]
        self.lost += lost
        if len(samples):
            self.newest = samples[-1:].copy()
        if not (len(samples) or events or lost):
            return
        for sink in tuple(self._sinks):
            try:
                sink.take(samples, events, lost)
            except Exception:
                if id(sink) not in self._broken:
                    self._broken.add(id(sink))
                    _log.exception("a sink failed", extra={"sink": type(sink).__name__})


class Batch(NamedTuple):
    """Samples delivered to a subscriber together."""

    samples: SampleArray
    """One row per cycle, with the fields of `hdbridge.daemon.memory.sample_dtype`."""
    lost: int
    """Cycles lost because the subscriber was too slow."""


class Subscription:
    """Buffer of one live client, an asynchronous iterator: the newest samples until they are fetched.

    A slow client loses samples; each batch contains the number lost.
    """

    def __init__(self, observer: Observer, most: int) -> None:
        """Keeps at most ``most`` samples."""
        self._observer = observer
        self._most = most
        self._samples: deque[SampleArray] = deque()
        self._waiting = 0
        self._lost = 0
        self._came = asyncio.Event()
        observer.add(self)

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples from the observer, in the thread of the event loop."""
        self._lost += lost + max(len(samples) - self._most, 0)
        kept = samples[-self._most :]
        if len(kept):
            self._samples.append(kept)
            self._waiting += len(kept)
        while self._waiting > self._most:
            oldest = self._samples.popleft()
            over = min(self._waiting - self._most, len(oldest))
            self._lost += over
            self._waiting -= over
            if over < len(oldest):
                self._samples.appendleft(oldest[over:])
        self._came.set()

    def __aiter__(self) -> AsyncIterator[Batch]:
        return self

    async def __anext__(self) -> Batch:
        """Returns the next batch, waiting if necessary."""
        await self._came.wait()
        self._came.clear()
        samples = list(self._samples)
        batch = Batch(joined_samples(samples) if samples else self._observer.none, self._lost)
        self._samples.clear()
        self._waiting = self._lost = 0
        return batch

    def close(self) -> None:
        self._observer.remove(self)
