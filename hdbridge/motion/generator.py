"""Jerk-limited plans of one axis from any present state, by ruckig on line.

A plan is checked before it is given: it ends where it was asked to, in finite time, and stays within the
bounds and the axis's velocity. Whatever ruckig cannot solve, or solves outside of the bounds, is None here,
and the caller decides what is safe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Trajectory

from hdbridge.procedures.moves import MotionLimits

SOLVED = frozenset({Result.Working, Result.Finished})
SHARES = (1.0, 1.0 - 1e-6)
"""Ruckig finds nothing where limits and distance meet in a point; a hair slower it does."""
_MISS_DEG = 1e-6
"""A plan whose end is farther from its target than this is none: ruckig was out of its depth."""
_ROUNDING_DEG = 1e-9


_NEAR_END = 0.999
"""Share of a path's time at which it still comes from where it has been last."""
_HALVINGS = 30
_At = Callable[[float], tuple[list[float], list[float], list[float]]]


class Kinematics(NamedTuple):
    """Position, velocity and acceleration of the set-point, at the load."""

    position_deg: float
    velocity_deg_s: float
    acceleration_deg_s2: float


class Bounds(NamedTuple):
    """Between which positions a plan may lead."""

    lower_deg: float
    upper_deg: float


class Plan(NamedTuple):
    """A path to rest, over the time since it was made."""

    begin_deg: float
    end_deg: float
    duration_s: float
    at: _At
    """Position (from ``begin_deg``), velocity and acceleration of one degree of freedom."""

    def state(self, time_s: float) -> Kinematics:
        """Where it is after so long; at rest, exactly at its end, when it is over."""
        if time_s >= self.duration_s:
            return Kinematics(self.end_deg, 0.0, 0.0)
        position, velocity, acceleration = self.at(time_s)
        return Kinematics(self.begin_deg + position[0], velocity[0], acceleration[0])


def _turn(velocity_deg_s: float, at: _At, duration_s: float) -> float:
    """Where a path that begins at this velocity turns back, from its beginning; 0 where it does not.

    Ruckig's own extremes miss it where the acceleration at the beginning is beyond the plan's limit.
    """
    later = _NEAR_END * duration_s
    if not velocity_deg_s or velocity_deg_s * at(later)[1][0] >= 0.0:
        return 0.0
    before = 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (before + later)
        if velocity_deg_s * at(middle)[1][0] > 0.0:
            before = middle
        else:
            later = middle
    return float(at(later)[0][0])


class Generator:
    """Makes plans within the limits of one axis, or slower ones."""

    def __init__(self, limits: MotionLimits) -> None:
        self._limits = limits
        self._ruckig = Ruckig(1)
        self._demand = InputParameter(1)
        self._demand.max_jerk = [limits.jerk_deg_s3]

    def to_position(
        self,
        now: Kinematics,
        target_deg: float,
        bounds: Bounds,
        velocity_deg_s: float = math.inf,
        acceleration_deg_s2: float = math.inf,
    ) -> Plan | None:
        """The fastest way to rest at a position; no faster than the axis, whatever is asked for.

        The present velocity and acceleration may be beyond what is asked for: they are brought down first.
        """
        self._demand.control_interface = ControlInterface.Position
        # From where it stands: what is planned does not depend on how far from zero that is.
        self._demand.target_position = [target_deg - now.position_deg]
        plan = self._plan(now, velocity_deg_s, acceleration_deg_s2, bounds)
        if plan is None or abs(plan.end_deg - target_deg) > _MISS_DEG:
            return None
        return plan._replace(end_deg=target_deg)

    def to_rest(self, now: Kinematics, bounds: Bounds) -> Plan | None:
        """The fastest way to rest, wherever that is."""
        self._demand.control_interface = ControlInterface.Velocity
        return self._plan(now, math.inf, math.inf, bounds)

    def _plan(
        self, now: Kinematics, velocity_deg_s: float, acceleration_deg_s2: float, bounds: Bounds
    ) -> Plan | None:
        demand, limits = self._demand, self._limits
        begin_deg = now.position_deg
        # The acceleration has to come down first, at the limit of jerk; the velocity goes on until it has.
        eased = now.acceleration_deg_s2 * abs(now.acceleration_deg_s2) / (2.0 * limits.jerk_deg_s3)
        if abs(now.velocity_deg_s + eased) > limits.velocity_deg_s * (1.0 + 1e-6):
            return None
        demand.current_position = [0.0]
        demand.current_velocity = [now.velocity_deg_s]
        demand.current_acceleration = [now.acceleration_deg_s2]
        for share in SHARES:
            demand.max_velocity = [share * min(velocity_deg_s, limits.velocity_deg_s)]
            demand.max_acceleration = [share * min(acceleration_deg_s2, limits.acceleration_deg_s2)]
            trajectory = Trajectory(1)
            try:
                if self._ruckig.calculate(demand, trajectory) not in SOLVED:
                    continue
            except RuckigError:
                continue
            duration_s = float(trajectory.duration)
            if not math.isfinite(duration_s):
                continue
            extremes = trajectory.position_extrema[0]
            position, velocity, _ = trajectory.at_time(duration_s)
            turn_deg = begin_deg + _turn(now.velocity_deg_s, trajectory.at_time, duration_s)
            if (
                begin_deg + extremes.min >= bounds.lower_deg - _ROUNDING_DEG
                and begin_deg + extremes.max <= bounds.upper_deg + _ROUNDING_DEG
                and bounds.lower_deg - _ROUNDING_DEG <= turn_deg <= bounds.upper_deg + _ROUNDING_DEG
                and abs(velocity[0]) <= _MISS_DEG
            ):
                return Plan(begin_deg, begin_deg + float(position[0]), duration_s, trajectory.at_time)
        return None
