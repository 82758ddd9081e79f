"""Virtual clock that never runs ahead of real time, for simulated drives that a user watches.

If the computer lags, virtual time lags by the same amount. No event is skipped, and a long delay is not made
up for. A stall of the computer is therefore not a fault on a simulated bus.
"""

import math
import time
from collections.abc import Callable
from typing import Final

from hdbridge.errors import InputError
from hdbridge.sim.lockstep import VirtualClock

FORGIVEN_S: Final = 0.1
"""Longest delay in real time that is made up for; after a longer delay, pacing restarts from the current
time."""


class PacedClock(VirtualClock):
    """`VirtualClock` whose time passes at most ``speed`` times as fast as real time."""

    def __init__(
        self,
        start_s: float = 0.0,
        speed: float = 1.0,
        real_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``real_s`` and ``sleep`` are the computer's clock. InputError if ``speed`` is not positive."""
        if not (math.isfinite(speed) and speed > 0.0):
            raise InputError(f"the simulation speed is {speed!r}; expected a finite number above 0")
        super().__init__(start_s)
        self._speed = speed
        self._real_s, self._sleep = real_s, sleep
        self._anchor_s, self._anchor_real_s = start_s, real_s()

    def sleep_until(self, deadline_s: float) -> None:
        """Advances to ``deadline_s``, but not before the corresponding real time."""
        due_s = self._anchor_real_s + (deadline_s - self._anchor_s) / self._speed
        wait_s = due_s - self._real_s()
        if wait_s > 0.0:
            self._sleep(wait_s)
        elif wait_s < -FORGIVEN_S:
            self._anchor_s, self._anchor_real_s = deadline_s, self._real_s()
        super().sleep_until(deadline_s)
