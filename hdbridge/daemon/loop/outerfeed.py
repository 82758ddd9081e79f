"""The set-points of the gateway, from the shared memory to a position at any time."""

import math
from typing import Final

from hdbridge.daemon.memory.channels import Queue
from hdbridge.daemon.memory.layout import OuterKnot

KNOTS_A_TURN: Final = 64
LONGEST_SPACING_S: Final = 0.05
BRIDGED: Final = 0.2
"""Time for which a moving axis keeps its speed without a set-point, as a share of the time-out at rest."""
FIRST_KNOT_S: Final = 2.0
"""Longest time from the begin to the first set-point."""


class OuterFeed:
    """Set-points of the outer master for one axis. Between two of them the position is linear (CiA 402).

    A late set-point is bridged at the speed of the last two, because the gateway process has no real-time
    priority. An axis at rest waits for longer. Set-points of another series are dropped, so none from before
    an interruption takes effect.
    """

    def __init__(self, knots: Queue[OuterKnot]) -> None:
        self._knots = knots
        self._series = 0
        self._patience_s = 0.0
        self.received_s = math.nan
        """When the newest set-point was received; NaN before the first."""
        self.spacing_s = 0.0
        """Time between the last two set-points, at most `LONGEST_SPACING_S`."""
        self._first = True
        self._last_s = self._last_deg = self._rate_deg_s = self._end_s = 0.0
        """Time and position of the last set-point, the velocity to it, and the time at which they end."""

    def begin(self, series: int, patience_s: float, time_s: float, position_deg: float) -> None:
        """Begin at rest; ``patience_s``: longest time without a set-point at rest."""
        self._series, self._patience_s, self.received_s = series, patience_s, math.nan
        self._first, self._last_deg, self._rate_deg_s, self.spacing_s = True, position_deg, 0.0, 0.0
        self._last_s = -math.inf
        self._end_s = time_s + FIRST_KNOT_S

    def at(self, time_s: float) -> float | None:
        """The position at a time that never decreases; None once the set-points have ended."""
        for _ in range(KNOTS_A_TURN):
            if self._last_s >= time_s:
                break
            knot = self._knots.take()
            if knot is None:
                break
            series, due_s, position_deg, received_s = knot
            if series != self._series:
                continue
            if math.isnan(position_deg):
                return None
            if self._first or due_s > self._last_s:
                self._take(time_s, due_s, position_deg)
                self.received_s = received_s
        if time_s > self._end_s:
            return None
        rate = self._rate_deg_s
        return self._last_deg + rate * (time_s - self._last_s) if rate else self._last_deg

    def _take(self, time_s: float, due_s: float, position_deg: float) -> None:
        """Continues with the next set-point; the first is approached from the present time."""
        begin_s = time_s if self._first else self._last_s
        length_s, step_deg = due_s - begin_s, position_deg - self._last_deg
        self._first, self._last_s, self._last_deg = False, due_s, position_deg
        self._rate_deg_s = step_deg / length_s if length_s > 0.0 else 0.0
        self.spacing_s = length_s if length_s < LONGEST_SPACING_S else LONGEST_SPACING_S
        patience_s = self._patience_s
        self._end_s = due_s + (max(length_s, BRIDGED * patience_s) if step_deg else patience_s)
