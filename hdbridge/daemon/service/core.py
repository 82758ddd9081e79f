"""Core of the service: samples, events and commands of the control process, with clock and lease."""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence
from itertools import count
from typing import Any, Final, Protocol, TypedDict, Unpack

from hdbridge.daemon.memory import Cell, CommandKind, Event, EventKind, Memory, SampleArray
from hdbridge.daemon.service.eventlog import EventLog
from hdbridge.daemon.service.lease import Lease
from hdbridge.daemon.service.timing import POLL_S, Timing
from hdbridge.errors import DaemonError, RefusedError

_log = logging.getLogger(__name__)
ANSWER_S: Final = 5.0
"""Time-out of an answer. The control process normally answers within a few cycles, but answers ENABLE and
DISABLE only on completion."""
PERIOD_S: Final = 0.02
"""Maximum interval between two readings of samples and events."""
DEAD_S: Final = 3.0
"""Time without a cycle after which the control process counts as hung or dead."""
_ANSWERS: Final = frozenset({EventKind.DONE, EventKind.REFUSED})


class Arguments(TypedDict, total=False):
    """Fields of a `Command`; `CommandKind` documents their meaning."""

    a: float
    b: float
    c: float
    i: int
    j: int
    k: int


class Sink(Protocol):
    """Receiver of samples and events. It must not block; slow work requires a thread and a bounded queue."""

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes the samples and events since the last call, oldest first, and the number of lost cycles."""
        ...


class Core:
    """Access to the control process, the clock and the lease, for use in one event loop."""

    def __init__(self, memory: Memory, timing: Timing, lease_s: float, names: Sequence[str] = ()) -> None:
        """``lease_s`` is the time-out of the lease; ``names`` are those of the axes."""
        self.memory = memory
        self.timing = timing
        self.log = EventLog(names)
        self.newest: SampleArray | None = None
        """Newest sample, shape (1,); None before the first."""
        self.lost = 0
        """Cycles lost because this process was too slow."""
        self._samples, self._events = memory.reader(), memory.event_reader()
        self._turns, self._turned_s = -1, timing.clock.now()
        self._sinks: list[Sink] = [self.log]
        self._failed_sinks: set[int] = set()
        self.lease = Lease(lease_s, timing.clock.now)
        self.refuse: Callable[[CommandKind | None], None] = lambda _: None
        """Raises RefusedError if the bus is lent and no command (None: no frame) can be sent."""
        self._answers: dict[int, Event | None] = {}
        """Answers to the commands that are waited for, by id; None before the answer."""
        self._tasks: set[asyncio.Task[None]] = set()
        # Start from the current time, so that the numbers differ from those of an earlier service.
        self._streams = count(int(1000.0 * timing.clock.now()) + 1)

    def start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Runs a coroutine in the background, until its end or until `close`."""
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    async def close(self) -> None:
        """Cancels what `start` has begun."""
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _ended(self, task: asyncio.Task[None]) -> None:
        """Logs an unexpected error of a task."""
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.error("an error in hdbridge", exc_info=error)

    def next_stream(self) -> int:
        """Returns an unused stream number."""
        return next(self._streams)

    # ---------------------------------------------------------------- samples and events

    def add_sink(self, sink: Sink) -> None:
        """Passes new samples and events to a sink from now on."""
        self._sinks.append(sink)

    @property
    def cycle(self) -> int:
        """Number of the newest cycle; -1 before the first."""
        return int(self.newest[0]["cycle"]) if self.newest is not None else -1

    @property
    def alive(self) -> bool:
        """True if the control process has completed a cycle within the last `DEAD_S`."""
        return self.timing.clock.now() - self._turned_s < DEAD_S

    def poll(self) -> None:
        """Reads new samples and events, and calls the sinks.

        An error of a sink is logged once and affects no other.
        """
        samples, lost = self._samples.read()
        events, _ = self._events.read()
        turns = self.memory.status[Cell.LOOP_COUNT]
        if turns != self._turns:
            self._turns, self._turned_s = turns, self.timing.clock.now()
        self.lost += lost
        if len(samples):
            self.newest = samples[-1:].copy()
        if not (len(samples) or events or lost):
            return
        for event in events:
            if event.kind in _ANSWERS and event.id in self._answers:
                self._answers[event.id] = event
        for sink in self._sinks:
            try:
                sink.take(samples, events, lost)
            except Exception:
                if id(sink) not in self._failed_sinks:
                    self._failed_sinks.add(id(sink))
                    _log.exception("a sink failed", extra={"sink": type(sink).__name__})

    # ---------------------------------------------------------------- commands

    async def do(
        self, kind: CommandKind, axis: int = -1, within_s: float = ANSWER_S, **arguments: Unpack[Arguments]
    ) -> Event:
        """Posts a command and returns its `answer`."""
        return await self.answer(kind, self.post(kind, axis, **arguments), within_s)

    def post(self, kind: CommandKind, axis: int = -1, **arguments: Unpack[Arguments]) -> int:
        """Posts a command; returns its id. Raises RefusedError without a control process."""
        self.refuse(kind)
        if not self.memory.status[Cell.LOOP_PID]:
            raise RefusedError(
                f"{kind.name} was not sent, because there is no control process: the daemon is starting one, "
                "with every axis disabled; wait for it and repeat the request"
            )
        return self.memory.commands.post(kind, axis, **arguments)

    async def answer(self, kind: CommandKind, id_: int, within_s: float = ANSWER_S) -> Event:
        """Returns the event that reports the completion or start of a command, after a later sample.

        Raises RefusedError with the control process's reason if nothing was done, and DaemonError if it
        does not answer within ``within_s``.
        """
        status, answers = self.memory.status, self._answers
        loop_pid = status[Cell.LOOP_PID]
        answers[id_] = None
        try:
            await self.until(lambda: answers[id_] is not None or status[Cell.LOOP_PID] != loop_pid, within_s)
        finally:
            answer = answers.pop(id_)
        if answer is None and status[Cell.LOOP_PID] != loop_pid:
            raise DaemonError(
                f"the control process died before it answered {kind.name}; another one has taken its "
                "place, with every axis disabled"
            )
        if answer is None:
            raise DaemonError(
                f"the control process did not answer {kind.name} within {within_s:g} s: it hangs or is "
                "gone; it is restarted automatically, with every axis disabled"
            )
        if answer.kind is EventKind.REFUSED:
            raise RefusedError(answer.text)
        await self.until(lambda: self.cycle > answer.cycle, ANSWER_S)
        return answer

    async def until(self, found: Callable[[], bool], within_s: float) -> bool:
        """Waits until ``found()`` is True, checking each cycle; returns False after ``within_s``."""
        timing = self.timing
        deadline_s = timing.clock.now() + within_s
        self.poll()
        while not found():
            left_s = deadline_s - timing.clock.now()
            if left_s <= 0.0:
                return False
            await timing.sleep(min(POLL_S, left_s))
            self.poll()
        return True
