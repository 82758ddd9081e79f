"""How the service waits: passed in, so that tests run on virtual time in one thread."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, Protocol, TypeVar

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


class RealTiming:
    """The machine's clock, and a pool of threads. Close it when the service ends."""

    def __init__(self, threads: int) -> None:
        """So many blocking things can be under way at a time; further ones wait."""
        self.clock: Clock = MonotonicClock()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="service")

    async def sleep(self, duration_s: float) -> None:
        """`asyncio.sleep`."""
        await asyncio.sleep(duration_s)

    async def work(
        self, function: Callable[Params, Result], *args: Params.args, **kwargs: Params.kwargs
    ) -> Result:
        """In a thread of the pool."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._pool, lambda: function(*args, **kwargs))

    def close(self) -> None:
        """Begin nothing more; what is under way goes to its end."""
        self._pool.shutdown(wait=False, cancel_futures=True)
