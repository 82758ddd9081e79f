"""Time as the control loop sees it: a monotonic clock that is passed in, never looked up.

Wall clocks step and drift, so no deadline in hdbridge is made from one.
"""

import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock and the art of waiting on it."""

    def now(self) -> float:
        """Seconds on a monotonic clock of arbitrary zero."""
        ...

    def sleep_until(self, deadline_s: float) -> None:
        """Return at ``deadline_s`` (on this clock), or at once when it has passed."""
        ...


class MonotonicClock:
    """The machine's own monotonic clock, with absolute deadlines.

    Sleeping to an absolute deadline does not add up errors: a late wake-up is followed by a shorter sleep.
    """

    def now(self) -> float:
        """Seconds of ``time.monotonic``."""
        return time.monotonic()

    def sleep_until(self, deadline_s: float) -> None:
        """Sleep to the absolute deadline."""
        delay = deadline_s - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
