"""Filters the reception jitter out of the time and period of SYNC."""

from typing import Final

LONGEST_PERIOD_S: Final = 1.0
SHORTEST_PERIOD_S: Final = 0.000_5
_GAIN: Final = 0.05
"""Final gain of the time correction; the gain of the period is half its square."""
_ASTRAY: Final = 0.5
"""Deviation above which tracking restarts at the current SYNC; periods."""
_ANOTHER: Final = 0.1
_AGREEING: Final = 3
"""Number of successive intervals that agree within `_ANOTHER` but differ from the period, after which the
period is set to the last of them."""


class SyncClock:
    """Second-order tracking filter, which follows a constant drift between two clocks without error.

    Its gains are initially those of a least-squares line through all SYNCs, and constant later.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.time_s = self._received_s = -float("inf")
        self._interval_s = self.jitter_s = 0.0
        """Last interval between two SYNCs; mean absolute deviation of SYNC from its filtered time, over about
        the last 20 SYNCs."""
        self._count = self._agreeing = 0

    def take(self, now_s: float) -> None:
        """Updates the filter with a received SYNC; ``time_s`` is then its filtered time, without jitter."""
        before_s, self._interval_s = self._interval_s, now_s - self._received_s
        self._received_s = now_s
        interval_s = self._interval_s
        if not SHORTEST_PERIOD_S <= interval_s <= LONGEST_PERIOD_S:
            self.time_s, self._agreeing = now_s, 0
            self._count = min(self._count, 1) if interval_s > LONGEST_PERIOD_S else self._count
            self._count = self._count or 1
            return
        strange = abs(interval_s - self.period_s) > _ANOTHER * self.period_s
        agrees = abs(interval_s - before_s) <= _ANOTHER * interval_s
        self._agreeing = self._agreeing + 1 if strange and (agrees or not self._agreeing) else 0
        if self._count == 1 or self._agreeing >= _AGREEING:
            self.time_s, self.period_s = now_s, interval_s
            self._count, self._agreeing = 2, 0
            return
        error_s = now_s - self.time_s - self.period_s
        self.jitter_s += _GAIN * (abs(error_s) - self.jitter_s)
        if abs(error_s) > _ASTRAY * self.period_s:
            self.time_s = now_s
            return
        self._count += 1
        count = self._count
        self.time_s = now_s - error_s * (1.0 - max(_GAIN, (4.0 * count - 2.0) / (count * (count + 1.0))))
        self.period_s += error_s * max(0.5 * _GAIN * _GAIN, 6.0 / (count * (count + 1.0)))
