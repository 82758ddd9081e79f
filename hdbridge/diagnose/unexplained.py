"""What is left when no cause fits: how much, and what it depends on.

Non-parametric rivals that know nothing of causes (bins over all that a residual can be looked at over, see
`residual_views`) are fitted on every other stretch of time and judged on the rest. Where the best of them
takes a good deal away, there something is that the catalogue does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from hdbridge.diagnose.residual_views import coordinates, every_other, foretold
from hdbridge.diagnose.result import Finding
from hdbridge.effects import BoolArray, FloatArray, Part
from hdbridge.effects.kinematics import direction_of
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.scales import Scales
from hdbridge.estimation.stretches import of_length

BINS = {"load angle": 360, "position": 400, "time": 25}
"""Of angles as many as a narrow bump or a wave of the motor's orders asks for; of time no more than there are
stretches of either half for."""
BLOCK_S = 0.2
LESS = "does less than what is left unexplained"
EPISODES = 30
"""Stretches that a record is cut into, to see whether what is left is left everywhere."""


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What is left."""

    arcsec: float
    """Root mean square beyond the noise, over short blocks."""
    fast_arcsec: float
    """The same over all points: what is too fast for short blocks as well."""
    standing_arcsec: float
    """The same at rest only; 0 where it never rests."""
    lives_in: str
    """Where most of it is; time where nothing in particular."""
    explained_arcsec: float
    """Root mean square of what the best rival takes away on data it has not seen."""

    def foretold(self, scales: Scales) -> bool:
        """Whether a good part of it depends on what it was looked at over."""
        return self.explained_arcsec**2 > scales.foretold * self.arcsec**2


def rest(estimator: Estimator, fitted: Fitted) -> Rest:
    """Look at a residual."""
    residual = fitted.residual / estimator.weight
    arcsec = beyond_noise(estimator, residual)
    motion, index = estimator.motion, estimator.index
    smooth, odd = _smoothed(estimator, residual), every_other(estimator.time_s)
    direction = direction_of(motion)[index]
    best = ("time", 0.0)
    for name, each in coordinates(motion, index, estimator.data.ratio).items():
        for both in (False, True)[: 1 + each.both_ways]:
            bins = BINS.get(name, each.bins)
            gain = foretold(replace(each, both_ways=both, bins=bins), smooth, direction, odd)
            best = max(best, (f"{name} and direction" if both else name, gain), key=lambda one: one[1])
    return Rest(
        arcsec,
        float(np.sqrt(max(float(np.mean(residual**2 - 1.0 / estimator.weight**2)), 0.0))),
        _standing(estimator, residual),
        best[0],
        float(np.sqrt(best[1])),
    )


def is_unexplained(estimator: Estimator, left: Rest) -> bool:
    """Whether more is left than nobody need explain."""
    data, scales = estimator.data, estimator.scales
    # An axis rests anywhere within a count of its motor encoder, and noise wanders; nobody can explain
    # that.
    counts = data.motor_count_arcsec / np.sqrt(12.0)
    limit = float(np.hypot(scales.floor_arcsec, 0.0 if data.full.commanded else counts))
    if left.arcsec > limit and left.foretold(scales):
        return True
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


def of_the_loop(left: Rest, scales: Scales) -> bool:
    """Whether what is left is the loop's: it depends on what has passed since the last reversal."""
    return "last reversal" in left.lives_in and left.foretold(scales)


def doubtful_loops(findings: Sequence[Finding], left: Rest, scales: Scales) -> list[Finding]:
    """Changes of the loop's parameters that do less than what is left, unless that is the loop's too."""
    if of_the_loop(left, scales):
        return []
    return [
        each
        for each in findings
        if each.within
        and each.effect is not None
        and each.effect.changes is Part.LOOP
        and each.effect.part is not Part.LOOP
        and each.taken_arcsec**2 < scales.shadow * left.arcsec**2
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
    time_s, residual, weight = estimator.time_s[rows], residual[rows], estimator.weight[rows]
    number = of_length(time_s, BLOCK_S)
    count = np.bincount(number)
    mean = np.bincount(number, residual) / count
    white = np.bincount(number, 1.0 / weight**2) / count**2
    return float(np.sqrt(max(float(np.mean(mean**2 - white)), 0.0)))


def _standing(estimator: Estimator, residual: FloatArray) -> float:
    """What moves from one short block to the next while the axis rests: no physics, but noise that
    wanders.
    """
    speed = estimator.motion.motor_speed_deg_s
    if speed is None:
        return 0.0
    still = (speed == 0.0)[estimator.index]
    if np.count_nonzero(still) < 50:
        return 0.0
    number = np.floor((estimator.time_s[still] - estimator.time_s[0]) / BLOCK_S).astype(np.intp)
    names, number = np.unique(number, return_inverse=True)
    mean = np.bincount(number, residual[still]) / np.bincount(number)
    step = np.diff(mean)[np.diff(names) == 1]
    return float(np.median(np.abs(step))) * 1.05 if len(step) else 0.0


def _smoothed(estimator: Estimator, residual: FloatArray) -> FloatArray:
    period = estimator.data.period_s * len(estimator.data.full) / len(estimator.data.points)
    return np.asarray(uniform_filter1d(residual, max(1, round(0.1 / period))))
