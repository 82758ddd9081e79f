"""Gates that a finding has to pass before it is named: block-robust evidence, and no false backlash.

Observed in chi square takes neighbouring samples for independent, and noise that wanders takes it in. So a
finding's
score is summed over blocks of time, and its variance is taken from those sums: whatever is correlated
within a block no longer counts as many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import (
    Backlash,
    CountLoss,
    FloatArray,
    LocalDefect,
    RatioError,
    SubdivisionalError,
    Wear,
)
from hdbridge.effects.orders import OrderSeries
from hdbridge.effects.path import branches
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.linear import orthonormal

BLOCKS_S = (1.0, 5.0)
LEAST_BLOCKS = 30
"""A short record is cut into so many, whatever their length."""
ROBUST = 25.0
"""Block-robust chi square that a finding needs, and 6 more for each further parameter."""
STEP_SHARE = 0.03
"""A step of less than this share of another one's evidence is what something slow has left."""
SHARE_LEFT = 1e-5
TURN_DEG = 60.0
"""Motor angle after a reversal within which an elastic loop is felt."""
LEAST_GAP_ARCSEC = 2.0
BEND = 0.6
"""A ramp of which the slope in some third of the travel differs by more than this share is none."""


@dataclass(frozen=True, slots=True)
class Gate:
    """How a finding fared."""

    robust: float
    """Smallest block-robust chi square over the block lengths."""
    needed: float
    passed: bool
    reason: str = ""


def robust_chi_square(
    estimator: Estimator,
    fitted: Fitted,
    place: int,
    nuisances: FloatArray | None = None,
    rows: NDArray[np.bool_] | None = None,
    only: int | None = None,
) -> float:
    """Of one effect of a hypothesis: its coefficients against zero, by the sums of their scores over
    blocks of time.

    Everything else is projected out, and the columns ``nuisances`` (weighted) too; only ``rows`` count, where
    given, and of the coefficients the one with the number ``only``.
    """
    own = [i for i in fitted.places(place) if not fitted.parameters[i].shape]
    coefficients = fitted.hypothesis.effects[place].coefficients()
    if only is not None:
        own, coefficients = [own[only]], coefficients[[only]]
    others = np.setdiff1d(np.arange(fitted.count()), own)
    tangent, residual, time = fitted.tangent, fitted.residual, estimator.time_s
    target = residual + tangent[:, own] @ coefficients
    rest = tangent[:, others] if nuisances is None else np.hstack([tangent[:, others], nuisances])
    columns = tangent[:, own]
    if rows is not None:
        rest, columns, target, time = rest[rows], columns[rows], target[rows], time[rows]
        if np.count_nonzero(rows) < 20:
            return 0.0
    held, asked = fitted.prior_rows()
    held = held[:, others]
    rest = np.vstack([rest, np.hstack([held, np.zeros((len(held), rest.shape[1] - held.shape[1]))])])
    columns = np.vstack([columns, np.zeros((len(held), columns.shape[1]))])
    target = np.concatenate([target, asked])
    basis = orthonormal(rest)
    left = columns - basis @ (basis.T @ columns)
    share = np.sum(left**2, axis=0) / np.maximum(np.sum(columns**2, axis=0), 1e-300)
    left = left[:, share > SHARE_LEFT]
    if not left.shape[1]:
        return 0.0
    gram = left.T @ left
    target = target - basis @ (basis.T @ target)
    moment = left.T @ target
    residual = target - left @ np.linalg.lstsq(gram, moment, rcond=1e-10)[0]
    result = np.inf
    scores = left * residual[:, np.newaxis]
    for longest in BLOCKS_S:
        number = blocks(time, min(longest, estimator.data.period_s * len(estimator.data.full) / LEAST_BLOCKS))
        number = np.concatenate([number, number[-1] + 1 + np.arange(len(held))])
        sums = np.stack([np.bincount(number, each) for each in scores.T], axis=1)
        # The noise itself is a floor: a residual may be quieter than it by luck.
        variance = sums.T @ sums + 0.25 * gram
        result = min(result, float(moment @ np.linalg.lstsq(variance, moment, rcond=1e-10)[0]))
    return result


def gate(estimator: Estimator, fitted: Fitted, place: int) -> Gate:
    """Judge one finding."""
    effect = fitted.hypothesis.effects[place]
    robust = robust_chi_square(estimator, fitted, place)
    needed = ROBUST + 6.0 * (len(effect.coefficients()) - 1)
    if robust < needed:
        return Gate(robust, needed, passed=False, reason="not seen in enough independent stretches")
    if isinstance(effect, Backlash | Wear):
        free = estimator.weighted(estimator.free_loop(fitted.hypothesis.start))
        robust = min(robust, robust_chi_square(estimator, fitted, place, free))
        if robust < needed:
            return Gate(robust, needed, passed=False, reason="an elastic loop of another shape does as well")
    if isinstance(effect, LocalDefect | CountLoss | OrderSeries | SubdivisionalError):
        # Where it turns, a loop of another shape leaves bumps that lie at one load angle too, and steps.
        far = since_reversal(estimator.motion.motor_deg)[estimator.index] > TURN_DEG
        robust = min(robust, robust_chi_square(estimator, fitted, place, rows=far))
        if robust < needed:
            return Gate(robust, needed, passed=False, reason="seen only where the axis reverses")
    if isinstance(effect, RatioError) and _bends(estimator, fitted, place):
        return Gate(robust, needed, passed=False, reason="not the same slope everywhere")
    if isinstance(effect, Backlash) and estimator.data.reversals < 2:
        return Gate(robust, needed, passed=False, reason="no reversal in which play would show")
    if isinstance(effect, Backlash) and effect.gap_arcsec < LEAST_GAP_ARCSEC:
        return Gate(robust, needed, passed=False, reason="too small to distinguish from the loop's shape")
    return Gate(robust, needed, passed=True)


def all_steps_seen(estimator: Estimator, fitted: Fitted, place: int) -> bool:
    """Whether each step of a `count_loss` is seen, and none is what another cause leaves in its place."""
    steps = range(len(fitted.hypothesis.effects[place].coefficients()))
    robust = [robust_chi_square(estimator, fitted, place, only=each) for each in steps]
    return min(robust) > max(ROBUST, STEP_SHARE * max(robust))


def _bends(estimator: Estimator, fitted: Fitted, place: int) -> bool:
    """Whether a ramp has another slope in some third of the travel: a wrong ratio has the same everywhere."""
    angle = estimator.motion.motor_deg[estimator.index]
    low, span = float(np.min(angle)), float(np.ptp(angle))
    hinges = [np.maximum(angle - low - share * span, 0.0) for share in (1.0 / 3.0, 2.0 / 3.0)]
    own = fitted.places(place)
    slope = float(fitted.hypothesis.effects[place].coefficients()[0])
    column = fitted.tangent[:, own[:1]]
    scale = float(np.ptp(column[:, 0] / estimator.weight)) / max(span, 1e-9)
    columns = estimator.weighted(np.column_stack(hinges)) * scale
    basis = orthonormal(np.hstack([np.delete(fitted.tangent, own, axis=1), column]))
    left = columns - basis @ (basis.T @ columns)
    moment = left.T @ fitted.residual
    bend = np.linalg.lstsq(left.T @ left, moment, rcond=1e-10)[0]
    # The slope in the first third, with the bends in place.
    others = np.delete(fitted.tangent, own, axis=1)
    step = np.linalg.lstsq(np.hstack([column, columns, others]), fitted.residual, rcond=None)[0]
    slopes = slope + np.cumsum(step[:3])
    return bool(np.ptp(slopes) > BEND * np.max(np.abs(slopes)) and float(moment @ bend) > ROBUST)


def standing_s(estimator: Estimator) -> FloatArray:
    """Time since the axis came to rest, seconds, shape (n,); 0 in motion."""
    motion = estimator.motion
    if motion.motor_speed_deg_s is None or motion.time_s is None:
        return np.zeros(len(motion))
    moving = motion.motor_speed_deg_s != 0.0
    last = np.maximum.accumulate(np.where(moving, np.arange(len(motion)), 0))
    return np.asarray(np.where(moving, 0.0, motion.time_s - motion.time_s[last]))


def blocks(time_s: FloatArray, length_s: float) -> NDArray[np.intp]:
    """A number per point that changes after every so many seconds; empty stretches are not counted."""
    number = np.floor((time_s - time_s[0]) / length_s).astype(np.intp)
    return np.asarray(np.unique(number, return_inverse=True)[1])


def since_reversal(motor_deg: FloatArray) -> FloatArray:
    """Motor angle since the axis last reversed (or began), degrees, shape (n,)."""
    turning, _ = branches(motor_deg)
    result = np.zeros(len(motor_deg))
    if len(turning) > 1:
        begin = np.repeat(motor_deg[turning[:-1]], np.diff(turning))
        result[turning[0] + 1 :] = np.abs(motor_deg[turning[0] + 1 :] - begin)
    return result
