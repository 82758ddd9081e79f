"""How the service waits: passed in, so that tests run on virtual time in one thread."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, ParamSpec, Protocol, TypeVar

from hdbridge.clock import Clock, MonotonicClock

Params = ParamSpec("Params")
Result = TypeVar("Result")

POLL_S = 0.005
"""How often is looked for an answer of the control process while somebody waits for it."""


class Timing(Protocol):
    """Time as coroutines and as blocking work see it."""

    @property
    def clock(self) -> Clock:
        """For blocking work: `Clock.sleep_until` in its own thread."""
        ...

    async def sleep(self, duration_s: float) -> None:
        """Let the other coroutines run for so long."""
        ...

    async def work(
        self, function: Callable[Params, Result], *args: Params.args, **kwargs: Params.kwargs
    ) -> Result:
        """Run what blocks, such as SDO transfers, away from the event loop."""
        ...


CREDIT_S: Final = 0.25
"""Simulated time that may be used up later: the loop turns once a period, and the clock is read between."""
STEP_S: Final = 0.1
"""Longest time between two readings of the clock that counts: the service itself stood still for the rest."""
HANG_S: Final = 5.0
"""A loop that has not turned for so long hangs or is gone: from then on real time passes."""
SHORTEST_WAIT_S: Final = 0.001


class SimulatedClock:
    """Clock of a service with simulated drives: no faster than their control loop, and than real time.

    On a busy computer the loop of simulated drives is late, and its virtual time with it. Time-outs on this
    clock are late by as much, so that nothing fails. Thread-safe.
    """

    def __init__(
        self,
        turns: Callable[[], int],
        period_s: float,
        real_s: Callable[[], float] = time.monotonic,
        hang_s: float = HANG_S,
    ) -> None:
        """``turns`` counts those of the loop, of ``period_s`` each; ``real_s`` is the computer's clock."""
        self._turns, self._period_s, self._real_s, self._hang_s = turns, period_s, real_s, hang_s
        self._lock = threading.Lock()
        self._now_s = self._read_s = real_s()
        self._turned, self._credit_s, self._idle_s = turns(), CREDIT_S, 0.0

    def now(self) -> float:
        """Seconds; it starts at the real time."""
        with self._lock:
            read_s, turned = self._real_s(), self._turns()
            passed_s = min(read_s - self._read_s, STEP_S)
            self._read_s = read_s
            if turned != self._turned:
                self._credit_s += max(turned - self._turned, 0) * self._period_s
                self._turned, self._idle_s = turned, 0.0
            else:
                self._idle_s += passed_s
            if self._idle_s < self._hang_s:
                passed_s = min(passed_s, self._credit_s)
            self._now_s += passed_s
            self._credit_s = min(max(self._credit_s - passed_s, 0.0), CREDIT_S)
            return self._now_s

    def sleep_until(self, deadline_s: float) -> None:
        """Sleep in real time until this clock is there."""
        while (left_s := deadline_s - self.now()) > 0.0:
            time.sleep(min(max(left_s, SHORTEST_WAIT_S), STEP_S))


class RealTiming:
    """A clock that runs without being stepped, and a pool of threads. Close it when the service ends."""

    def __init__(self, threads: int, clock: Clock | None = None) -> None:
        """So many blocking things can be under way at a time; further ones wait.

        ``clock`` is the computer's own, unless a `SimulatedClock` is given.
        """
        self.clock: Clock = clock or MonotonicClock()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="service")

    async def sleep(self, duration_s: float) -> None:
        """`asyncio.sleep`, again while the clock is not there."""
        end_s, left_s = self.clock.now() + duration_s, duration_s
        while True:
            await asyncio.sleep(left_s)
            if (left_s := end_s - self.clock.now()) <= 0.0:
                return
            left_s = max(left_s, SHORTEST_WAIT_S)

    async def work(
        self, function: Callable[Params, Result], *args: Params.args, **kwargs: Params.kwargs
    ) -> Result:
        """In a thread of the pool."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._pool, lambda: function(*args, **kwargs))

    def close(self) -> None:
        """Begin nothing more; what is under way goes to its end."""
        self._pool.shutdown(wait=False, cancel_futures=True)
