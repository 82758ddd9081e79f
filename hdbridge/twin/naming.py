"""Names the causes by which a simulation was wrong, with their evidence, and parameters not separable.

A cause is tested on held-out legs: first with its parameters reset in the twin, then with the best rival fit
that keeps them reset.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import ClassVar

import numpy as np
from scipy.special import ndtri

from hdbridge.axis.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import rms
from hdbridge.twin.fit import (
    Fitted,
    as_late,
    fitted_rows,
    legs_of_rows,
    over_legs,
    softened,
    solve,
)
from hdbridge.twin.misfit import Replays, judged_rows
from hdbridge.twin.parameters import Parameter, at_coordinates, by_cause, coordinates, free_value
from hdbridge.units import figure

# ----------------------------------------------------------------
# Significance of a rival's larger residuals against their scatter between legs.

FALSE_ALARM = 0.02
"""Probability that any cause is named in a correct simulation."""
STEPS = 6
"""Maximum steps of a rival's fit, which starts at the linear prediction of the twin's fit. A rival that has
not reached its minimum loses for that reason alone, and a wrong cause is named."""


def told_apart(left: FloatArray, change: FloatArray, legs: FloatArray) -> bool:
    """Returns True if a rival's residuals are larger than by chance.

    ``left`` are the twin's residuals by row, in units of the noise; ``change`` the rival's residuals minus
    these; ``legs`` the leg number of each row.
    """
    loss = float(change @ (change + 2.0 * left))
    within = over_legs((left * change)[:, None], legs)
    white = max(1.0, float(left @ left) / max(len(left), 1)) * float(change @ change)
    scatter = 2.0 * math.sqrt(max(float(np.sum(np.square(within))), white))
    return loss > -float(ndtri(FALSE_ALARM)) * scatter


def put_back(start: Truth, truth: Truth, own: Sequence[Parameter]) -> Truth:
    """Returns a truth with these parameters reset to their start."""
    return at_coordinates(truth, own, coordinates(start, own))


def without(
    replays: Replays, start: Truth, fitted: Fitted, own: Sequence[Parameter], moved: Sequence[Parameter]
) -> Truth:
    """Fits the best rival that keeps these parameters at their start; all others may compensate.

    The fit starts at the best of three places: the linear prediction of the twin's fit, the start with only
    the ``moved`` parameters as in the twin, or an exchange of filter and dead time. Compensating values may
    be far from the twin, and slopes do not lead from one substep into another.
    """
    free = [number for number, each in enumerate(fitted.parameters) if each not in own]
    back = [number for number, each in enumerate(fitted.parameters) if each in own]
    others = tuple(fitted.parameters[number] for number in free)
    before = put_back(start, fitted.truth, own)
    if not others:
        return before
    off = np.array(coordinates(before, own)) - fitted.place[back]
    slopes, spread = fitted.jacobian[:, free], np.array([each.spread for each in others])
    along = np.linalg.solve(
        slopes.T @ slopes + np.diag(spread**-2.0), slopes.T @ (fitted.jacobian[:, back] @ off)
    )
    low, high = np.array([each.bounds for each in others]).T
    led = at_coordinates(before, others, np.clip(fitted.place[free] - along, low, high).tolist())
    kept = [coordinates(fitted.truth if each in moved else start, [each])[0] for each in others]
    begun = [led, at_coordinates(before, others, kept), as_late(before, fitted.truth, others)]
    rows = fitted_rows(replays.data)
    costs = [float(np.sum(np.square(softened(each, fitted.scales, rows)))) for each in replays(begun)]
    near = replace(fitted, parameters=others, jacobian=slopes)
    prior, nearest = np.array(coordinates(start, others)), begun[int(np.argmin(costs))]
    return solve(replays, nearest, others, STEPS, prior, known=fitted.scales, near=near, linear=False).truth


# ----------------------------------------------------------------

ALIKE = 0.4
"""Minimum component of a parameter in an unobservable direction for it to belong to the set."""


@dataclass(frozen=True, slots=True)
class Moved:
    """Change of one parameter."""

    name: str
    unit: str
    before: float
    after: float
    lower: float = math.nan
    upper: float = math.nan
    """95 % interval of the value after; NaN if it has none."""

    @property
    def sentence(self) -> str:
        """Change in words."""
        unit = f" {self.unit}" if self.unit else ""
        moved = f"{self.name} {figure(self.before, 3)} -> {figure(self.after, 3)}{unit}"
        if math.isnan(self.lower):
            return moved
        return f"{moved} ({figure(self.lower, 3)} to {figure(self.upper, 3)})"


@dataclass(frozen=True, slots=True)
class Finding:
    """A named cause."""

    cause: str
    parameters: tuple[Moved, ...]
    aliases: tuple[str, ...] = ()
    """Other parameters that the motion does not separate from these."""
    move: str = ""
    """Motion that would separate them."""

    @property
    def text(self) -> str:
        """The change in words."""
        telling = [each for each in self.parameters if not each.lower <= each.before <= each.upper]
        moved = "; ".join(each.sentence for each in telling or self.parameters)
        rest = f", or {' or '.join(self.aliases)}: {self.move} would tell" if self.aliases else ""
        return f"{moved}{rest}"

    def __str__(self) -> str:
        return f"{self.cause}: {self.text}"


@dataclass(frozen=True, slots=True)
class Alike:
    """Parameters that the motion does not separate, and motions that would separate them."""

    cause: ClassVar[str] = "not separable"
    names: tuple[str, ...]
    moves: tuple[str, ...]

    @property
    def text(self) -> str:
        """In words."""
        return f"{', '.join(self.names)}; {'; '.join(self.moves)} would separate them"


def name_causes(
    replays: Replays, start: Truth, fitted: Fitted
) -> tuple[tuple[Finding, ...], tuple[Alike, ...]]:
    """Names the causes in which the start was wrong, largest gain first, and sets that are not separable.

    A cause is named if held-out legs get worse without it, however the others compensate. If these causes do
    not suffice, the others are named with the parameters that may replace them. If they do, the remaining
    parameters are not separable from their start and form a set. Rivals are fitted to a few of the legs.
    """
    # Judged on held-out legs, or on all legs if none was held out.
    data = replays.data
    rows = np.concatenate(list(judged_rows(data).values()))
    legs = legs_of_rows(data, rows)

    def left_by(truths: Iterable[Truth]) -> list[FloatArray]:
        return [softened(shown, fitted.scales, rows) for shown in replays(truths)]

    (left,) = left_by([fitted.truth])

    def worse(others: Iterable[FloatArray], than: FloatArray = left) -> list[bool]:
        return [told_apart(than, other - than, legs) for other in others]

    groups = by_cause(fitted.parameters)
    suspects = {cause: own for cause, own in groups.items() if _further(start, fitted.truth, own)}
    alone = left_by(put_back(start, fitted.truth, own) for own in suspects.values())
    matter = list(compress(suspects, worse(alone)))
    moved = [each for own in suspects.values() for each in own]
    rivals = {cause: without(replays.rough, start, fitted, groups[cause], moved) for cause in matter}
    by_rival = dict(zip(rivals, left_by(rivals.values()), strict=True))
    needed = list(compress(matter, worse(by_rival.values())))
    aliases: dict[str, list[Parameter]] = {cause: [] for cause in needed}
    rest = [each for each in fitted.parameters if each.cause not in needed]
    least = without(replays.rough, start, fitted, rest, moved) if rest else fitted.truth
    sets: list[Alike] = []
    if worse(left_by([least]))[0]:
        for cause in (each for each in matter if each not in needed):
            others = [each for each in rest if each.cause != cause]
            # A rival needs a parameter if it gets worse when that one is reset.
            rival, moved_too = rivals[cause], _further(start, rivals[cause], others)
            back = left_by(put_back(start, rival, [each]) for each in moved_too)
            aliases[cause] = list(compress(moved_too, worse(back, by_rival[cause])))
            sets.append(_set([*groups[cause], *aliases[cause]]))
    elif apart := _further(fitted.truth, least, rest):
        sets.append(_set(apart))
    found: list[Finding] = []
    intervals = fitted.intervals()
    distances = {cause: _moved(fitted, start, groups[cause]) for cause in aliases}
    for cause in sorted(aliases, key=lambda each: -distances[each]):
        own, instead = groups[cause], aliases[cause]
        if (instead or cause in needed) and not any(
            each.name in other.aliases for each in own for other in found
        ):
            found.append(finding(own, start, fitted.truth, intervals, instead))
    found.sort(key=lambda each: -rms(by_rival[each.cause]))
    return tuple(found), tuple(dict.fromkeys(sets))


def finding(
    parameters: Sequence[Parameter],
    before: Truth,
    after: Truth,
    intervals: Mapping[str, tuple[float, float]],
    instead: Sequence[Parameter] = (),
) -> Finding:
    """Returns the finding of one cause's parameters; those ``instead`` may have changed in their place."""
    moved = tuple(
        Moved(each.name, each.unit, free_value(before, each), free_value(after, each), *intervals[each.name])
        for each in parameters
    )
    names, moves = (each.name for each in instead), dict.fromkeys(each.move for each in instead)
    return Finding(parameters[0].cause, moved, tuple(names), "; ".join(moves))


def alike(fitted: Fitted, legs: FloatArray) -> tuple[Alike, ...]:
    """Returns sets of parameters that may move together by the prior's width without a significant change.

    ``legs`` holds the leg number of each fitted row.
    """
    spread = np.array([each.spread for each in fitted.parameters])
    scaled = fitted.jacobian * spread
    _, directions = np.linalg.eigh(scaled.T @ scaled)
    sets: list[Alike] = []
    for direction in directions.T:
        if told_apart(fitted.vector, scaled @ direction, legs):
            continue
        members = [each for each, part in zip(fitted.parameters, direction, strict=True) if abs(part) > ALIKE]
        if members:
            sets.append(_set(members))
    return tuple(sets)


def _set(members: Sequence[Parameter]) -> Alike:
    return Alike(tuple(each.name for each in members), tuple(dict.fromkeys(each.move for each in members)))


def _moved(fitted: Fitted, start: Truth, own: Sequence[Parameter]) -> float:
    """Returns the squared Mahalanobis distance of some parameters from their start."""
    places = [number for number, each in enumerate(fitted.parameters) if each in own]
    off = fitted.place[places] - np.array(coordinates(start, own))
    return float(off @ np.linalg.solve(fitted.covariance[np.ix_(places, places)], off))


def _further(one: Truth, other: Truth, parameters: Sequence[Parameter]) -> list[Parameter]:
    """Returns the parameters that differ by more than their least change."""
    apart = np.subtract(coordinates(one, parameters), coordinates(other, parameters))
    return [each for each, off in zip(parameters, apart, strict=True) if abs(off) > each.least_change]
