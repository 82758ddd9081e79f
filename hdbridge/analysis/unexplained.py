"""Unexplained residual: its size and the coordinate on which it depends.

Non-parametric models (bins over each coordinate, see `views`) are tested on stretches of time to which they
were not fitted, by the criteria for causes. If one of them is significant, or if the residual exceeds the
noise, a cause is missing from the catalogue. A residual that occurs only near reversals may belong to the
loop, whose law is not known exactly.
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
from hdbridge.axis.effects import BoolArray, Effect, FloatArray, Part
from hdbridge.axis.effects.coordinate import since_reversal
from hdbridge.axis.effects.kinematics import direction_of

BINS = {"load angle": (72, 360, 1800), "position": (72, 360, 1800), "time": (25,)}
"""Numbers of bins per coordinate. Those of the angles suit a wide bump, a narrow bump and waves of the motor
orders. Each time bin contains several stretches of time."""
BLOCK_S = 0.2
FEW = 50
"""Minimum number of points for a conclusion about a part of a record."""
TAIL = 3.0
"""Travel after a reversal, in units of the loop's memory, after which its influence has vanished."""


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Size of the unexplained residual, and the coordinate on which it depends."""

    arcsec: float
    """Rms beyond the noise, of means over short blocks."""
    apart_arcsec: float
    """Rms beyond the noise, of samples in motion that the loop's memory of a reversal does not affect."""
    peak_arcsec: float
    """Half the peak-to-peak residual beyond the noise, excluding rare extremes."""
    fast_arcsec: float
    """Rms beyond the noise, of all points, including variations too fast for the blocks."""
    standing_arcsec: float
    """Drift between neighbouring blocks at rest; 0 if the axis never rests."""
    crept_arcsec: float
    """Rms error if the motor has crept back within its count at every rest."""
    lives_in: str
    """Coordinate on which the residual depends most; time if it depends on none."""
    seen: bool
    """True if this dependence passes the criteria for a cause."""
    remark: str
    """Description of a dependence that passes the criteria but is too small to report; else empty."""


class _View(NamedTuple):
    """Dependence of the residual on one coordinate."""

    gain: float
    """Decrease in chi square due to ``predicted_arcsec``."""
    name: str
    predicted_arcsec: FloatArray
    """Prediction of each stretch of time from all others, shape (m,)."""


def rest(estimator: Estimator, fitted: Fitted) -> Rest:
    """Determines size and dependence of the unexplained residual of a fit."""
    residual = fitted.residual / estimator.weight
    near = near_reversals(estimator, fitted)
    apart = ~near & (estimator.data.points.speed_deg_s != 0.0)[estimator.index]
    if np.count_nonzero(apart) < FEW:
        apart[:] = True
    crept = estimator.at_points(estimator.crept(fitted.hypothesis.effects, fitted.hypothesis.start))
    seen, small = _seen(estimator, fitted, apart, _views(estimator, residual, apart))
    views = seen or _views(estimator, residual, np.ones_like(apart))
    best = max((_View(0.0, "time", np.zeros(1)), *views), key=lambda each: each.gain)
    return Rest(
        beyond_noise(estimator, residual),
        beyond_noise(estimator, residual, apart),
        max(_peak(estimator, residual), estimator.half_span(best.predicted_arcsec) if seen else 0.0),
        float(np.sqrt(max(float(np.mean(residual**2 - 1.0 / estimator.weight**2)), 0.0))),
        _standing(estimator, residual),
        float(np.sqrt(np.mean(crept**2))),
        best.name,
        bool(seen),
        small,
    )


def is_unexplained(estimator: Estimator, left: Rest) -> bool:
    """Returns True if the residual is larger than that of an ordinary axis."""
    if not of_the_loop(estimator, left):
        return True
    data, scales = estimator.data, estimator.scales
    # An axis may rest anywhere within a count of its motor encoder, and part of the noise is a slow drift.
    # Neither is a cause.
    counts = data.motor_count_arcsec / np.sqrt(12.0)
    # Fast residuals are evaluated only if the record contains the command and a standstill. Only then can
    # noise and following error be distinguished from errors of the gear.
    fast = float(np.hypot(max(scales.plain_arcsec, data.noise_arcsec), left.standing_arcsec))
    if data.full.commanded and data.standstill and left.fast_arcsec > fast:
        return True
    most = np.linalg.norm((scales.plain_arcsec, counts, left.standing_arcsec, left.crept_arcsec))
    return bool(left.arcsec > most)


def many_of_one(findings: Sequence[Finding], scales: Scales) -> list[Finding] | None:
    """Returns the findings of one kind if more of them are nearly equal than an axis can have; else None.

    They are sidebands of a cause outside the catalogue.
    """
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
    """Returns True if the whole residual may belong to the loop.

    In motion that the loop's memory does not affect, the residual must be below the threshold.
    """
    counts = _angle_step_arcsec(estimator) / np.sqrt(12.0)
    most = np.linalg.norm((estimator.scales.floor_arcsec, counts, left.standing_arcsec))
    return not left.seen and bool(left.apart_arcsec <= most)


def beyond_noise(estimator: Estimator, residual: FloatArray, rows: BoolArray | slice = slice(None)) -> float:
    """Returns the rms of means over blocks of `BLOCK_S`, less the contribution of white noise, arcsec."""
    mean, white = _blocks(estimator, residual, rows)
    return float(np.sqrt(max(float(np.mean(mean**2 - white)), 0.0)))


def _peak(estimator: Estimator, residual: FloatArray) -> float:
    """Returns half the span of the block means, less the contribution of white noise, arcsec."""
    mean, white = _blocks(estimator, residual, slice(None))
    mean, white = (each[white <= np.median(white)] for each in (mean, white))  # complete blocks
    noise = NormalDist().inv_cdf(1.0 - estimator.rare) ** 2 * float(np.mean(white))
    return float(np.sqrt(max(estimator.half_span(mean) ** 2 - noise, 0.0)))


def _blocks(
    estimator: Estimator, residual: FloatArray, rows: BoolArray | slice
) -> tuple[FloatArray, FloatArray]:
    """Returns the residual's means over blocks of `BLOCK_S`, and their variances due to white noise."""
    number = of_length(estimator.time_s[rows], BLOCK_S)
    count = np.bincount(number)
    variance = np.bincount(number, 1.0 / estimator.weight[rows] ** 2) / count**2
    return np.bincount(number, residual[rows]) / count, variance


def _angle_step_arcsec(estimator: Estimator) -> float:
    """Returns the resolution of the motor angle, referred to the load: one count, or 0 with a command."""
    return 0.0 if estimator.data.full.commanded else estimator.data.motor_count_arcsec


def near_reversals(estimator: Estimator, fitted: Fitted) -> BoolArray:
    """Returns a mask (m,) of the points within a loop's memory of the last reversal.

    All points are True if no point is that near.
    """
    memory_deg = max((each.tracker().memory_deg for each in fitted.hypothesis.effects), default=0.0)
    near = (since_reversal(estimator.motion).values <= TAIL * memory_deg)[estimator.index]
    return np.asarray(near if np.any(near) else np.ones_like(near))


def _views(estimator: Estimator, residual: FloatArray, rows: BoolArray) -> Iterator[_View]:
    """Yields the views of the selected rows of a residual over all coordinates."""
    motion, index = estimator.motion, estimator.index[rows]
    values, weight = residual[rows], estimator.weight[rows]
    fold, direction = folds(estimator.time_s[rows]), direction_of(motion)[index]
    for name, each in coordinates(motion, index, estimator.data.ratio).items():
        for both in (False, True)[: 1 + each.both_ways]:
            for bins in BINS.get(name, (each.bins,)):
                fitted_arcsec = predicted(replace(each, both_ways=both, bins=bins), values, direction, fold)
                gain = float(np.sum(weight**2 * (values**2 - (values - fitted_arcsec) ** 2)))
                yield _View(gain, f"{name} and direction" if both else name, fitted_arcsec)


def _seen(
    estimator: Estimator, fitted: Fitted, rows: BoolArray, views: Iterable[_View]
) -> tuple[list[_View], str]:
    """Returns the views that pass the criteria for a cause and are large enough to report, and a remark.

    The remark describes the best view that is too small. It is empty if a view is returned or none passes.
    """
    scales, start, weight = estimator.scales, fitted.hypothesis.start, estimator.weight[rows]
    count_arcsec = estimator.count_arcsec
    gain = scales.enter + scales.penalty
    half_steps = 0.5 * _angle_step_arcsec(estimator), 0.5 * estimator.data.load_count_arcsec
    peak = max(count_arcsec, math.hypot(scales.plain_arcsec, *half_steps))
    laws = [each for each in fitted.hypothesis.effects if each.part is None]
    for law in laws:  # the law error of an effect grows with its contribution
        contribution = estimator.columns(law, start)[rows] @ law.coefficients()
        gain = max(gain, scales.alias * len(contribution) * float(np.var(weight * contribution)))
        peak = max(peak, scales.plain_arcsec + math.sqrt(scales.alias) * estimator.half_span(contribution))
    views = sorted((each for each in views if each.gain >= gain), key=lambda each: -each.gain)
    if not views:
        return [], ""
    tangent, residual = fitted.tangent[rows], fitted.residual[rows]
    known = np.vstack([fitted.linearised.known, np.zeros(2)])
    discrepancies = law_discrepancies(estimator, fitted.hypothesis)

    def passes(view: _View) -> bool:
        columns = np.column_stack([tangent, weight * view.predicted_arcsec])
        fit = Linearised(columns, residual, known)
        own = [fitted.count()]
        return block_robust(estimator, fit, own, np.zeros(1), rows, discrepancies) > scales.robust

    sizes = [estimator.half_span(each.predicted_arcsec) for each in views]
    seen = [each for each, size in zip(views, sizes, strict=True) if size >= peak and passes(each)]
    if seen or not passes(views[0]):
        return seen, ""
    return [], (
        f"{sizes[0]:.2g} arcsec beyond the noise depend on {views[0].name}, below the threshold for this "
        f"axis: {peak:.2g} arcsec (a motor count is {count_arcsec:.2g})"
    )


def _standing(estimator: Estimator, residual: FloatArray) -> float:
    """Returns the typical step between neighbouring block means at rest, arcsec, which is slow noise."""
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


# Check for a model that was never fitted: it has no loop, although the axis has one.


MOST = 0.5
"""Minimum fraction of the squared residual that a loop must explain for its absence to be the model's main
error. Used only for a remark."""


def unfitted(estimator: Estimator, effects: tuple[Effect, ...]) -> str:
    """Returns a remark if the model lacks a loop that would explain most of its residual; else empty.

    Other errors become visible only with the loop in the fit, so findings without the loop mean little.
    """
    if estimator.data.reversals < 2 or any(each.part is Part.LOOP for each in effects):
        return ""
    plain = estimator.fit(Hypothesis(effects))
    free = estimator.free_loop(plain.hypothesis.start)
    loose = estimator.fit(replace(plain.hypothesis, nuisances=free))
    share = 1.0 - loose.chi_square / max(plain.chi_square, 1e-300)
    if share < MOST:
        return ""
    contribution = (plain.residual - loose.residual) / estimator.weight
    return (
        f"the model has no elastic loop, and one of {estimator.half_span(contribution):.3g} arcsec "
        f"to either side makes up {100.0 * share:.0f} % of the squares that it leaves: fit a model first "
        "(hdbridge fit), then diagnose"
    )
