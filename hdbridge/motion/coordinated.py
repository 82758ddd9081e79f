"""Synchronised moves of several axes, with a common start, a common arrival and a straight path.

The result contains one knot per control period for each axis. A stream (`SetPoint.stream`) follows the knots
exactly. A plan must be computed outside the control loop, because this takes milliseconds.

Ruckig's free version does not plan paths through intermediate points (it would call a server on the
internet). A path through way points therefore comes to rest at each change of direction. It passes points on
a straight line without stopping. To avoid a stop at a corner, the caller must stream its own knots.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization

from hdbridge.axis.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import MotionLimits, solutions
from hdbridge.motion.stream import ACCELERATION_MARGIN

_STRAIGHT = 1e-9
"""Maximum difference between two unit vectors that count as the same direction."""
MOST_S = 3600.0
"""Maximum duration of a plan, because its knots are kept in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class CoordinatedPlan:
    """Knots of several axes at common times."""

    duration_s: float
    knots: dict[str, FloatArray]
    """Knots of each axis, one per control period, shape (n, 3): time from 0, s; load angle, degrees;
    velocity, deg/s.

    The first knot is the initial position and the last one the target, both at rest."""


def coordinated(
    starts_deg: Mapping[str, float],
    points_deg: Sequence[Mapping[str, float]],
    limits: Mapping[str, MotionLimits],
    period_s: float,
    share: float = 1.0,
) -> CoordinatedPlan:
    """Plans a synchronised move from rest, through points, to rest at the last point.

    ``starts_deg`` contains the position of each axis. Each point contains target angles for some or all axes,
    and the other axes do not move. ``share``, above 0 and up to 1, scales all velocity and acceleration
    limits. Raises `InputError` for an unknown axis, an angle that is not finite or outside its limits, or a
    plan longer than an hour.
    """
    if not points_deg:
        raise InputError("the coordinated move has no point; expected at least one")
    if not (0.0 < share <= 1.0 and 0.0 < period_s < math.inf):
        raise InputError(f"the fraction of the limits is {share!r}; expected more than 0 and at most 1")
    names = [each for each in starts_deg if any(each in point for point in points_deg)]
    for point in points_deg:
        for name in point:
            if name not in starts_deg or name not in limits:
                raise InputError(
                    f"no axis '{name}' in this move; expected one of {', '.join(map(repr, starts_deg))}"
                )
            _check_inside(name, point[name], limits[name])
    if not names:
        raise InputError("the coordinated move has no axis; expected a target for at least one")
    here = np.array([starts_deg[each] for each in names])
    if not np.isfinite(here).all():
        raise InputError(f"the coordinated move begins at {here.tolist()} deg; expected finite angles")
    corners = [here]
    for point in points_deg:
        here = np.array([point.get(name, at) for name, at in zip(names, here.tolist(), strict=True)])
        corners.append(here)
    eased = [_eased(limits[each], period_s, share) for each in names]
    legs = [_leg(begin, end, eased, period_s) for begin, end in _straight(corners)]
    if not legs:
        legs = [(np.stack([here, here]), np.zeros((2, len(names))))]
    position = np.concatenate([legs[0][0], *(each[0][1:] for each in legs[1:])])
    velocity = np.concatenate([legs[0][1], *(each[1][1:] for each in legs[1:])])
    time_s = period_s * np.arange(len(position))
    knots = {
        name: np.column_stack([time_s, position[:, place], velocity[:, place]])
        for place, name in enumerate(names)
    }
    return CoordinatedPlan(float(time_s[-1]), knots)


def _check_inside(name: str, angle_deg: float, limits: MotionLimits) -> None:
    if not limits.position_min_deg <= angle_deg <= limits.position_max_deg:
        raise InputError(
            f"axis '{name}': a target of {angle_deg!r} deg; the position limits are "
            f"{limits.position_min_deg:g} and {limits.position_max_deg:g} deg"
        )


class _Eased(NamedTuple):
    """Reduced limits for the knots, with which the cubics between the knots stay within the axis's limits."""

    velocity_deg_s: float
    acceleration_deg_s2: float
    jerk_deg_s3: float


def _eased(limits: MotionLimits, period_s: float, share: float) -> _Eased:
    """Returns reduced limits for the knots.

    If the jerk changes within a period T, the cubic exceeds the planned acceleration by up to 4/27 of jerk T,
    and the planned velocity by up to 0.0162 of jerk T^2.
    """
    velocity, acceleration = share * limits.velocity_deg_s, share * limits.acceleration_deg_s2
    jerk = min(
        limits.jerk_deg_s3,
        (ACCELERATION_MARGIN - 1.0) * 27.0 / 4.0 * acceleration / period_s,
        velocity / period_s**2,
    )
    return _Eased(velocity - 0.0162 * jerk * period_s**2, acceleration, jerk)


def _straight(corners: Sequence[FloatArray]) -> list[tuple[FloatArray, FloatArray]]:
    """Returns the legs between corners; merges successive legs in the same direction and omits empty ones."""
    legs: list[tuple[FloatArray, FloatArray]] = []
    for begin, end in pairwise(corners):
        way = end - begin
        length = float(np.linalg.norm(way))
        if not length:
            continue
        if legs:
            before = legs[-1][1] - legs[-1][0]
            bend = before / np.linalg.norm(before) - way / length
            if float(np.linalg.norm(bend)) < _STRAIGHT:
                legs[-1] = (legs[-1][0], end)
                continue
        legs.append((begin, end))
    return legs


def _leg(
    begin: FloatArray, end: FloatArray, limits: Sequence[_Eased], period_s: float
) -> tuple[FloatArray, FloatArray]:
    """Returns position and velocity of a leg, from rest to rest, in each period; shape (n, axes) each."""
    count = len(begin)
    demand = InputParameter(count)
    demand.synchronization = Synchronization.Phase
    demand.current_position = [0.0] * count
    demand.target_position = (end - begin).tolist()
    demand.max_jerk = [each.jerk_deg_s3 for each in limits]
    velocities = [each.velocity_deg_s for each in limits]
    accelerations = [each.acceleration_deg_s2 for each in limits]
    found = solutions(Ruckig(count), demand, velocities, accelerations)
    trajectory = next((each for each in found if each.duration <= MOST_S), None)
    if trajectory is None:
        raise InputError(
            f"no synchronised move from {begin.tolist()} to {end.tolist()} deg within the limits and "
            f"{MOST_S:g} s: check the targets, the share, and the limits in the axis files"
        )
    periods = max(math.ceil(trajectory.duration / period_s - 1e-9), 1)
    states = [trajectory.at_time(number * period_s) for number in range(periods)]
    rest = np.zeros((1, count))
    position = np.concatenate([begin + np.array([each[0] for each in states]), end[np.newaxis]])
    velocity = np.concatenate([np.array([each[1] for each in states]), rest])
    return position, velocity
