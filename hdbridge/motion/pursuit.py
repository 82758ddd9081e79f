"""Pursuit of a position that another source supplies in each period, within the limits of the axis."""

import math

from hdbridge.motion.generator import Bounds, Kinematics
from hdbridge.motion.procedures.moves import MotionLimits

_ROUNDING = 1e-6


class Pursuit:
    """Reaches each goal exactly if the limits permit it, else approaches it at the acceleration limit.

    If goals are interpolated linearly between set-points, their velocity changes in steps, even on a path
    within the limits. A goal is therefore reached exactly if the change of its velocity is no larger than the
    acceleration limit permits from one set-point to the next. A goal outside the bounds is pursued up to the
    bound. Jerk is not limited, as in a stream of knots.
    """

    def __init__(self, begin_deg: float, limits: MotionLimits, bounds: Bounds, period_s: float) -> None:
        self._acceleration, self._period_s = limits.acceleration_deg_s2, period_s
        self._fastest = limits.velocity_deg_s * (1.0 + _ROUNDING)
        self._lower, self._upper = bounds
        self._goal_deg = begin_deg
        self.state = Kinematics(begin_deg, 0.0, 0.0)
        """Position, velocity and acceleration at the end of the last period."""

    @property
    def at_rest(self) -> bool:
        """True if the set-point is at rest at its goal."""
        return self.state.velocity_deg_s == 0.0 and self.state.position_deg == self._goal_deg

    def step(self, goal_deg: float, spacing_s: float = 0.0) -> Kinematics:
        """Moves towards ``goal_deg`` (finite) for one period, and returns the new state.

        ``spacing_s`` is the time between the set-points from which the goal was interpolated.
        """
        lower, upper, acceleration, period_s = self._lower, self._upper, self._acceleration, self._period_s
        before_deg = self._goal_deg
        self._goal_deg = goal_deg = lower if goal_deg < lower else upper if goal_deg > upper else goal_deg
        position, velocity, _ = self.state
        wanted = (goal_deg - position) / period_s
        speed, room_deg = (wanted, upper - position) if wanted > 0.0 else (-wanted, position - lower)
        rate, allowed = (goal_deg - before_deg) / period_s, acceleration * (period_s + spacing_s)
        if (
            speed <= self._fastest
            and abs(wanted - velocity) <= allowed
            and abs(wanted - rate) <= allowed  # else it would pass a goal that it catches up with
            and speed <= self._speed(room_deg)
        ):
            position = goal_deg
        else:
            away, change = goal_deg - position, acceleration * period_s
            wanted = rate + math.copysign(self._speed(abs(away)), away)
            # The speed is limited such that the axis can brake before its bounds, wherever the goal moves.
            least = max(-self._fastest, velocity - change, -self._speed(position - lower))
            most = min(self._fastest, velocity + change, self._speed(upper - position))
            wanted = min(max(wanted, least), most)
            position = min(max(position + wanted * period_s, lower), upper)
        self.state = state = tuple.__new__(Kinematics, (position, wanted, (wanted - velocity) / period_s))
        return state

    def _speed(self, distance_deg: float) -> float:
        """Returns the highest speed in the next period from which the axis can brake within this distance.

        The speed is constant in each period, and decreases by at most the acceleration limit per period.
        """
        if distance_deg <= 0.0:
            return 0.0
        change = self._acceleration * self._period_s
        distance = distance_deg / (change * self._period_s)
        whole = math.floor(math.sqrt(0.25 + 2.0 * distance) - 0.5)  # the speed in units of ``change``
        return change * (distance / (whole + 1.0) + 0.5 * whole)
