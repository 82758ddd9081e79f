"""What a finding gains on data that its fit has not seen: whole stretches of time left out in turn.

Each stretch is left out together with its neighbours in the same fold; everything that is linear near the
best fit
(coefficients and, by their tangents, shapes) is refitted on the others, once with the finding and once
without. All of it is small-matrix algebra on the Gram matrices of the folds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdbridge.diagnose.theory import Fitted, Workshop
from hdbridge.effects import FloatArray

FOLDS = 8
STRETCHES = 64


@dataclass(frozen=True, slots=True)
class Gain:
    """Root mean squares on held-out data, arcsec."""

    before_arcsec: float
    after_arcsec: float
    stretches: int
    """Stretches of time that were held out."""
    better: float
    """Share of them that the finding makes better or leaves alike."""

    @property
    def recovered(self) -> float:
        """Share of the variance that the finding takes away."""
        return 1.0 - (self.after_arcsec / max(self.before_arcsec, 1e-12)) ** 2


def held_out(workshop: Workshop, fitted: Fitted, without: Fitted) -> Gain:
    """Leave stretches out in turn; ``without`` is the fit that lacks the effect in question."""
    stretch = stretches(workshop)
    squares = np.bincount(stretch, minlength=int(stretch[-1]) + 1).astype(np.float64)
    after = _errors(workshop, fitted, stretch)
    before = _errors(workshop, without, stretch)
    better = float(np.mean(after <= before * 1.02 + 1e-12))
    total = float(np.sum(squares))
    return Gain(
        float(np.sqrt(np.sum(before) / total)), float(np.sqrt(np.sum(after) / total)), len(squares), better
    )


def stretches(workshop: Workshop) -> NDArray[np.intp]:
    """Number of the stretch of time of each point."""
    time = workshop.time_s
    span = max(float(time[-1] - time[0]), 1e-9)
    number = np.minimum((time - time[0]) / span * STRETCHES, STRETCHES - 1).astype(np.intp)
    return np.asarray(np.unique(number, return_inverse=True)[1])


def _errors(workshop: Workshop, fitted: Fitted, stretch: NDArray[np.intp]) -> FloatArray:
    """Sum of squares of each stretch, arcsec squared, with its fold left out of the fit."""
    tangent, residual = fitted.tangent, fitted.residual
    fold = stretch % FOLDS
    grams, moments = [], []
    for number in range(FOLDS):
        rows = fold == number
        part = tangent[rows]
        grams.append(part.T @ part)
        moments.append(part.T @ residual[rows])
    total, moment = np.sum(grams, axis=0), np.sum(moments, axis=0)
    scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
    result = np.zeros(int(stretch[-1]) + 1)
    for number in range(FOLDS):
        inner = (total - grams[number]) / np.outer(scale, scale) + 1e-7 * np.eye(len(scale))
        step = np.linalg.solve(inner, (moment - moments[number]) / scale) / scale
        rows = fold == number
        left = (residual[rows] - tangent[rows] @ step) / workshop.weight[rows]
        result += np.bincount(stretch[rows], left**2, len(result))
    return result
