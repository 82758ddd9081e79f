"""What is left when no cause fits: how much, and what it depends on.

Non-parametric rivals that know nothing of causes (bins over all that a residual can be looked at over, see
`residual_views`) are judged on stretches of time that they were not fitted to, by what causes are judged by.
Where one of them is seen, or more moves than noise does, there something is that the catalogue does not have.
What is left near the reversals only may be the loop's, whose law nobody knows exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from hdbridge.analysis.acceptance import block_robust, law_discrepancies
from hdbridge.analysis.findings import Finding
from hdbridge.analysis.hypothesis import Estimator, Fitted, Hypothesis
from hdbridge.analysis.linear import Linearised, of_length
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.views import coordinates, folds, predicted
from hdbridge.effects import BoolArray, Effect, FloatArray, Part
from hdbridge.effects.coordinate import since_reversal
from hdbridge.effects.kinematics import direction_of

BINS = {"load angle": (72, 360, 1800), "position": (72, 360, 1800), "time": (25,)}
"""Of angles as many as a wide bump, a narrow one or a wave of the motor's orders asks for; of time no more
than have several stretches each."""
BLOCK_S = 0.2
FEW = 50
"""Points that tell nothing of a record."""
TAIL = 3.0
"""Times the width of a loop after which one that forgets by and by has forgotten, too."""
LESS = "does less than what is left unexplained"
EPISODES = 30
"""Stretches that a record is cut into, to see whether what is left is left everywhere."""


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What is left."""

    arcsec: float
    """Root mean square beyond the noise, over short blocks."""
    near_arcsec: float
    """The same where a loop may remember the last reversal."""
    apart_arcsec: float
    """The same where the axis moves and none does."""
    peak_arcsec: float
    """Half the span of what is left beyond the noise, but for what is rare."""
    fast_arcsec: float
    """Root mean square over all points: what is too fast for short blocks as well."""
    standing_arcsec: float
    """What moves at rest only; 0 where it never rests."""
    lives_in: str
    """Where most of it is; time where nothing in particular."""
    seen: bool
    """Whether it is seen there as a cause has to be, apart from the reversals."""


class _View(NamedTuple):
    """A residual over one coordinate."""

    gain: float
    """Chi square that ``predicted_arcsec`` takes away."""
    name: str
    predicted_arcsec: FloatArray
    """What all other stretches of time say of each, shape (m,)."""


def rest(estimator: Estimator, fitted: Fitted) -> Rest:
    """Look at a residual."""
    residual = fitted.residual / estimator.weight
    near = near_reversals(estimator, fitted)
    apart = ~near & (estimator.data.points.speed_deg_s != 0.0)[estimator.index]
    if np.count_nonzero(apart) < FEW:
        apart[:] = True
    seen = _seen(estimator, fitted, apart, _views(estimator, residual, apart))
    views = seen or _views(estimator, residual, np.ones_like(apart))
    best = max((_View(0.0, "time", np.zeros(1)), *views), key=lambda each: each.gain)
    return Rest(
        beyond_noise(estimator, residual),
        beyond_noise(estimator, residual, near),
        beyond_noise(estimator, residual, apart),
        max(_peak(estimator, residual), estimator.half_span(best.predicted_arcsec) if seen else 0.0),
        float(np.sqrt(max(float(np.mean(residual**2 - 1.0 / estimator.weight**2)), 0.0))),
        _standing(estimator, residual),
        best.name,
        bool(seen),
    )


def is_unexplained(estimator: Estimator, left: Rest) -> bool:
    """Whether more is left than nobody need explain."""
    if not of_the_loop(estimator, left):
        return True
    data, scales = estimator.data, estimator.scales
    # An axis rests anywhere within a count of its motor encoder, and noise wanders; nobody can explain
    # that.
    counts = data.motor_count_arcsec / np.sqrt(12.0)
    # Where command and standstill distinguish noise and following error from the gear, fast things count.
    if data.full.commanded and data.standstill:
        floor = float(np.sqrt(np.mean(1.0 / estimator.weight**2)))
        if left.fast_arcsec > np.hypot(max(scales.plain_arcsec, floor), left.standing_arcsec):
            return True
    return bool(left.arcsec > np.linalg.norm((scales.plain_arcsec, counts, left.standing_arcsec)))


def many_of_one(findings: Sequence[Finding], scales: Scales) -> list[Finding] | None:
    """Several near-equal picks of one kind, more than usual: sidebands of something that is none of them."""
    for family in {each.cause for each in findings}:
        same = [each for each in findings if each.cause == family]
        kinds = [each.effect for each in same if each.effect is not None and not each.within]
        if not kinds or kinds[0].usual == 1:
            continue
        sizes = [piece.bound_arcsec() for each in kinds for piece in each.pieces()]
        if sum(each > scales.near * max(sizes) for each in sizes) > kinds[0].usual:
            return same
    return None


def of_the_loop(estimator: Estimator, left: Rest) -> bool:
    """Whether all that is left may be the loop's: no more than nobody need explain where the axis moves
    beyond the memory of any loop.
    """
    counts = _angle_step_arcsec(estimator) / np.sqrt(12.0)
    most = np.linalg.norm((estimator.scales.floor_arcsec, counts, left.standing_arcsec))
    return not left.seen and bool(left.apart_arcsec <= most)


def doubtful_loops(estimator: Estimator, findings: Sequence[Finding], left: Rest) -> list[Finding]:
    """Changes of the loop's parameters that do less near the reversals than what is left there, unless that
    is the loop's too. What follows the direction alone looks like a changed loop everywhere else.
    """
    if of_the_loop(estimator, left):
        return []
    return [
        each
        for each in findings
        if each.within
        and each.effect is not None
        and each.effect.changes is Part.LOOP
        and each.effect.part is not Part.LOOP
        and each.taken_arcsec**2 < estimator.scales.shadow * left.near_arcsec**2
    ]


def does_more(estimator: Estimator, fitted: Fitted, place: int) -> float:
    """Squares that an effect takes away where it acts, in those of what is left there.

    It acts where it is a good part of what it can be. The tenth of the record in which most is left does not
    count: what is left in one episode, say in small swings of a motor that sticks where it turns, casts no
    shadow on what is seen everywhere else. Without reversals an episode is a place, and all points count.
    """
    effect, weight, scales = fitted.hypothesis.effects[place], estimator.weight, estimator.scales
    residual = fitted.residual / weight
    values = estimator.columns(effect, fitted.hypothesis.start) @ effect.coefficients()
    values = np.abs(values - np.median(values))
    rows = values > scales.acts * float(np.quantile(values, 1.0 - estimator.rare))
    if estimator.data.reversals >= 2:
        number = np.floor(EPISODES * np.arange(len(residual)) / len(residual)).astype(np.intp)
        most = np.argsort(np.bincount(number, fitted.residual**2))[
            -round(float(scales.episodes) * EPISODES) :
        ]
        apart = ~np.isin(number, most)
        if np.any(rows & apart):
            rows &= apart
    without = estimator.fit(fitted.hypothesis.without(place)).residual[rows] / weight[rows]
    does = float(np.mean(without**2) - np.mean(residual[rows] ** 2))
    return does / max(beyond_noise(estimator, residual, rows) ** 2, 1e-12)


def beyond_noise(estimator: Estimator, residual: FloatArray, rows: BoolArray | slice = slice(None)) -> float:
    """Root mean square over blocks of `BLOCK_S`, less what white noise leaves there, arcsec."""
    mean, white = _blocks(estimator, residual, rows)
    return float(np.sqrt(max(float(np.mean(mean**2 - white)), 0.0)))


def _peak(estimator: Estimator, residual: FloatArray) -> float:
    """Half the span of the means over such blocks, less what white noise puts there, arcsec."""
    mean, white = _blocks(estimator, residual, slice(None))
    mean, white = (each[white <= np.median(white)] for each in (mean, white))  # whole ones
    noise = NormalDist().inv_cdf(1.0 - estimator.rare) ** 2 * float(np.mean(white))
    return float(np.sqrt(max(estimator.half_span(mean) ** 2 - noise, 0.0)))


def _blocks(
    estimator: Estimator, residual: FloatArray, rows: BoolArray | slice
) -> tuple[FloatArray, FloatArray]:
    """Means of some rows over blocks of `BLOCK_S`, and the variances that white noise gives them."""
    number = of_length(estimator.time_s[rows], BLOCK_S)
    count = np.bincount(number)
    variance = np.bincount(number, 1.0 / estimator.weight[rows] ** 2) / count**2
    return np.bincount(number, residual[rows]) / count, variance


def _angle_step_arcsec(estimator: Estimator) -> float:
    """A step of the angle that drives the effects in motion: a count of the motor's, or none."""
    return 0.0 if estimator.data.full.commanded else estimator.data.motor_count_arcsec


def near_reversals(estimator: Estimator, fitted: Fitted) -> BoolArray:
    """The points at which a loop may still remember the last reversal, shape (m,); all without any."""
    memory_deg = max((each.tracker().memory_deg for each in fitted.hypothesis.effects), default=0.0)
    near = (since_reversal(estimator.motion).values <= TAIL * memory_deg)[estimator.index]
    return np.asarray(near if np.any(near) else np.ones_like(near))


def _views(estimator: Estimator, residual: FloatArray, rows: BoolArray) -> Iterator[_View]:
    """Some rows of a residual over everything that they can be looked at over."""
    motion, index = estimator.motion, estimator.index[rows]
    values, weight = residual[rows], estimator.weight[rows]
    fold, direction = folds(estimator.time_s[rows]), direction_of(motion)[index]
    for name, each in coordinates(motion, index, estimator.data.ratio).items():
        for both in (False, True)[: 1 + each.both_ways]:
            for bins in BINS.get(name, (each.bins,)):
                told = predicted(replace(each, both_ways=both, bins=bins), values, direction, fold)
                gain = float(np.sum(weight**2 * (values**2 - (values - told) ** 2)))
                yield _View(gain, f"{name} and direction" if both else name, told)


def _seen(estimator: Estimator, fitted: Fitted, rows: BoolArray, views: Iterable[_View]) -> list[_View]:
    """Those views of some rows that are held to be there by what a cause is held to be there by, and are so
    large that they need no name.
    """
    scales, start = estimator.scales, fitted.hypothesis.start
    weight, step_arcsec = estimator.weight[rows], 0.5 * _angle_step_arcsec(estimator)
    gain, peak = scales.enter + scales.penalty, float(np.hypot(scales.plain_arcsec, step_arcsec))
    laws = [each for each in fitted.hypothesis.effects if each.part is None]
    for law in laws:  # the more it does, the more a real one differs from its formula
        does = estimator.columns(law, start)[rows] @ law.coefficients()
        gain = max(gain, scales.alias * len(does) * float(np.var(weight * does)))
        peak = max(peak, scales.plain_arcsec + math.sqrt(scales.alias) * estimator.half_span(does))
    large = [
        each for each in views if each.gain >= gain and estimator.half_span(each.predicted_arcsec) >= peak
    ]
    if not large:
        return []
    tangent, residual = fitted.tangent[rows], fitted.residual[rows]
    known = np.vstack([fitted.linearised.known, np.zeros(2)])
    discrepancies = law_discrepancies(estimator, fitted.hypothesis)

    def robust(view: _View) -> float:
        columns = np.column_stack([tangent, weight * view.predicted_arcsec])
        fit = Linearised(columns, residual, known)
        return block_robust(estimator, fit, [fitted.count()], np.zeros(1), rows, discrepancies)

    return [each for each in large if robust(each) > scales.robust]


def _standing(estimator: Estimator, residual: FloatArray) -> float:
    """What moves from one short block to the next while the axis rests: no physics, but noise that
    wanders.
    """
    speed = estimator.motion.motor_speed_deg_s
    if speed is None:
        return 0.0
    still = (speed == 0.0)[estimator.index]
    if np.count_nonzero(still) < FEW:
        return 0.0
    number = np.floor((estimator.time_s[still] - estimator.time_s[0]) / BLOCK_S).astype(np.intp)
    names, number = np.unique(number, return_inverse=True)
    mean = np.bincount(number, residual[still]) / np.bincount(number)
    step = np.diff(mean)[np.diff(names) == 1]
    return float(np.median(np.abs(step))) * 1.05 if len(step) else 0.0


# Is this a model of the axis at all? One without a loop, for an axis that has one, was never fitted.


MOST = 0.5
"""Share of the squares that the model leaves; a loop that makes up more is most of what is wrong. It decides
a remark, no name."""


def unfitted(estimator: Estimator, effects: tuple[Effect, ...]) -> str:
    """In words, where the model lacks a loop and one makes up most of what it leaves; else empty.

    What else is wrong shows only with the loop in the fit, so nothing that is named without it means much.
    """
    if estimator.data.reversals < 2 or any(each.part is Part.LOOP for each in effects):
        return ""
    plain = estimator.fit(Hypothesis(effects))
    free = estimator.free_loop(plain.hypothesis.start)
    loose = estimator.fit(replace(plain.hypothesis, nuisances=free))
    share = 1.0 - loose.chi_square / max(plain.chi_square, 1e-300)
    if share < MOST:
        return ""
    does = (plain.residual - loose.residual) / estimator.weight
    return (
        f"the model has no elastic loop, and one of {estimator.half_span(does):.3g} arcsec to either side "
        f"makes up {100.0 * share:.0f} % of the squares that it leaves: fit a model first (hdbridge fit), "
        "then diagnose"
    )
