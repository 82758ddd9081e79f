"""Computes jerk-limited plans of one axis from any current state, on line, with ruckig.

A plan is checked before it is returned: it ends at its target, in finite time, and stays within the bounds
and the axis's velocity limit. The result is None if ruckig finds no solution within the bounds. The caller
then decides on a safe reaction.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from ruckig import ControlInterface, InputParameter, Ruckig

from hdbridge.motion.procedures.moves import MotionLimits, solutions

_MISS_DEG = 1e-6
"""Maximum distance of a plan's end from its target; a larger one is a numerical failure of ruckig."""
_ROUNDING_DEG = 1e-9


_NEAR_END = 0.999
"""Fraction of a path's duration, just before its end, at which the final direction of motion is evaluated."""
_HALVINGS = 30
_At = Callable[[float], tuple[list[float], list[float], list[float]]]


class Kinematics(NamedTuple):
    """Position, velocity and acceleration of the set-point, at the load."""

    position_deg: float
    velocity_deg_s: float
    acceleration_deg_s2: float


class Bounds(NamedTuple):
    """Position range within which a plan must stay."""

    lower_deg: float
    upper_deg: float


class Plan(NamedTuple):
    """Path from the current state to rest, as a function of the time since its start."""

    begin_deg: float
    end_deg: float
    duration_s: float
    at: _At
    """Function that returns position (relative to ``begin_deg``), velocity and acceleration at a time, as
    lists of one number each."""

    def state(self, time_s: float) -> Kinematics:
        """Returns the state at this time; from the end of the path on, rest exactly at ``end_deg``."""
        if time_s >= self.duration_s:
            return Kinematics(self.end_deg, 0.0, 0.0)
        position, velocity, acceleration = self.at(time_s)
        return Kinematics(self.begin_deg + position[0], velocity[0], acceleration[0])


def _turn(velocity_deg_s: float, at: _At, duration_s: float) -> float:
    """Returns the position, relative to the start, at which a path with this initial velocity reverses.

    Returns 0 if it does not reverse. Ruckig's own extremes omit this position if the initial acceleration
    exceeds the plan's limit.
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
    """Computes plans within the limits of one axis, or within lower limits."""

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
        """Returns the fastest path to rest at a position, or None.

        The axis's limits apply even if higher values are requested. If the current velocity or acceleration
        exceeds the requested one, it is reduced first.
        """
        self._demand.control_interface = ControlInterface.Position
        # Positions are relative to the current one, so that rounding does not depend on the distance from
        # zero.
        self._demand.target_position = [target_deg - now.position_deg]
        plan = self._plan(now, velocity_deg_s, acceleration_deg_s2, bounds)
        if plan is None or abs(plan.end_deg - target_deg) > _MISS_DEG:
            return None
        return plan._replace(end_deg=target_deg)

    def to_rest(self, now: Kinematics, bounds: Bounds) -> Plan | None:
        """Returns the fastest path to rest, at any position within the bounds, or None."""
        self._demand.control_interface = ControlInterface.Velocity
        return self._plan(now, math.inf, math.inf, bounds)

    def _plan(
        self, now: Kinematics, velocity_deg_s: float, acceleration_deg_s2: float, bounds: Bounds
    ) -> Plan | None:
        demand, limits = self._demand, self._limits
        begin_deg = now.position_deg
        # The acceleration must first be reduced at the jerk limit, and the velocity changes meanwhile.
        eased = now.acceleration_deg_s2 * abs(now.acceleration_deg_s2) / (2.0 * limits.jerk_deg_s3)
        if abs(now.velocity_deg_s + eased) > limits.velocity_deg_s * (1.0 + 1e-6):
            return None
        demand.current_position = [0.0]
        demand.current_velocity = [now.velocity_deg_s]
        demand.current_acceleration = [now.acceleration_deg_s2]
        velocity = [min(velocity_deg_s, limits.velocity_deg_s)]
        acceleration = [min(acceleration_deg_s2, limits.acceleration_deg_s2)]
        for trajectory in solutions(self._ruckig, demand, velocity, acceleration):
            duration_s = float(trajectory.duration)
            if not math.isfinite(duration_s):
                continue
            extremes = trajectory.position_extrema[0]
            position, speed, _ = trajectory.at_time(duration_s)
            turn_deg = begin_deg + _turn(now.velocity_deg_s, trajectory.at_time, duration_s)
            if (
                begin_deg + extremes.min >= bounds.lower_deg - _ROUNDING_DEG
                and begin_deg + extremes.max <= bounds.upper_deg + _ROUNDING_DEG
                and bounds.lower_deg - _ROUNDING_DEG <= turn_deg <= bounds.upper_deg + _ROUNDING_DEG
                and abs(speed[0]) <= _MISS_DEG
            ):
                return Plan(begin_deg, begin_deg + float(position[0]), duration_s, trajectory.at_time)
        return None
