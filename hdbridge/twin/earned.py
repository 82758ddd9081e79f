"""What a fit takes in where the recording shows it, once all else is known: parameters that earn their place.

Most drives feed the whole speed forward, and otherwise it looks like a dead time until all else is right;
friction near rest is told from Coulomb friction by few rows, and how friction falls with warmth only where
parts were at different temperatures. A load encoder on a flexible coupling winds up with the load's
acceleration, as the gear's spring does, but by much less. The gear's loop is the model's, and stays so unless
the load's angle says otherwise. A torque limit shows only where it is reached.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.defaults import with_sections
from hdbridge.twin.least_squares import Fitted, fitted_rows, solve, told
from hdbridge.twin.loop_laws import by_each_law, loop_parameters
from hdbridge.twin.misfit import Data
from hdbridge.twin.noise import expected
from hdbridge.twin.parameters import (
    BY_NAME,
    ELASTIC,
    LOAD,
    Parameter,
    coordinates,
    free_value,
    with_values,
)
from hdbridge.twin.replays import Replays

GROWTH: Final = "friction growth"
LAST: Final = (
    ("velocity feed-forward",),
    ("encoder coupling",),
    (GROWTH,),
    ("friction's rise at rest", "Stribeck speed"),
)
"""Taken in together or not at all."""
LIMIT: Final = BY_NAME["current limit"]
EARNED = 8.0
"""Half the drop of the scaled squares that these have to bring, and a place that is not the start's to be
gone on from: exp(8) to one."""
SURE = 4.0
"""... and the distance of the first one of `LAST` from where it was, in standard deviations."""
STEPS = 6
"""Steps that show whether they are: how fast friction falls off is seen only once it is known to."""
LOOP_STEPS = 10
"""... and of a loop by each law, all else held, on a few legs."""


class Fitting(NamedTuple):
    """Where a fit is to begin."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    prior: FloatArray
    """The coordinates that their prior is about."""


def with_last(replays: Replays, best: Fitted, prior: FloatArray) -> tuple[Fitted, FloatArray]:
    """A fit with those of `LAST` that earn it, not yet led to the minimum, and what its prior is about."""
    for names in LAST:
        extra = [BY_NAME[name] for name in names if BY_NAME[name] not in best.parameters]
        if not extra or (GROWTH in names and not _warms(replays.data)):
            continue
        wider, there = (*best.parameters, *extra), with_sections(best.truth, extra)
        around = np.append(prior, coordinates(there, extra))
        tried = solve(replays, there, wider, around, STEPS, known=best.scales)
        new = len(best.parameters)
        off = abs(float(tried.place[new] - around[new]))
        sure = off > SURE * math.sqrt(float(tried.covariance[new, new]))
        if sure and best.cost - tried.cost > EARNED:
            best, prior = tried, around
    return best, prior


def _warms(data: Data) -> bool:
    """Whether the pieces began at temperatures that differ by as much as matters."""
    begun = [each.commands.start_c for each in data.pieces]
    known_c = [each for each in begun if each is not None]
    return len(known_c) == len(begun) and max(known_c) - min(known_c) > BY_NAME["temperature"].least_change


def with_loop(replays: Replays, best: Fitted, prior: FloatArray) -> Fitting | None:
    """Where a fit with another loop of the gear begins; None where nothing speaks for one.

    That is where the load's angle is left with no more than the true axis would leave, or no law makes that
    better. Each law is led to what explains a few legs, all else held: another may be the nearest once all
    else is fitted to the first, so this is asked again then.
    """
    noise, few = expected(replays.data), replays.rough
    if best.scales.deviation[LOAD] <= noise.deviation[LOAD]:
        return None
    led, fitted = [], any(each.cause == ELASTIC for each in best.parameters)
    for there in by_each_law(best.truth)[fitted:]:
        own = loop_parameters(there)
        if own:
            around = np.array(coordinates(there, own))
            led.append((solve(few, there, own, around, LOOP_STEPS, known=noise), around))
    if not led:
        return None
    nearest, around = min(led, key=lambda each: each[0].cost)
    if best.cost - _cost(replays, nearest.truth, best) < EARNED:
        return None
    rest = [number for number, each in enumerate(best.parameters) if each.cause != ELASTIC]
    parameters = (*(best.parameters[number] for number in rest), *nearest.parameters)
    return Fitting(nearest.truth, parameters, np.append(prior[rest], around))


def with_limit(replays: Replays, best: Fitted, prior: FloatArray, usual: Truth) -> Fitting:
    """Where a fit with the drive's torque limit begins, if the recording shows it; else the usual limit's.

    The fit has gone on within the highest torque that the recording holds (`regressions`): no motion that it
    shows needs more. That this is the drive's limit, and not as much as was needed, shows in what a replay
    without it leaves.
    """
    highest, unchanged = free_value(usual, LIMIT), Fitting(best.truth, best.parameters, prior)
    if free_value(best.truth, LIMIT) >= highest or LIMIT in best.parameters:
        return unchanged
    without = with_values(best.truth, {LIMIT.name: highest})
    if _cost(replays, without, best) - best.cost > EARNED:
        return Fitting(best.truth, (*best.parameters, LIMIT), np.append(prior, coordinates(usual, [LIMIT])))
    return unchanged._replace(truth=without)


def _cost(replays: Replays, truth: Truth, best: Fitted) -> float:
    """Half the sum of squares of what a truth leaves, by the scales of a fit."""
    (found,) = replays([truth])
    left = told(found, best.scales, fitted_rows(replays.data))
    return 0.5 * float(left @ left)
