"""Clock of the control loop: a monotonic clock that is passed to its users rather than imported.

Wall clocks step and drift, so no deadline in hdbridge depends on them.
"""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic clock with waiting."""

    def now(self) -> float:
        """Returns the time of this clock in seconds, from an arbitrary origin."""
        ...

    def sleep_until(self, deadline_s: float) -> None:
        """Returns at ``deadline_s`` (on this clock), or at once if it has passed."""
        ...


class MonotonicClock:
    """Monotonic clock of the computer, with absolute deadlines.

    Unlike ``time.monotonic``, it counts the time in which the computer is suspended. A drive may have stopped
    meanwhile, and a target that was sent before must not move it.

    Sleeping to an absolute deadline does not accumulate errors, because a late wake-up is followed by a
    shorter sleep.
    """

    def now(self) -> float:
        """Returns the seconds since the computer was started (``CLOCK_BOOTTIME``)."""
        return time.clock_gettime(time.CLOCK_BOOTTIME)

    def sleep_until(self, deadline_s: float) -> None:
        """Sleeps until the absolute deadline."""
        delay = deadline_s - self.now()
        if delay > 0.0:
            time.sleep(delay)
