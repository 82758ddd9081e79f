"""Knots of position and velocity over time, and the cubics between them.

A knot is checked when it comes, with the whole way to it: position, speed and acceleration of a cubic have
their extremes in closed form. So what has been taken can be followed to its end without another question.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from hdbridge.errors import InputError
from hdbridge.motion.generator import Bounds, Kinematics
from hdbridge.procedures.moves import MotionLimits

MOST_KNOTS = 8192
"""Knots that wait; a further one is refused."""
ACCELERATION_MARGIN = 1.05
"""Share of the acceleration limit that a cubic may reach: one through knots of a path at the limit does."""
BEGIN_DEG = 1e-6
"""A stream begins so near to where the set-point stands."""
_ROUNDING = 1e-6
_REST_DEG_S = 1e-9


class Cubic(NamedTuple):
    """Hermite's: from one knot to the next, over the share of the time between them."""

    begin_s: float
    end_s: float
    begin_deg: float
    end_deg: float
    a: float
    b: float
    c: float
    """begin + s (a + s (b + s c)), degrees."""

    @classmethod
    def between(
        cls,
        begin_s: float,
        begin_deg: float,
        from_deg_s: float,
        end_s: float,
        end_deg: float,
        to_deg_s: float,
    ) -> Cubic:
        """The one with these ends."""
        period_s = end_s - begin_s
        step = end_deg - begin_deg
        here, there = from_deg_s * period_s, to_deg_s * period_s
        return cls(
            begin_s, end_s, begin_deg, end_deg,
            here, 3.0 * step - 2.0 * here - there, here + there - 2.0 * step,
        )  # fmt: skip

    @property
    def duration_s(self) -> float:
        """Time between its ends."""
        return self.end_s - self.begin_s

    def state(self, time_s: float) -> Kinematics:
        """Where it is at this time; before and after its ends it is at them."""
        period_s = self.end_s - self.begin_s
        s = 1.0 if time_s >= self.end_s else max(time_s - self.begin_s, 0.0) / period_s
        return Kinematics(
            self.end_deg if s == 1.0 else self.begin_deg + s * (self.a + s * (self.b + s * self.c)),
            (self.a + s * (2.0 * self.b + 3.0 * s * self.c)) / period_s,
            (2.0 * self.b + 6.0 * s * self.c) / (period_s * period_s),
        )

    def fastest_deg_s(self) -> float:
        """Largest speed."""
        speed = max(abs(self.a), abs(self.a + 2.0 * self.b + 3.0 * self.c))
        if self.c:
            vertex = -self.b / (3.0 * self.c)
            if 0.0 < vertex < 1.0:
                speed = max(speed, abs(self.a + self.b * vertex))
        return speed / self.duration_s

    def hardest_deg_s2(self) -> float:
        """Largest acceleration, which is at one of its ends."""
        return max(abs(2.0 * self.b), abs(2.0 * self.b + 6.0 * self.c)) / (self.duration_s * self.duration_s)

    def extremes_deg(self) -> tuple[float, float]:
        """Lowest and highest position."""
        places = [self.begin_deg, self.end_deg]
        root = self.b * self.b - 3.0 * self.a * self.c
        if root > 0.0:
            # Without cancellation, and with c = 0: the two roots of a + 2 b s + 3 c s^2.
            q = -(self.b + math.copysign(math.sqrt(root), self.b))
            for over, under in ((q, 3.0 * self.c), (self.a, q)):
                if under and 0.0 < (s := over / under) < 1.0:
                    places.append(self.begin_deg + s * (self.a + s * (self.b + s * self.c)))
        return min(places), max(places)


class Stream:
    """The knots of one stream, in its own time.

    At a knot of no velocity it rests until there is another; meanwhile its time stands still, so that knots
    that come late delay the path and do not make it jump. Out of knots in motion it says since when.
    """

    def __init__(self, begin_deg: float, limits: MotionLimits, bounds: Bounds, period_s: float) -> None:
        self._limits, self._bounds = limits, bounds
        self._period_s = period_s
        self._grid_s = 1e-7 * period_s
        """Less than this apart two times are one."""
        self._cubics: deque[Cubic] = deque()
        self._begin_deg = begin_deg
        self._last: tuple[float, float, float] | None = None
        """The last knot that was taken."""
        self._base_s = 0.0
        """The stream's time when it rested last."""
        self._steps = 0
        """Periods since then."""
        self._released = self._begun = False
        self.overrun_s: float | None = None
        """How long ago it was left without knots in motion; the state is that of the last knot."""
        self._state = Kinematics(begin_deg, 0.0, 0.0)

    @property
    def room(self) -> int:
        """How many knots would be taken."""
        return MOST_KNOTS - len(self._cubics)

    @property
    def waiting(self) -> bool:
        """Whether it rests for want of knots."""
        return not self._cubics and self._state.velocity_deg_s == 0.0

    @property
    def state(self) -> Kinematics:
        """Where it is now."""
        return self._state

    def add(self, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        """Take one more knot, or refuse it (InputError) and leave the stream as it is."""
        if not (math.isfinite(time_s) and math.isfinite(position_deg) and math.isfinite(velocity_deg_s)):
            raise InputError(
                f"a knot of {position_deg!r} deg and {velocity_deg_s!r} deg/s at {time_s!r} s; expected "
                "finite numbers"
            )
        if not self.room:
            raise InputError(f"{MOST_KNOTS} knots are waiting: send no more than the axis has run")
        if abs(velocity_deg_s) < _REST_DEG_S:
            velocity_deg_s = 0.0
        if self._last is None:
            self._add_first(time_s, position_deg, velocity_deg_s)
            return
        last_s, last_deg, last_deg_s = self._last
        if time_s - last_s <= 10.0 * self._grid_s:
            raise InputError(
                f"a knot at {time_s:.9g} s after one at {last_s:.9g} s: times must rise from knot to knot"
            )
        cubic = Cubic.between(last_s, last_deg, last_deg_s, time_s, position_deg, velocity_deg_s)
        self._check(cubic, time_s, position_deg, velocity_deg_s)
        self._cubics.append(cubic)
        self._last = (time_s, position_deg, velocity_deg_s)

    def _add_first(self, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        begin_deg = self._begin_deg
        if time_s < 0.0:
            raise InputError(f"a first knot at {time_s:g} s; a stream's time begins at 0")
        if abs(position_deg - begin_deg) > BEGIN_DEG or velocity_deg_s:
            raise InputError(
                f"a stream begins at {position_deg:.9g} deg with {velocity_deg_s:g} deg/s, but the axis "
                f"stands at {begin_deg:.9g} deg: begin there, with velocity 0"
            )
        self._last = (time_s, begin_deg, 0.0)
        if time_s > 10.0 * self._grid_s:
            self._cubics.append(Cubic.between(0.0, begin_deg, 0.0, time_s, begin_deg, 0.0))

    def _check(self, cubic: Cubic, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        limits, bounds = self._limits, self._bounds
        where = f"the way to the knot at {time_s:.6g} s"
        fastest, hardest = cubic.fastest_deg_s(), cubic.hardest_deg_s2()
        lowest, highest = cubic.extremes_deg()
        # What differences of rounded positions cannot tell.
        grain = 4.0 * math.ulp(max(abs(cubic.begin_deg), abs(position_deg))) / cubic.duration_s
        if not fastest <= limits.velocity_deg_s * (1.0 + _ROUNDING) + grain:
            raise InputError(
                f"{where} needs {fastest:.4g} deg/s; the axis file allows {limits.velocity_deg_s:g} "
                "(limits.velocity_deg_s)"
            )
        most = ACCELERATION_MARGIN * limits.acceleration_deg_s2
        if not hardest <= most * (1.0 + _ROUNDING) + 6.0 * grain / cubic.duration_s:
            raise InputError(
                f"{where} needs {hardest:.4g} deg/s2; the axis file allows {limits.acceleration_deg_s2:g} "
                "(limits.acceleration_deg_s2)"
            )
        if not (bounds.lower_deg <= lowest and highest <= bounds.upper_deg):
            raise InputError(
                f"{where} leads through {lowest:.9g} to {highest:.9g} deg; the position limits are "
                f"{bounds.lower_deg:g} and {bounds.upper_deg:g} deg"
            )
        left_deg = (bounds.upper_deg if velocity_deg_s > 0.0 else bounds.lower_deg) - position_deg
        if velocity_deg_s * velocity_deg_s > 2.0 * most * abs(left_deg) * (1.0 + _ROUNDING):
            raise InputError(
                f"the knot at {time_s:.6g} s has {velocity_deg_s:.4g} deg/s so near to the position limit "
                "that the axis could not brake before it"
            )

    def begin(self) -> None:
        """Let time begin with the next step, or with the first one that has a knot."""
        self._released = True

    def step(self) -> Kinematics:
        """One period on."""
        if not self._begun:
            self._begun = self._released and self._last is not None
        elif self._cubics:
            self._steps += 1
            self._follow(self._base_s + self._steps * self._period_s)
        return self._state

    def _follow(self, time_s: float) -> None:
        cubics, grid_s = self._cubics, self._grid_s
        cubic = cubics[0]
        while time_s >= cubic.end_s - grid_s:
            if len(cubics) == 1:
                self._end(cubic, time_s)
                return
            cubics.popleft()
            cubic = cubics[0]
        self._state = cubic.state(time_s)

    def _end(self, cubic: Cubic, time_s: float) -> None:
        """The last knot is reached: at rest, in time for another, or lost."""
        if self._last is not None and self._last[2] == 0.0:
            self._cubics.clear()
            self._state = Kinematics(cubic.end_deg, 0.0, 0.0)
            self._base_s, self._steps = cubic.end_s, 0
            return
        self._state = cubic.state(cubic.end_s)
        if time_s > cubic.end_s + self._grid_s:
            self.overrun_s = time_s - cubic.end_s
