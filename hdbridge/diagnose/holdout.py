"""What a finding gains on data that its fit has not seen: whole stretches of time left out in turn.

Each stretch is left out together with its neighbours in the same fold, and everything that is linear near the
best fit is refitted on the others, once with the finding and once without. Which cause it is, and shapes that
were found by search, are those of the whole record.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hdbridge.effects import FloatArray, IntArray
from hdbridge.estimation.gain import Gain
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.linearised import Linearised, steps_without
from hdbridge.estimation.noise import White
from hdbridge.estimation.stretches import counted, of_number

FOLDS = 8
STRETCHES = 64
OVER = "stretches of time"


def held_out(estimator: Estimator, fitted: Fitted, without: Fitted) -> Gain | None:
    """Leave stretches out in turn; ``without`` is the fit that lacks the effect in question.

    None where the record is too short to leave anything out.
    """
    return _gain(estimator, without.linearised, fitted.linearised)


def held_out_change(
    estimator: Estimator, fitted: Fitted, columns: IntArray, change_arcsec: FloatArray
) -> Gain | None:
    """The same for a change within what the model has.

    Without it these ``columns`` of the tangent stand as they were given, everything else is refitted;
    ``change_arcsec`` (m,) is what they have changed by.
    """
    after = fitted.linearised
    kept = np.setdiff1d(np.arange(fitted.count()), columns)
    given = after.residual + estimator.weight * change_arcsec
    return _gain(estimator, replace(after.of(kept), residual=given), after)


def _gain(estimator: Estimator, before: Linearised, after: Linearised) -> Gain | None:
    """From weighted columns and residuals."""
    stretch = counted(of_number(estimator.time_s, STRETCHES))
    fold = stretch % FOLDS
    samples = np.bincount(stretch).astype(np.float64)
    if len(samples) < FOLDS or len(stretch) - np.max(np.bincount(fold)) < after.columns.shape[1]:
        return None
    squares = []
    for fit in (before, after):
        left = fit.residual.copy()
        steps = steps_without(fit, fold, lambda rows: White(np.ones(np.count_nonzero(rows))))
        for number, step in enumerate(steps):
            left[fold == number] -= fit.columns[fold == number] @ step
        squares.append(np.asarray(np.bincount(stretch, (left / estimator.weight) ** 2), dtype=np.float64))
    return Gain(OVER, FOLDS, samples, squares[0], squares[1])
