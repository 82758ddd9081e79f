"""What a model gains on data that its fit has not seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import Linearised, counted, of_number, steps_without
from hdbridge.analysis.noise import White
from hdbridge.effects import FloatArray, IntArray

SURE = 2.0
"""Standard errors by which the fall must be more than nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """Squares that stretches of a record leave, each left out of the fit that is judged on it.

    Only a hold-out knows them: two root mean squares of one fit make no gain. Arrays of shape (stretches,).
    """

    over: str
    """What was left out at a time, in words: motor turns, stretches of time, recordings."""
    folds: int
    """So many fits were made, each without a part of the record."""
    samples: FloatArray
    """Weight of each stretch."""
    before_arcsec2: FloatArray
    """Sum of squares without what is judged, or with what it is compared with."""
    after_arcsec2: FloatArray
    """... and with it."""

    @property
    def before_arcsec(self) -> float:
        """Root mean square without it."""
        return math.sqrt(float(np.sum(self.before_arcsec2)) / float(np.sum(self.samples)))

    @property
    def after_arcsec(self) -> float:
        """Root mean square with it."""
        return math.sqrt(float(np.sum(self.after_arcsec2)) / float(np.sum(self.samples)))

    @property
    def recovered(self) -> float:
        """Share of the mean square that it takes away; negative where it makes things worse."""
        return 1.0 - (self.after_arcsec / max(self.before_arcsec, 1e-12)) ** 2

    @property
    def sure(self) -> bool:
        """Whether the squares fall by more than chance from one stretch to another."""
        fall = self.before_arcsec2 - self.after_arcsec2
        if len(fall) < 2:
            return False
        return float(np.mean(fall)) > SURE * float(np.std(fall, ddof=1)) / math.sqrt(len(fall))

    def as_dict(self) -> dict[str, float | str]:
        """For the provenance of a model file."""
        return {
            "over": self.over,
            "before_arcsec": self.before_arcsec,
            "after_arcsec": self.after_arcsec,
        }


# What a finding gains on data that its fit has not seen: whole stretches of time left out in turn.


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
