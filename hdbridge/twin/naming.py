"""Names the causes of a simulation's excess residuals, by forward selection.

The method is the same after a fit (causes: wrong initial values) and in a check (causes: changes since the
twin was made). This module also finds parameters that a motion does not separate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from hdbridge.analysis.linear import counted as numbered
from hdbridge.analysis.linear import sandwich
from hdbridge.analysis.readings import median_deviation
from hdbridge.axis.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import Fitted, fitted_rows, legs_of_rows, solve
from hdbridge.twin.misfit import CHANNELS, Data, Misfit, Replays, Scales
from hdbridge.twin.parameters import (
    BY_NAME,
    Parameter,
    at_coordinates,
    by_cause,
    coordinates,
    free_value,
    with_values,
)
from hdbridge.units import figure

# ----------------------------------------------------------------
# Growth of a misfit, and the significance of a rival's larger residuals, given their scatter between legs.

CLIP_RATIO = 4.0
"""Residuals are clipped to this multiple of the misfit on their kind of leg (or of the leg's typical residual
if larger), because a motor that breaks away at a different time is not a change of the axis."""
FALSE_ALARM = 0.02
"""Probability that one of two equally good simulations counts as worse."""


def scales_by_kind(data: Data, known: Misfit, noise: Mapping[str, float]) -> dict[str, Any]:
    """Returns, by channel and row, the known misfit on this kind of leg, or the noise if larger.

    A kind of leg without a known misfit is compared with the largest misfit of the other kinds.
    """
    found = {}
    for name in CHANNELS:
        before = known.get(name, {})
        otherwise = max(before.values(), default=0.0)
        by_leg = np.array([max(before.get(kind, otherwise), noise[name]) for kind in data.kinds])
        found[name] = by_leg[data.leg]
    return found


def growth(data: Data, residuals: Mapping[str, FloatArray], was: Mapping[str, Any]) -> dict[str, float]:
    """Returns, by channel, the rms residual relative to ``was`` (`scales_by_kind`).

    Residuals are clipped to `CLIP_RATIO` times ``was`` or, if larger, times the typical residual of their
    leg, because a single reading may be wrong, but not a whole leg.
    """
    found = {}
    for name, inside in data.counts.items():
        if inside.any():
            scale, now, legs = was[name][inside], np.abs(residuals[name][inside]), data.leg[inside]
            typical = np.zeros_like(now)
            for leg in np.unique(legs):
                typical[legs == leg] = median_deviation(now[legs == leg])
            now = np.minimum(now, CLIP_RATIO * np.maximum(scale, typical))
            found[name] = math.sqrt(float(np.sum(now**2)) / float(np.sum(scale**2)))
    return found


def worse_than_chance(left: FloatArray, change: FloatArray, legs: NDArray[np.intp]) -> bool:
    """Returns True if a rival's residuals are significantly larger than the simulation's.

    ``left`` are the simulation's residuals by row, in units of the noise; ``change`` is the rival's residuals
    minus ``left``; ``legs`` is the leg number of each row.
    """
    loss = float(change @ (change + 2.0 * left))
    within = sandwich((left * change)[:, None], numbered(legs))
    white = max(1.0, float(left @ left) / max(len(left), 1)) * float(change @ change)
    scatter = 2.0 * math.sqrt(max(float(within[0, 0]), white))
    return loss > -float(ndtri(FALSE_ALARM)) * scatter


# ----------------------------------------------------------------
# Forward selection of the causes that bring the misfit back to its former level.

GROWN = 1.5
"""Ratio above which two misfits count as different; smaller ratios result from noise and different legs."""
EXPLAINED = 0.5
"""Minimum fraction of the remaining growth, in squares, that a named cause explains."""
OF_REPLAY = 0.25
"""Minimum fraction of the whole growth, in squares, that a named cause explains if the twin's values are not
the axis's. Such a twin reproduces each change with an error, and a remainder of that size is not an
additional cause."""
STEPS = 8
"""Maximum number of steps of a fit."""
SIZES = (2.5, 6.0)
"""Changes of each parameter, in both directions, at which a fit may start, in units of its smallest relevant
change. Even a small change puts the ringing of a load out of phase, and a fit that starts from the unchanged
value does not recover from that."""


@dataclass(frozen=True, slots=True)
class Explained:
    """Named causes of a recording's increased misfit, and the growth of the misfit without and with them."""

    causes: tuple[str, ...]
    rivals: tuple[str, ...]
    """Causes that would explain the recording equally well in place of the last named cause."""
    truth: Truth
    """The simulation with these causes fitted."""
    growth_before: Mapping[str, float]
    growth_after: Mapping[str, float]


def explain(
    replays: Replays,
    base: Truth,
    parameters: Sequence[Parameter],
    was: Mapping[str, Any],
    progress: Callable[[float], None] = lambda _: None,
    shown: Mapping[str, float] | None = None,
    *,
    ratio: bool = False,
) -> Explained:
    """Names causes until the misfit of ``base`` is back at ``was`` (`scales_by_kind`).

    In each round every other cause is fitted together with the named causes. The best is named if it explains
    at least the fraction `EXPLAINED` of the remaining growth. Causes made superfluous by a later one are
    dropped. A rival of the last cause is a cause that is not significantly worse. ``shown`` contains the
    factors by which parameters are known to have changed. Their causes are named first if a factor is not 1,
    and not at all otherwise.

    With ``ratio``, the values of ``base`` are not the axis's. A named cause then also explains at least the
    fraction `OF_REPLAY` of the whole growth, and causes whose misfits differ by less than `GROWN` are rivals.
    """
    data, groups = replays.data, by_cause(parameters)
    legs = legs_of_rows(data, fitted_rows(data, everything=True))
    (here,) = replays([base])
    grown = growth(data, here, was)
    shown = shown or {}
    settled = {BY_NAME[name].cause for name in shown}
    known = {BY_NAME[name].cause: None for name, factor in shown.items() if factor != 1.0}
    named, rivals = list(known), tuple[str, ...]()
    best, now = base, grown

    def fitted(causes: Sequence[str], start: Truth) -> Fitted:
        own = tuple(each for name in causes for each in groups[name])
        return solve(
            replays, start, own, STEPS, np.array(coordinates(base, own)), known=Scales(was), everything=True,
            linear=False,
        )  # fmt: skip

    if named:
        values = {name: factor * free_value(base, BY_NAME[name]) for name, factor in shown.items()}
        fit = fitted(named, with_values(base, values))
        best, now = fit.truth, growth(data, fit.residuals, was)
    others = [each for each in groups if each not in settled]
    while max(now.values(), default=0.0) > GROWN and others:
        fits: dict[str, Fitted] = {}
        for cause in others:
            fits[cause] = fitted([*named, cause], _nearest(replays, best, groups[cause], was))
            progress((len(named) + len(fits) / len(others)) / (len(named) + 1))
        cause, fit = min(fits.items(), key=lambda each: each[1].cost)
        after = growth(data, fit.residuals, was)
        least = max(EXPLAINED * _excess(now), OF_REPLAY * _excess(grown) if ratio else 0.0)
        if _excess(now) - _excess(after) < least:
            break
        rivals = tuple(
            each
            for each, other in fits.items()
            if other is not fit
            and (
                not worse_than_chance(fit.vector, other.vector - fit.vector, legs)
                or (ratio and _similar(after, growth(data, other.residuals, was)))
            )
        )
        named, best, now = [*named, cause], fit.truth, after
        others.remove(cause)
    for cause in named[len(known) : -1]:
        rest = [each for each in named if each != cause]
        back = at_coordinates(best, groups[cause], coordinates(base, groups[cause]))
        fit = fitted(rest, back)
        after = growth(data, fit.residuals, was)
        if max(after.values()) <= max(GROWN, *now.values()):
            named, best, now = rest, fit.truth, after
    progress(1.0)
    return Explained(tuple(named), rivals, best, grown, now)


def _nearest(replays: Replays, truth: Truth, own: Sequence[Parameter], was: Mapping[str, Any]) -> Truth:
    """Returns the truth, or the truth with a shifted parameter if that has smaller residuals."""
    moved = [
        shifted(truth, each, sign * size * each.least_change)
        for each in own
        for size in SIZES
        for sign in (-1.0, 1.0)
    ]
    places = [truth, *moved]
    left = [_excess(growth(replays.data, found, was)) for found in replays(places)]
    return places[int(np.argmin(left))]


def shifted(truth: Truth, parameter: Parameter, by: float) -> Truth:
    """Returns the truth with one coordinate shifted, within its bounds."""
    low, high = parameter.bounds
    (now,) = coordinates(truth, [parameter])
    return at_coordinates(truth, [parameter], [min(max(now + by, low), high)])


def _similar(best: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Returns True if no channel's growth is larger than the best by more than the factor `GROWN`."""
    return all(other[name] <= GROWN * max(times, 1.0) for name, times in best.items())


def _excess(grown: Mapping[str, float]) -> float:
    """Returns the sum over the channels of the squared growth in excess of one."""
    return sum(max(each**2 - 1.0, 0.0) for each in grown.values())


# ----------------------------------------------------------------
# Findings.

MIN_COMPONENT = 0.4
"""Minimum component of a parameter in an unobservable direction for including the parameter in the set."""


@dataclass(frozen=True, slots=True)
class Moved:
    """Change of one parameter."""

    name: str
    unit: str
    before: float
    after: float
    lower: float = math.nan
    upper: float = math.nan
    """Upper end of the 95 % interval of ``after``; NaN without an interval."""

    @property
    def sentence(self) -> str:
        """Describes the change: values before and after, and the interval if there is one."""
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
    """Other causes that are not separable from this one in the motion."""
    move: str = ""
    """Motion that would separate these causes."""

    @property
    def text(self) -> str:
        """Describes the changes of the parameters, and the inseparable causes if there are any."""
        moved = "; ".join(each.sentence for each in self.parameters)
        rest = f", or {' or '.join(self.aliases)}: {self.move} would separate them" if self.aliases else ""
        return f"{moved}{rest}"

    def __str__(self) -> str:
        return f"{self.cause}: {self.text}"


@dataclass(frozen=True, slots=True)
class InseparableSet:
    """Parameters that are not separable in the motion, and motions that would separate them."""

    cause: ClassVar[str] = "not separable"
    names: tuple[str, ...]
    moves: tuple[str, ...]

    @property
    def text(self) -> str:
        """Describes the set and the separating motions in words."""
        return f"{', '.join(self.names)}; {'; '.join(self.moves)} would separate them"


def finding(
    parameters: Sequence[Parameter],
    before: Truth,
    after: Truth,
    intervals: Mapping[str, tuple[float, float]] | None = None,
    instead: Sequence[Parameter] = (),
    *,
    ratio: bool = False,
) -> Finding:
    """Returns the finding of one cause: its parameters with relevant changes, or the one that changed most.

    ``instead`` lists causes that may have changed in place of this one. With ``ratio``, changes are given as
    ratios, because neither value is the axis's, but as differences for a parameter that may be zero.
    """
    off = np.subtract(coordinates(after, parameters), coordinates(before, parameters))
    sizes = np.abs(off) / [each.least_change for each in parameters]
    moved = []
    for each, by in zip(parameters, off.tolist(), strict=True):
        if not ratio:
            values = free_value(before, each), free_value(after, each)
            moved.append(Moved(each.name, each.unit, *values, *(intervals or {}).get(each.name, ())))
        elif each.linear:
            moved.append(Moved(each.name, each.unit, 0.0, by))
        else:
            moved.append(Moved(each.name, "times what it was", 1.0, math.exp(by)))
    relevant = tuple(compress(moved, sizes >= min(1.0, np.max(sizes))))
    moves = "; ".join(dict.fromkeys(each.move for each in instead))
    return Finding(parameters[0].cause, relevant, tuple(dict.fromkeys(each.cause for each in instead)), moves)


def findings(
    found: Explained,
    groups: Mapping[str, Sequence[Parameter]],
    before: Truth,
    intervals: Mapping[str, tuple[float, float]] | None = None,
    *,
    ratio: bool = False,
) -> tuple[Finding, ...]:
    """Returns the findings of the named causes; options as for `finding`."""
    rivals = [each for cause in found.rivals for each in groups[cause]]
    instead = dict.fromkeys(found.causes[-1:], rivals)
    return tuple(
        finding(groups[cause], before, found.truth, intervals, instead.get(cause, ()), ratio=ratio)
        for cause in found.causes
    )


def inseparable_sets(fitted: Fitted, legs: NDArray[np.intp]) -> tuple[InseparableSet, ...]:
    """Returns sets of parameters that can change together by the prior's width without a significant effect.

    ``legs`` contains the leg number of each fitted row.
    """
    spread = np.array([each.spread for each in fitted.parameters])
    scaled = fitted.jacobian * spread
    _, directions = np.linalg.eigh(scaled.T @ scaled)
    sets: list[InseparableSet] = []
    for direction in directions.T:
        if worse_than_chance(fitted.vector, scaled @ direction, legs):
            continue
        members = [
            each for each, part in zip(fitted.parameters, direction, strict=True) if abs(part) > MIN_COMPONENT
        ]
        if members:
            moves = dict.fromkeys(each.move for each in members)
            sets.append(InseparableSet(tuple(each.name for each in members), tuple(moves)))
    return tuple(sets)
