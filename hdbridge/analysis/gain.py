"""Gain of a model on held-out data."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import Linearised, counted, of_number, steps_without
from hdbridge.analysis.noise import White
from hdbridge.analysis.prepared import REPEATS
from hdbridge.axis.effects import Effect, FloatArray, IntArray
from hdbridge.axis.effects.kinematics import direction_of

SURE = 2.0
"""Minimum significance of a gain, standard errors."""
NEARLY_ALL = 0.75
"""Minimum share of recordings that a cause must predict better: all of three or four, four of five."""
RECORDINGS = "recordings"


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """Squared errors of stretches of a record, each predicted by a fit without it.

    Only a held-out test provides these errors: the difference between two rms values of one fit is not a
    gain. Arrays of shape (stretches,).
    """

    over: str
    """Unit that was left out, in words: motor turns, stretches of time, recordings."""
    folds: int
    """Number of fits, each without a part of the record."""
    samples: FloatArray
    """Weight of each stretch."""
    before_arcsec2: FloatArray
    """Sum of squares without the tested part, or with the reference model."""
    after_arcsec2: FloatArray
    """Sum of squares with the tested part."""

    @property
    def before_arcsec(self) -> float:
        """Root mean square without the tested part."""
        return math.sqrt(float(np.sum(self.before_arcsec2)) / float(np.sum(self.samples)))

    @property
    def after_arcsec(self) -> float:
        """Root mean square with the tested part."""
        return math.sqrt(float(np.sum(self.after_arcsec2)) / float(np.sum(self.samples)))

    @property
    def recovered(self) -> float:
        """Share of the mean square that the tested part removes; negative if the part increases the error."""
        return 1.0 - (self.after_arcsec / max(self.before_arcsec, 1e-12)) ** 2

    @property
    def sure(self) -> bool:
        """True if the squares fall significantly, by their scatter between stretches."""
        fall = self.before_arcsec2 - self.after_arcsec2
        if len(fall) < 2:
            return False
        return float(np.mean(fall)) > SURE * float(np.std(fall, ddof=1)) / math.sqrt(len(fall))

    @property
    def repeated(self) -> bool:
        """True if nearly all of several recordings, each left out whole, are predicted better."""
        better = np.mean(self.after_arcsec2 < self.before_arcsec2)
        return self.over == RECORDINGS and bool(better > NEARLY_ALL)

    @property
    def predicts(self) -> bool:
        """True if the part reduces the held-out error; for whole recordings, in nearly all of them."""
        return self.recovered > 0.0 and (self.repeated or self.over != RECORDINGS)

    def as_dict(self) -> dict[str, float | str]:
        """Returns the entries for the provenance of a model file."""
        return {
            "over": self.over,
            "before_arcsec": self.before_arcsec,
            "after_arcsec": self.after_arcsec,
        }


# Gain of a finding: what repeats is left out in turn.


FOLDS = 8
STRETCHES = 64


def repeats(estimator: Estimator) -> tuple[IntArray, str]:
    """Numbers the points (m,) by repetition (recordings, else moves, else stretches of time); also returns
    its name.

    Errors that a repetition shares with another are not evidence.
    """
    points = estimator.data.points
    if estimator.data.full.repeated:
        begins = np.array([each.rows.start for each in estimator.data.full.chains], dtype=np.intp)
        return counted(np.searchsorted(begins, estimator.data.runs[estimator.index], "right")), RECORDINGS
    stretch = of_number(estimator.time_s, STRETCHES)
    moving, direction = points.speed_deg_s != 0.0, direction_of(points.motion)
    begins = 1 + np.flatnonzero((moving[1:] & ~moving[:-1]) | (np.diff(direction) != 0.0))
    if len(begins) < FOLDS:
        return counted(stretch), "stretches of time"
    move = np.searchsorted(begins, estimator.index, "right")
    return counted(move * STRETCHES + stretch), "moves"  # a long one in several parts


def held_out(estimator: Estimator, before: Fitted, after: Fitted) -> Gain | None:
    """Cross-validates two fits with whole repetitions left out, and compares them.

    None if the record is too short.
    """
    (gain,) = _compared(estimator, [before.linearised], after.linearised)
    return gain


def of_written(
    estimator: Estimator,
    fitted: Fitted,
    given: Sequence[Effect],
    others: Iterable[Collection[int]],
    written: Collection[int],
) -> list[Gain | None]:
    """Returns the gain of the written model for each finding.

    The reference is the ``given`` model with the ``others``, the remaining findings; ``written`` and
    ``others`` are places of effects in the fit. The other findings are not refitted without the finding, so a
    fresh record can repeat the comparison.
    """
    before = [_as_written(estimator, fitted, given, places, ()) for places in others]
    return _compared(estimator, before, _as_written(estimator, fitted, given, written, written))


def _as_written(
    estimator: Estimator,
    fitted: Fitted,
    given: Sequence[Effect],
    places: Collection[int],
    free: Collection[int],
) -> Linearised:
    """Returns the linearised fit of the zeros and the effects at the places ``free``.

    Effects outside ``places`` are as in the given model, or absent.
    """
    effects, full = fitted.hypothesis.effects, fitted.linearised
    used = [
        effects[at] if at in places else given[at]
        for at in range(len(effects))
        if at in places or at < len(given)
    ]
    columns = np.concatenate([np.arange(len(fitted.zeros)), *(fitted.places(at) for at in sorted(free))])
    left, _ = estimator.left_by(used)
    return Linearised(full.columns[:, columns], left * estimator.weight, full.known[columns])


def _compared(estimator: Estimator, before: Sequence[Linearised], after: Linearised) -> list[Gain | None]:
    stretch, over = repeats(estimator)
    fold = stretch % FOLDS
    samples = np.bincount(stretch).astype(np.float64)
    if len(samples) < REPEATS or len(stretch) - np.max(np.bincount(fold)) < after.columns.shape[1]:
        return [None] * len(before)

    def squares(fit: Linearised) -> FloatArray:
        left = fit.residual.copy()
        steps = steps_without(fit, fold, lambda rows: White(np.ones(np.count_nonzero(rows))))
        for number, step in enumerate(steps):
            left[fold == number] -= fit.columns[fold == number] @ step
        return np.asarray(np.bincount(stretch, (left / estimator.weight) ** 2), dtype=np.float64)

    folds, later = int(np.max(fold)) + 1, squares(after)
    return [Gain(over, folds, samples, squares(each), later) for each in before]
