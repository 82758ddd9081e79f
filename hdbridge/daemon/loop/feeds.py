"""Set-points from the shared memory: knots of a client's stream, and those of the gateway."""

import math
from typing import Final

from hdbridge.daemon.memory.channels import Queue
from hdbridge.daemon.memory.layout import Knot, OuterKnot
from hdbridge.errors import InputError
from hdbridge.motion import MotionMode, SetPoint

KNOTS_PER_TURN: Final = 4
"""Number of knots passed to the set-point before each cycle."""
STALE_KNOTS_PER_TURN: Final = 64
"""Number of knots of other streams discarded before each cycle."""
OUTER_KNOTS_PER_TURN: Final = 64
LONGEST_SPACING_S: Final = 0.05
BRIDGED_SHARE: Final = 0.2
"""Time for which a moving axis keeps its speed without a set-point, as a fraction of the time-out at rest."""
FIRST_KNOT_S: Final = 2.0
"""Maximum time from `OuterFeed.begin` to the first set-point."""


class KnotFeed:
    """Passes the knots of a client's stream to the set-point of one axis; idle until a stream begins.

    Stream numbers increase. Knots of an ended stream are discarded. Knots of a later stream wait until it
    begins, because the service may queue them shortly before the current stream ends.
    """

    def __init__(self, knots: Queue[Knot], set_point: SetPoint) -> None:
        self._knots, self._set_point = knots, set_point
        self._stream = 0
        """Number of the current stream; between streams, that of the last one."""
        self._ending = False

    def begin(self, stream: int, timeout_s: float) -> None:
        """Follows the knots of this stream from the next cycle on.

        Raises InputError if the axis is in motion, the time-out is invalid, or the number is not above the
        last number.
        """
        if stream <= self._stream:
            raise InputError(f"stream number {stream} follows {self._stream}; expected a larger number")
        self._set_point.stream(timeout_s)
        self._set_point.begin_stream()
        self._stream, self._ending = stream, False

    def end(self) -> None:
        """Announces the end of the knots; the stream ends at the last knot."""
        self._ending = True

    def feed(self) -> str | None:
        """Passes on the next knots. If one is refused, brakes the axis and returns the reason, else None."""
        knots, set_point, stream = self._knots, self._set_point, self._stream
        following = set_point.mode is MotionMode.STREAM
        taken = 0
        for _ in range(STALE_KNOTS_PER_TURN):
            knot = knots.peek()
            if knot is None or knot.stream > stream:
                break
            if knot.stream < stream or not following:
                knots.drop()
                continue
            if taken == KNOTS_PER_TURN or not set_point.room:
                return None
            taken += 1
            knots.drop()
            try:
                set_point.knot(knot.time_s, knot.position_deg, knot.velocity_deg_s)
            except InputError as error:
                set_point.stop()
                return str(error)
        if following and self._ending and not taken and set_point.at_rest:
            set_point.stop()
        return None


class OuterFeed:
    """Set-points of the outer master for one axis, with linear motion between them (CiA 402).

    A delayed set-point is bridged at the speed of the last two, because the gateway process has no real-time
    priority. At rest the axis waits longer. Set-points of another series are dropped, so none from before an
    interruption takes effect.
    """

    def __init__(self, knots: Queue[OuterKnot]) -> None:
        self._knots = knots
        self.begin(0, 0.0, 0.0, 0.0)

    def begin(self, series: int, patience_s: float, time_s: float, position_deg: float) -> None:
        """Begins at rest; ``patience_s`` is the maximum time at rest without a set-point."""
        self._series, self._patience_s = series, patience_s
        self.received_s = math.nan
        """Time of reception of the newest set-point; NaN before the first."""
        self.spacing_s = 0.0
        """Time between the last two set-points, at most `LONGEST_SPACING_S`."""
        self._last_s, self._last_deg, self._rate_deg_s = -math.inf, position_deg, 0.0
        """Time and position of the last set-point, and the velocity to it."""
        self._end_s = time_s + FIRST_KNOT_S
        """Time at which the set-points end."""

    def at(self, time_s: float) -> float | None:
        """Returns the position at ``time_s``, which must not decrease; None after the last set-point."""
        for _ in range(OUTER_KNOTS_PER_TURN):
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
            if due_s > self._last_s:
                self._take(time_s, due_s, position_deg)
                self.received_s = received_s
        if time_s > self._end_s:
            return None
        rate = self._rate_deg_s
        return self._last_deg + rate * (time_s - self._last_s) if rate else self._last_deg

    def _take(self, time_s: float, due_s: float, position_deg: float) -> None:
        """Continues with the next set-point; the motion to the first one starts at the current time."""
        begin_s = time_s if self._last_s == -math.inf else self._last_s
        length_s, step_deg = due_s - begin_s, position_deg - self._last_deg
        self._last_s, self._last_deg = due_s, position_deg
        self._rate_deg_s = step_deg / length_s if length_s > 0.0 else 0.0
        self.spacing_s = length_s if length_s < LONGEST_SPACING_S else LONGEST_SPACING_S
        patience_s = self._patience_s
        self._end_s = due_s + (max(length_s, BRIDGED_SHARE * patience_s) if step_deg else patience_s)
