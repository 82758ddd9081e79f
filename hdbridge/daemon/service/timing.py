"""Clock, sleep and threads of the service, passed in so that tests run on virtual time in one thread."""

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, ParamSpec, TypeVar

from hdbridge.clock import Clock, MonotonicClock

Params = ParamSpec("Params")
Result = TypeVar("Result")

POLL_S = 0.005
"""Interval between checks for an answer of the control process."""


CREDIT_S: Final = 0.25
"""Maximum simulated time of completed cycles not yet passed on the clock; any excess is discarded."""
STEP_S: Final = 0.1
"""Maximum time by which one reading advances the clock. A longer interval between two readings means that the
service itself was suspended."""
HANG_S: Final = 5.0
"""Time without a cycle after which the loop counts as hung or dead, and the clock follows real time."""
SHORTEST_WAIT_S: Final = 0.001


class SimulatedClock:
    """Clock of a service with simulated drives: no faster than their control loop, nor than real time.

    On a busy computer the loop of simulated drives lags, and so does its virtual time. Time-outs on this
    clock are delayed equally, so they do not expire early. Thread-safe.
    """

    def __init__(
        self,
        turns: Callable[[], int],
        period_s: float,
        real_s: Callable[[], float] = time.monotonic,
        hang_s: float = HANG_S,
    ) -> None:
        """``turns`` returns the number of the loop's cycles of ``period_s``; ``real_s`` returns real time."""
        self._turns, self._period_s, self._real_s, self._hang_s = turns, period_s, real_s, hang_s
        self._lock = threading.Lock()
        self._now_s = self._read_s = real_s()
        self._turned, self._credit_s, self._idle_s = turns(), CREDIT_S, 0.0

    def now(self) -> float:
        """Returns the time in seconds; it starts at the real time."""
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
        """Sleeps until this clock reaches ``deadline_s``."""
        while (left_s := deadline_s - self.now()) > 0.0:
            time.sleep(min(max(left_s, SHORTEST_WAIT_S), STEP_S))


class Timing:
    """Clock and thread pool of the service; must be closed when the service ends."""

    def __init__(self, threads: int, clock: Clock | None = None) -> None:
        """Up to ``threads`` blocking calls run at the same time; others wait.

        ``clock`` defaults to the computer's monotonic clock.
        """
        self.clock: Clock = clock or MonotonicClock()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="service")

    async def sleep(self, duration_s: float) -> None:
        """Sleeps until this clock, which may be slower than real time, has advanced by ``duration_s``."""
        end_s, left_s = self.clock.now() + duration_s, duration_s
        while True:
            await asyncio.sleep(left_s)
            if (left_s := end_s - self.clock.now()) <= 0.0:
                return
            left_s = max(left_s, SHORTEST_WAIT_S)

    async def work(
        self, function: Callable[Params, Result], *args: Params.args, **kwargs: Params.kwargs
    ) -> Result:
        """Runs ``function`` in a thread of the pool."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._pool, lambda: function(*args, **kwargs))

    def close(self) -> None:
        """Cancels waiting calls; running ones complete."""
        self._pool.shutdown(wait=False, cancel_futures=True)
