"""The knots of a stream, from the shared memory to the set-point, a few before each turn."""

from __future__ import annotations

from typing import Final

from hdbridge.daemon.memory.knots import KnotQueue
from hdbridge.errors import InputError
from hdbridge.motion import SetPoint

KNOTS_A_TURN: Final = 4
"""Knots handed to the set-point before each turn."""
STALE_KNOTS_A_TURN: Final = 64
"""Knots of another stream thrown away before each turn."""


class KnotFeed:
    """Of one axis; idle until a stream begins."""

    __slots__ = ("_ending", "_knots", "_set_point", "_stream")

    def __init__(self, knots: KnotQueue, set_point: SetPoint) -> None:
        self._knots, self._set_point = knots, set_point
        self._stream: int | None = None
        self._ending = False

    def begin(self, stream: int, timeout_s: float) -> None:
        """Follow the knots of this number from the next turn on. InputError in motion, or of the time-out."""
        self._set_point.stream(timeout_s)
        self._set_point.begin_stream()
        self._stream, self._ending = stream, False

    def end(self) -> None:
        """No more knots come: at the last one the stream ends."""
        self._ending = True

    def leave(self) -> None:
        """The axis does something else: what waits is thrown away."""
        if self._stream is not None:
            self._stream = None
            self._knots.clear()

    def feed(self) -> str | None:
        """Hand over the next knots; why one was refused (the axis then brakes), else None."""
        if self._stream is None:
            return None
        set_point, take = self._set_point, self._knots.take
        taken = 0
        for _ in range(STALE_KNOTS_A_TURN):
            if taken == KNOTS_A_TURN or not set_point.room:
                return None
            knot = take()
            if knot is None:
                break
            if knot.stream != self._stream:
                continue
            taken += 1
            try:
                set_point.knot(knot.time_s, knot.position_deg, knot.velocity_deg_s)
            except InputError as error:
                self.leave()
                set_point.stop()
                return str(error)
        if self._ending and not taken and set_point.at_rest:
            set_point.stop()
        return None
