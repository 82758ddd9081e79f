"""Objects that all parts of the service share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count

from hdbridge.daemon.memory import Memory
from hdbridge.daemon.service.dispatch import Dispatcher
from hdbridge.daemon.service.eventlog import EventLog
from hdbridge.daemon.service.lease import Lease
from hdbridge.daemon.service.observer import Observer
from hdbridge.daemon.service.timing import Timing


@dataclass(frozen=True)
class Core:
    """Access to the control process, the clock and the lease."""

    memory: Memory
    log: EventLog
    dispatch: Dispatcher
    observer: Observer
    timing: Timing
    lease: Lease
    _streams: Iterator[int] = field(init=False)

    def __post_init__(self) -> None:
        """Numbers streams from the present time, so that those of an earlier service differ."""
        object.__setattr__(self, "_streams", count(int(1000.0 * self.timing.clock.now()) + 1))

    @classmethod
    def of(cls, memory: Memory, timing: Timing, lease_s: float) -> Core:
        """Builds all parts for a machine's shared memory."""
        log = EventLog(memory.event_reader())
        dispatch = Dispatcher(memory, log, timing)
        observer = Observer(memory, log, timing.clock)
        return cls(memory, log, dispatch, observer, timing, Lease(lease_s, timing.clock.now))

    def next_stream(self) -> int:
        """Returns an unused stream number."""
        return next(self._streams)
