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
        self._before = self._last = (0.0, 0.0)
        """Time and position of the last two set-points."""

    @property
    def spacing_s(self) -> float:
        """Time between the last two set-points."""
        return min(self._last[0] - self._before[0], LONGEST_SPACING_S)

    def begin(self, series: int, patience_s: float, time_s: float, position_deg: float) -> None:
        """Begin at rest; ``patience_s``: longest time without a set-point at rest."""
        self._series, self._patience_s, self.received_s = series, patience_s, math.nan
        self._before = self._last = (time_s + FIRST_KNOT_S, position_deg)

    def at(self, time_s: float) -> float | None:
        """The position at a time that never decreases; None once the set-points have ended."""
        before, last = self._before, self._last
        for _ in range(KNOTS_A_TURN):
            if before is not last and last[0] >= time_s:
                break
            knot = self._knots.take()
            if knot is None:
                break
            series, due_s, position_deg, received_s = knot
            if series != self._series:
                continue
            if math.isnan(position_deg):
                return None
            if before is last or due_s > last[0]:
                before = (time_s, last[1]) if before is last else last
                last = (due_s if due_s > before[0] else math.nextafter(before[0], math.inf), position_deg)
                self.received_s = received_s
        self._before, self._last = before, last
        if before is last:
            return last[1] if time_s <= last[0] else None
        length_s, step_deg = last[0] - before[0], last[1] - before[1]
        patience_s = max(length_s, BRIDGED * self._patience_s) if step_deg else self._patience_s
        if time_s > last[0] + patience_s:
            return None
        return before[1] + step_deg * max(time_s - before[0], 0.0) / length_s if step_deg else last[1]
