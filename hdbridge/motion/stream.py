"""Knots of position and velocity over time, and the cubics between them.

A knot is checked on arrival, together with the whole path to it, because the extremes of a cubic's position,
speed and acceleration are known in closed form. Accepted knots can therefore be followed to the end without
further checks.
"""

import math
from collections import deque
from typing import NamedTuple, Self

from hdbridge.errors import InputError
from hdbridge.motion.generator import Bounds, Kinematics
from hdbridge.motion.procedures.moves import MotionLimits

MOST_KNOTS = 8192
"""Maximum number of buffered knots; further ones are refused."""
ACCELERATION_MARGIN = 1.05
"""Permitted ratio of a cubic's acceleration to the limit. Cubics through knots of a path at the limit can
exceed it by this."""
BEGIN_DEG = 1e-6
"""Maximum distance of a stream's first knot from the set-point."""
_ROUNDING = 1e-6
_REST_DEG_S = 1e-9


class Cubic(NamedTuple):
    """Hermite cubic from one knot to the next, as a function of normalised time s, 0 to 1."""

    begin_s: float
    end_s: float
    begin_deg: float
    end_deg: float
    a: float
    b: float
    c: float
    """Coefficients of the position begin + s (a + s (b + s c)), degrees."""

    @classmethod
    def between(
        cls,
        begin_s: float,
        begin_deg: float,
        from_deg_s: float,
        end_s: float,
        end_deg: float,
        to_deg_s: float,
    ) -> Self:
        """Returns the cubic with these times, positions and velocities at its ends."""
        period_s = end_s - begin_s
        step = end_deg - begin_deg
        here, there = from_deg_s * period_s, to_deg_s * period_s
        return cls(
            begin_s, end_s, begin_deg, end_deg,
            here, 3.0 * step - 2.0 * here - there, here + there - 2.0 * step,
        )  # fmt: skip

    @property
    def duration_s(self) -> float:
        """Time from one end of the cubic to the other."""
        return self.end_s - self.begin_s

    def state(self, time_s: float) -> Kinematics:
        """Returns the state at a time; for a time outside the cubic, the state at its nearer end."""
        period_s = self.end_s - self.begin_s
        s = 1.0 if time_s >= self.end_s else max(time_s - self.begin_s, 0.0) / period_s
        return Kinematics(
            self.end_deg if s == 1.0 else self.begin_deg + s * (self.a + s * (self.b + s * self.c)),
            (self.a + s * (2.0 * self.b + 3.0 * s * self.c)) / period_s,
            (2.0 * self.b + 6.0 * s * self.c) / (period_s * period_s),
        )

    def fastest_deg_s(self) -> float:
        """Returns the highest speed on the cubic."""
        speed = max(abs(self.a), abs(self.a + 2.0 * self.b + 3.0 * self.c))
        if self.c:
            vertex = -self.b / (3.0 * self.c)
            if 0.0 < vertex < 1.0:
                speed = max(speed, abs(self.a + self.b * vertex))
        return speed / self.duration_s

    def hardest_deg_s2(self) -> float:
        """Returns the highest acceleration on the cubic, which is that at one of its ends."""
        return max(abs(2.0 * self.b), abs(2.0 * self.b + 6.0 * self.c)) / (self.duration_s * self.duration_s)

    def extremes_deg(self) -> tuple[float, float]:
        """Returns the lowest and the highest position on the cubic."""
        places = [self.begin_deg, self.end_deg]
        root = self.b * self.b - 3.0 * self.a * self.c
        if root > 0.0:
            # Numerically stable roots of a + 2 b s + 3 c s^2, also for c = 0.
            q = -(self.b + math.copysign(math.sqrt(root), self.b))
            for over, under in ((q, 3.0 * self.c), (self.a, q)):
                if under and 0.0 < (s := over / under) < 1.0:
                    places.append(self.begin_deg + s * (self.a + s * (self.b + s * self.c)))
        return min(places), max(places)


class Stream:
    """Path through the knots of one stream, in the stream's own time.

    If no further knot is available at a knot with zero velocity, the stream rests until one arrives. Its time
    is halted meanwhile, so late knots delay the path and cause no jump. If the stream runs out of knots in
    motion, ``overrun_s`` is the time since then.
    """

    def __init__(self, begin_deg: float, limits: MotionLimits, bounds: Bounds, period_s: float) -> None:
        self._limits, self._bounds = limits, bounds
        self._period_s = period_s
        self._grid_s = 1e-7 * period_s
        """Time resolution; closer times count as equal."""
        self._cubics: deque[Cubic] = deque()
        self._begin_deg = begin_deg
        self._last: tuple[float, float, float] | None = None
        """Last accepted knot."""
        self._base_s = 0.0
        """Stream time at the last rest."""
        self._steps = 0
        """Number of periods since the last rest."""
        self._released = self._begun = False
        self.overrun_s: float | None = None
        """Time since the stream ran out of knots in motion; the state is then that of the last knot. Else
        None."""
        self._state = Kinematics(begin_deg, 0.0, 0.0)

    @property
    def room(self) -> int:
        """Number of further knots for which there is room."""
        return MOST_KNOTS - len(self._cubics)

    @property
    def waiting(self) -> bool:
        """True if the stream is at rest because it has no further knots."""
        return not self._cubics and self._state.velocity_deg_s == 0.0

    @property
    def state(self) -> Kinematics:
        return self._state

    def add(self, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        """Adds a knot; if it is not acceptable, raises `InputError` and leaves the stream unchanged."""
        if not (math.isfinite(time_s) and math.isfinite(position_deg) and math.isfinite(velocity_deg_s)):
            raise InputError(
                f"the knot is {position_deg!r} deg and {velocity_deg_s!r} deg/s at {time_s!r} s; expected "
                "finite numbers"
            )
        if not self.room:
            raise InputError(
                f"{MOST_KNOTS} knots are in the buffer; send the next ones as the axis passes these"
            )
        if abs(velocity_deg_s) < _REST_DEG_S:
            velocity_deg_s = 0.0
        if self._last is None:
            self._add_first(time_s, position_deg, velocity_deg_s)
            return
        last_s, last_deg, last_deg_s = self._last
        if time_s - last_s <= 10.0 * self._grid_s:
            raise InputError(
                f"the knot at {time_s:.9g} s follows one at {last_s:.9g} s; expected increasing times"
            )
        cubic = Cubic.between(last_s, last_deg, last_deg_s, time_s, position_deg, velocity_deg_s)
        self._check(cubic, time_s, position_deg, velocity_deg_s)
        self._cubics.append(cubic)
        self._last = (time_s, position_deg, velocity_deg_s)

    def _add_first(self, time_s: float, position_deg: float, velocity_deg_s: float) -> None:
        begin_deg = self._begin_deg
        if time_s < 0.0:
            raise InputError(f"the first knot is at {time_s:g} s; the time of a stream begins at 0")
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
        where = f"the segment to the knot at {time_s:.6g} s"
        fastest, hardest = cubic.fastest_deg_s(), cubic.hardest_deg_s2()
        lowest, highest = cubic.extremes_deg()
        # Velocity error due to rounding of the positions.
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
                f"{where} covers {lowest:.9g} to {highest:.9g} deg; the position limits are "
                f"{bounds.lower_deg:g} and {bounds.upper_deg:g} deg"
            )
        left_deg = (bounds.upper_deg if velocity_deg_s > 0.0 else bounds.lower_deg) - position_deg
        if velocity_deg_s * velocity_deg_s > 2.0 * most * abs(left_deg) * (1.0 + _ROUNDING):
            raise InputError(
                f"the knot at {time_s:.6g} s has {velocity_deg_s:.4g} deg/s so near to the position limit "
                "that the axis could not brake before it"
            )

    def begin(self) -> None:
        """Starts the stream's time with the next step, or with the first step at which there is a knot."""
        self._released = True

    def step(self) -> Kinematics:
        """Advances by one period and returns the state."""
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
        """Handles the last knot: rests if its velocity is zero, else sets ``overrun_s`` once it is passed."""
        if self._last is not None and self._last[2] == 0.0:
            self._cubics.clear()
            self._state = Kinematics(cubic.end_deg, 0.0, 0.0)
            self._base_s, self._steps = cubic.end_s, 0
            return
        self._state = cubic.state(cubic.end_s)
        if time_s > cubic.end_s + self._grid_s:
            self.overrun_s = time_s - cubic.end_s
