"""What a finding gains on data that its fit has not seen: whole stretches of time left out in turn.

Each stretch is left out together with its neighbours in the same fold; everything that is linear near the
best fit (coefficients and, by their tangents, shapes) is refitted on the others, once with the finding and
once without. Which cause it is, and shapes that were found by search, are those of the whole record.
All of it is small-matrix algebra on the Gram matrices of the folds.
"""

from __future__ import annotations

import numpy as np

from hdbridge.effects import FloatArray, IntArray
from hdbridge.estimation.gain import Gain
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.stretches import counted, of_number

FOLDS = 8
STRETCHES = 64
OVER = "stretches of time"


def held_out(estimator: Estimator, fitted: Fitted, without: Fitted) -> Gain | None:
    """Leave stretches out in turn; ``without`` is the fit that lacks the effect in question.

    None where the record is too short to leave anything out.
    """
    return _gain(estimator, _as_fitted(without), _as_fitted(fitted))


def held_out_change(
    estimator: Estimator, fitted: Fitted, columns: IntArray, change_arcsec: FloatArray
) -> Gain | None:
    """The same for a change within what the model has.

    Without it these ``columns`` of the tangent stand as they were given, everything else is refitted;
    ``change_arcsec`` (m,) is what they have changed by.
    """
    kept = np.setdiff1d(np.arange(fitted.count()), columns)
    given = fitted.residual + estimator.weight * change_arcsec
    before = (fitted.tangent[:, kept], given, fitted.information[kept], fitted.pull[kept])
    return _gain(estimator, before, _as_fitted(fitted))


_Linear = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Weighted tangent and residual of a fit, and what was known beforehand with what it pulls."""


def _as_fitted(fitted: Fitted) -> _Linear:
    return fitted.tangent, fitted.residual, fitted.information, fitted.pull


def _gain(estimator: Estimator, before: _Linear, after: _Linear) -> Gain | None:
    """From weighted tangents and residuals, each of a best fit or near it."""
    stretch = counted(of_number(estimator.time_s, STRETCHES))
    samples = np.bincount(stretch).astype(np.float64)
    largest = float(np.max(np.bincount(stretch % FOLDS)))
    if len(samples) < FOLDS or len(stretch) - largest < after[0].shape[1]:
        return None
    squares = [_errors(estimator, each, stretch) for each in (before, after)]
    return Gain(OVER, FOLDS, samples, squares[0], squares[1])


def _errors(estimator: Estimator, linear: _Linear, stretch: IntArray) -> FloatArray:
    """Sum of squares of each stretch, arcsec squared, with its fold left out of the fit."""
    tangent, residual, information, pull = linear
    fold = stretch % FOLDS
    grams, moments = [], []
    for number in range(FOLDS):
        rows = fold == number
        part = tangent[rows]
        grams.append(part.T @ part)
        moments.append(part.T @ residual[rows])
    total, moment = np.sum(grams, axis=0) + np.diag(information), np.sum(moments, axis=0) + pull
    scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
    result = np.zeros(int(stretch[-1]) + 1)
    for number in range(FOLDS):
        inner = (total - grams[number]) / np.outer(scale, scale) + 1e-7 * np.eye(len(scale))
        step = np.linalg.solve(inner, (moment - moments[number]) / scale) / scale
        rows = fold == number
        left = (residual[rows] - tangent[rows] @ step) / estimator.weight[rows]
        result += np.bincount(stretch[rows], left**2, len(result))
    return result
