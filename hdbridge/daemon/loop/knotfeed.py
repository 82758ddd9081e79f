"""Transfer of a stream's knots from the shared memory to the set-point, a few before each turn."""

from typing import Final

from hdbridge.daemon.memory.channels import Queue
from hdbridge.daemon.memory.layout import Knot
from hdbridge.errors import InputError
from hdbridge.motion import SetPoint

KNOTS_A_TURN: Final = 4
"""Knots handed to the set-point before each turn."""
STALE_KNOTS_A_TURN: Final = 64
"""Knots of other streams discarded before each turn."""


class KnotFeed:
    """Knot feed of one axis; idle until a stream begins.

    Stream numbers increase. Knots of a stream that is over are discarded. Those of a later stream wait until
    it begins, because they may be handed over shortly before the present one ends.
    """

    def __init__(self, knots: Queue[Knot], set_point: SetPoint) -> None:
        self._knots, self._set_point = knots, set_point
        self._stream = 0
        """Number of the present stream, or of the last one."""
        self._following = False
        self._ending = False

    def begin(self, stream: int, timeout_s: float) -> None:
        """Follows the knots of this stream from the next turn on.

        Raises InputError if the axis is in motion, the time-out is invalid, or the number is not above the
        last one.
        """
        if stream <= self._stream:
            raise InputError(
                f"a stream of number {stream} after number {self._stream}: expected a greater one"
            )
        self._set_point.stream(timeout_s)
        self._set_point.begin_stream()
        self._stream, self._following, self._ending = stream, True, False

    def end(self) -> None:
        """Announces that no more knots come; the stream ends at the last one."""
        self._ending = True

    def leave(self) -> None:
        """Stops following the stream; its waiting knots are discarded."""
        self._following = False

    def feed(self) -> str | None:
        """Hands over the next knots. If one is refused, brakes the axis and returns the reason; else None."""
        knots, set_point, stream = self._knots, self._set_point, self._stream
        taken = 0
        for _ in range(STALE_KNOTS_A_TURN):
            knot = knots.peek()
            if knot is None or knot.stream > stream:
                break
            if knot.stream < stream or not self._following:
                knots.drop()
                continue
            if taken == KNOTS_A_TURN or not set_point.room:
                return None
            taken += 1
            knots.drop()
            try:
                set_point.knot(knot.time_s, knot.position_deg, knot.velocity_deg_s)
            except InputError as error:
                self.leave()
                set_point.stop()
                return str(error)
        if self._following and self._ending and not taken and set_point.at_rest:
            set_point.stop()
        return None
