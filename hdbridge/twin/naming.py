"""What was wrong with the simulation: causes by the evidence that they earn, and what cannot be told apart.

A cause is held against legs that the fit has not seen: the twin with this cause's parameters where they were,
and then the best that can be done so (`hdbridge.twin.naming`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, ndtri

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.fitting import as_late
from hdbridge.twin.least_squares import (
    Fitted,
    fitted_rows,
    information_of,
    legs_of_rows,
    over_legs,
    solve,
    told,
)
from hdbridge.twin.misfit import CHANNELS, counted
from hdbridge.twin.parameters import Parameter, at_coordinates, coordinates, free_value
from hdbridge.twin.replays import Replays
from hdbridge.units import figure

# ----------------------------------------------------------------
# Whether a recording distinguishes a twin from a rival: what the rival leaves more, against its scatter.

FALSE_ALARM = 0.02
"""Probability with which a simulation that is right has any cause named."""
STEPS = 6
"""Most steps of a rival's fit, which begins where the slopes of the twin's own fit lead. A rival that has not
reached its minimum loses to the twin by that alone, and a cause is named that is none."""


def told_apart(left: FloatArray, change: FloatArray, legs: FloatArray) -> bool:
    """Whether a rival leaves more than chance would have it.

    ``left`` is what the twin leaves, by row, in units of the noise; ``change`` what the rival leaves more;
    ``legs`` the number of each row's leg.
    """
    loss = float(change @ (change + 2.0 * left))
    within = over_legs((left * change)[:, None], legs)
    white = max(1.0, float(left @ left) / max(len(left), 1)) * float(change @ change)
    scatter = 2.0 * math.sqrt(max(float(np.sum(np.square(within))), white))
    return loss > -float(ndtri(FALSE_ALARM)) * scatter


def put_back(start: Truth, truth: Truth, own: Sequence[Parameter]) -> Truth:
    """A truth with these parameters where they were."""
    return at_coordinates(truth, own, coordinates(start, own))


def without(
    replays: Replays, start: Truth, fitted: Fitted, own: Sequence[Parameter], moved: Sequence[Parameter]
) -> Truth:
    """The best rival in which these parameters are where they were: all others may make up for it.

    It is fitted from where the slopes of the twin's fit lead, from where only the ``moved`` ones are as in
    the twin, or from where filter or dead time makes up for the other, whichever is nearest: what makes up
    for each other may be far from the twin, and slopes do not lead from one substep into another.
    """
    free = [number for number, each in enumerate(fitted.parameters) if each not in own]
    back = [number for number, each in enumerate(fitted.parameters) if each in own]
    others = tuple(fitted.parameters[number] for number in free)
    before = put_back(start, fitted.truth, own)
    if not others:
        return before
    off = np.array(coordinates(before, own)) - fitted.place[back]
    slopes, spread = fitted.jacobian[:, free], np.array([each.spread for each in others])
    along = np.linalg.solve(information_of(slopes, spread), slopes.T @ (fitted.jacobian[:, back] @ off))
    low, high = np.array([each.bounds for each in others]).T
    led = at_coordinates(before, others, np.clip(fitted.place[free] - along, low, high).tolist())
    kept = [coordinates(fitted.truth if each in moved else start, [each])[0] for each in others]
    begun = [led, at_coordinates(before, others, kept), as_late(before, fitted.truth, others)]
    rows = fitted_rows(replays.data)
    costs = [float(np.sum(np.square(told(each, fitted.scales, rows)))) for each in replays(begun)]
    near = replace(fitted, parameters=others, jacobian=slopes)
    prior, nearest = np.array(coordinates(start, others)), begun[int(np.argmin(costs))]
    return solve(replays, nearest, others, prior, STEPS, known=fitted.scales, near=near).truth


def held_out(replays: Replays, found: dict[str, FloatArray], fitted: Fitted) -> tuple[FloatArray, FloatArray]:
    """The scaled residuals on legs that the fit has not seen, softened, with the number of each one's leg.

    On all legs where none was held out.
    """
    data = replays.data
    out = data.out if data.out.any() else np.ones(len(data.out))
    rows = np.concatenate([each * out > 0.0 for each in counted(data).values()])
    return told(found, fitted.scales, rows), legs_of_rows(data, rows)


# ----------------------------------------------------------------

ALIKE = 0.4
"""Share of a parameter in a direction that the motion does not show, from which it belongs to the set."""


@dataclass(frozen=True, slots=True)
class Moved:
    """One parameter, before and after."""

    name: str
    unit: str
    before: float
    after: float
    lower: float = math.nan
    upper: float = math.nan
    """95 % interval of what it is after; NaN if it has none."""

    @property
    def sentence(self) -> str:
        """In words."""
        unit = f" {self.unit}" if self.unit else ""
        moved = f"{self.name} {figure(self.before, 3)} -> {figure(self.after, 3)}{unit}"
        if math.isnan(self.lower):
            return moved
        return f"{moved} ({figure(self.lower, 3)} to {figure(self.upper, 3)})"


@dataclass(frozen=True, slots=True)
class Finding:
    """A cause that is named."""

    cause: str
    parameters: tuple[Moved, ...]
    shows_in: tuple[str, ...]
    evidence: float
    """Natural logarithm of one over the probability of so large a change where there is none."""
    gain: tuple[float, float]
    """Rms of the scaled residuals on legs that the fit has not seen: without the change, and with it."""
    aliases: tuple[str, ...] = ()
    """Other parameters that the motion cannot tell from these."""
    move: str = ""
    """The motion that would."""

    @property
    def text(self) -> str:
        """One sentence."""
        telling = [each for each in self.parameters if not each.lower <= each.before <= each.upper]
        moved = "; ".join(each.sentence for each in telling or self.parameters)
        rest = f", or {' or '.join(self.aliases)}: {self.move} would tell" if self.aliases else ""
        return f"{self.cause}: {moved}{rest}"


@dataclass(frozen=True, slots=True)
class Alike:
    """Parameters that this motion cannot tell apart, and the motion that would."""

    names: tuple[str, ...]
    moves: tuple[str, ...]


def name_causes(
    replays: Replays, start: Truth, fitted: Fitted
) -> tuple[tuple[Finding, ...], tuple[Alike, ...]]:
    """The causes in which the start was wrong, the most telling first, and what cannot be told apart there.

    A cause without which held-out legs come out worse, whatever else makes up for it, is named. If the twin
    needs more than those, the others are named with what may stand in for them; if not, nothing tells what
    they came to from the start, and that is a set. Rivals are fitted to a few of the legs.
    """
    contest = _Contest(replays, start, fitted)
    groups: dict[str, list[Parameter]] = {}
    for each in fitted.parameters:
        groups.setdefault(each.cause, []).append(each)
    suspects = {cause: own for cause, own in groups.items() if _further(start, fitted.truth, own)}
    alone = replays([put_back(start, fitted.truth, own) for own in suspects.values()])
    matter = [cause for cause, there in zip(suspects, alone, strict=True) if contest.lost(there)]
    moved = [each for own in suspects.values() for each in own]
    rivals = {cause: without(replays.rough, start, fitted, groups[cause], moved) for cause in matter}
    shown = dict(zip(rivals, replays(rivals.values()), strict=True))
    needed = {cause: groups[cause] for cause in matter if contest.lost(shown[cause])}
    aliases: dict[str, list[Parameter]] = {cause: [] for cause in needed}
    rest = [each for each in fitted.parameters if each.cause not in needed]
    least = without(replays.rough, start, fitted, rest, moved) if rest else fitted.truth
    sets: list[Alike] = []
    (shown_least,) = replays([least])
    if contest.lost(shown_least):
        for cause in (each for each in matter if each not in needed):
            others = [each for each in rest if each.cause != cause]
            aliases[cause] = contest.needed(rivals[cause], _further(start, rivals[cause], others))
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
            gain = (_rms(contest.left_by(shown[cause])), _rms(contest.left))
            found.append(finding(own, start, fitted.truth, intervals, distances[cause], gain, instead))
    return tuple(sorted(found, key=lambda each: -each.gain[0])), tuple(dict.fromkeys(sets))


class _Contest:
    """A fit against its rivals, on legs that it has not seen."""

    def __init__(self, replays: Replays, start: Truth, fitted: Fitted) -> None:
        self._replays, self._start, self._fitted = replays, start, fitted
        (shown,) = replays([fitted.truth])
        self.left, self._legs = held_out(replays, shown, fitted)

    def left_by(self, shown: dict[str, FloatArray]) -> FloatArray:
        """The scaled residuals of a rival."""
        return held_out(self._replays, shown, self._fitted)[0]

    def lost(self, shown: dict[str, FloatArray]) -> bool:
        """Whether a rival has lost."""
        return told_apart(self.left, self.left_by(shown) - self.left, self._legs)

    def needed(self, rival: Truth, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Those that a rival cannot do without, each alone where it was."""
        truths = [rival, *(put_back(self._start, rival, [each]) for each in parameters)]
        left, *without = (self.left_by(shown) for shown in self._replays(truths))
        pairs = zip(parameters, without, strict=True)
        return [each for each, worse in pairs if told_apart(left, worse - left, self._legs)]


def finding(
    parameters: Sequence[Parameter],
    before: Truth,
    after: Truth,
    intervals: Mapping[str, tuple[float, float]],
    distance: float,
    gain: tuple[float, float],
    instead: Sequence[Parameter] = (),
) -> Finding:
    """What is said of one cause's parameters; ``distance`` in squared standard deviations.

    ``instead`` are those that may have changed in their place.
    """
    moved = tuple(
        Moved(each.name, each.unit, free_value(before, each), free_value(after, each), *intervals[each.name])
        for each in parameters
    )
    return Finding(
        parameters[0].cause,
        moved,
        tuple(name for name in CHANNELS if any(name in each.shows_in for each in parameters)),
        _evidence(distance, len(parameters)),
        gain,
        tuple(each.name for each in instead),
        "; ".join(dict.fromkeys(each.move for each in instead)),
    )


def _evidence(distance: float, count: int) -> float:
    """Natural logarithm of one over the probability of a distance by chance."""
    chance = float(chdtrc(count, distance))
    return -math.log(chance) if chance > 0.0 else 0.5 * distance


def alike(fitted: Fitted, legs: FloatArray) -> tuple[Alike, ...]:
    """The sets of parameters that may move together by as much as the prior allows without being told.

    ``legs`` is the number of the leg of each fitted row.
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
    """How far some parameters have moved, in squared standard deviations."""
    places = [number for number, each in enumerate(fitted.parameters) if each in own]
    off = fitted.place[places] - np.array(coordinates(start, own))
    return float(off @ np.linalg.solve(fitted.covariance[np.ix_(places, places)], off))


def _further(one: Truth, other: Truth, parameters: Sequence[Parameter]) -> list[Parameter]:
    """Those that differ by more than anybody would care about."""
    apart = np.subtract(coordinates(one, parameters), coordinates(other, parameters))
    return [each for each, off in zip(parameters, apart, strict=True) if abs(off) > each.least_change]


def _rms(values: FloatArray) -> float:
    return math.sqrt(float(np.mean(np.square(values))))
