"""Shared parts of the service: control process, event log, samples, clock and lease."""

import asyncio
import logging
from collections.abc import Callable, Coroutine
from itertools import count
from typing import Any, Final, TypedDict, Unpack

from hdbridge.daemon.memory import Cell, CommandKind, Event, EventKind, Memory
from hdbridge.daemon.service.eventlog import EventLog
from hdbridge.daemon.service.lease import Lease
from hdbridge.daemon.service.observer import Observer
from hdbridge.daemon.service.timing import POLL_S, Timing
from hdbridge.errors import DaemonError, RefusedError

_log = logging.getLogger(__name__)
ANSWER_S: Final = 5.0
"""Time-out of an answer. The control process normally answers within a few cycles, but answers ENABLE and
DISABLE only on completion."""


class Arguments(TypedDict, total=False):
    """Fields of a `Command`; `CommandKind` documents their meaning."""

    a: float
    b: float
    c: float
    i: int
    j: int
    k: int


class Core:
    """Access to the control process, the clock and the lease. Commands may be sent from any thread."""

    def __init__(self, memory: Memory, timing: Timing, lease_s: float) -> None:
        """``lease_s`` is the time-out of the lease."""
        self.memory = memory
        self.timing = timing
        self.log = EventLog(memory.event_reader())
        self.observer = Observer(memory, self.log, timing.clock)
        self.lease = Lease(lease_s, timing.clock.now)
        self.refuse: Callable[[CommandKind | None], None] = lambda _: None
        """Raises RefusedError if the bus is lent and no command (None: no frame) can be sent."""
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

    async def do(
        self, kind: CommandKind, axis: int = -1, within_s: float = ANSWER_S, **arguments: Unpack[Arguments]
    ) -> Event:
        """Posts a command and returns the event that reports its completion or start.

        Raises RefusedError with the control process's reason if nothing was done, and DaemonError if it
        does not answer within ``within_s``.
        """
        self.refuse(kind)
        loop_pid = self.memory.status[Cell.LOOP_PID]
        if not loop_pid:
            raise RefusedError(
                f"{kind.name} was not sent, because there is no control process: the daemon is starting one, "
                "with every axis disabled; wait for it and repeat the request"
            )
        since = self.log.newest
        command_id = self.memory.commands.post(kind, axis, **arguments)
        deadline_s = self.timing.clock.now() + within_s
        while True:
            self.observer.poll()
            for event in self.log.since(since):
                if event.id == command_id and event.kind is EventKind.DONE:
                    return event
                if event.id == command_id and event.kind is EventKind.REFUSED:
                    raise RefusedError(event.text)
            if self.memory.status[Cell.LOOP_PID] != loop_pid:
                raise DaemonError(
                    f"the control process died before it answered {kind.name}; another one has taken its "
                    "place, with every axis disabled"
                )
            if self.timing.clock.now() >= deadline_s:
                raise DaemonError(
                    f"the control process did not answer {kind.name} within {within_s:g} s: it hangs or is "
                    "gone; it is restarted automatically, with every axis disabled"
                )
            await self.timing.sleep(POLL_S)
