"""Gain of a model on held-out data: the decrease in its prediction error."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import counted, of_number, steps_without
from hdbridge.analysis.noise import White
from hdbridge.analysis.prepared import REPEATS
from hdbridge.axis.effects import Effect, FloatArray, IntArray
from hdbridge.axis.effects.kinematics import direction_of

SURE = 2.0
"""Minimum size of a significant gain, standard errors."""
NEARLY_ALL = 0.75
"""Exclusive lower limit of the fraction of recordings that a cause must predict better: all of three or four,
four of five."""
SHARED = 1.5
"""Minimum effective number of stretches that contribute to a gain. A single event contributes in one stretch
or, at a border, unequally in two."""
RECORDINGS = "recordings"


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """Squared errors of stretches of a record, each predicted by a fit without that stretch.

    Only a held-out test provides these errors. The difference between two rms residuals of fits to the same
    data is not a gain. Arrays have shape (stretches,).
    """

    over: str
    """Kind of parts that were left out, in words: motor turns, stretches of time, recordings."""
    folds: int
    """Number of fits, each without a part of the record."""
    samples: FloatArray
    """Number of samples in each stretch, or their total weight."""
    before_arcsec2: FloatArray
    """Sum of squared errors without the tested part, or with the reference model."""
    after_arcsec2: FloatArray
    """Sum of squared errors with the tested part."""
    weighted_fall: FloatArray | None = None
    """Decrease in the squared error of each stretch, with each sample weighted by the inverse of its noise
    variance; None if all samples have the same noise. Errors in arcsec are not weighted, but all
    decisions are."""

    @property
    def before_arcsec(self) -> float:
        """Rms prediction error without the tested part."""
        return math.sqrt(float(np.sum(self.before_arcsec2)) / float(np.sum(self.samples)))

    @property
    def after_arcsec(self) -> float:
        """Rms prediction error with the tested part."""
        return math.sqrt(float(np.sum(self.after_arcsec2)) / float(np.sum(self.samples)))

    @property
    def recovered(self) -> float:
        """Fraction of the mean square error removed by the tested part; negative if the error increases."""
        return 1.0 - (self.after_arcsec / max(self.before_arcsec, 1e-12)) ** 2

    @property
    def explained_arcsec(self) -> float:
        """Rms of the prediction error that the tested part removes; 0 if the error increases."""
        return math.sqrt(max(self.before_arcsec**2 - self.after_arcsec**2, 0.0))

    @property
    def _fall(self) -> FloatArray:
        plain = self.before_arcsec2 - self.after_arcsec2
        return plain if self.weighted_fall is None else self.weighted_fall

    @property
    def sure(self) -> bool:
        """True if the decrease in squared error is significant, judged by its scatter between stretches."""
        fall = self._fall
        if len(fall) < 2:
            return False
        return float(np.mean(fall)) > SURE * float(np.std(fall, ddof=1)) / math.sqrt(len(fall))

    @property
    def repeated(self) -> bool:
        """True if whole recordings were left out, and nearly all of them are predicted better."""
        return self.over == RECORDINGS and bool(np.mean(self._fall > 0.0) > NEARLY_ALL)

    @property
    def predicts(self) -> bool:
        """True if the held-out error decreases in nearly all recordings, or in more than one stretch.

        The effective number of stretches that contribute is the squared sum of their decreases divided by
        the sum of the squared decreases.
        """
        fall = self._fall
        shared = float(np.sum(fall)) ** 2 > SHARED * float(fall @ fall)
        return float(np.sum(fall)) > 0.0 and (self.repeated if self.over == RECORDINGS else shared)

    def as_dict(self) -> dict[str, float | str]:
        """Returns the entries for the provenance of a model file."""
        return {
            "over": self.over,
            "before_arcsec": self.before_arcsec,
            "after_arcsec": self.after_arcsec,
        }


# Gain of a finding: repetitions of the motion are left out in turn.


FOLDS = 8
STRETCHES = 64


def repeats(estimator: Estimator) -> tuple[IntArray, str]:
    """Returns the number of each point's repetition (m,), and the kind of repetition in words.

    Repetitions are recordings, else moves, else stretches of time. Points of one repetition are left out
    together, because its errors may be correlated.
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
    return counted(move * STRETCHES + stretch), "moves"  # a long move is divided into several parts


def held_out(estimator: Estimator, before: Fitted, after: Fitted) -> Gain | None:
    """Returns the gain of the fit ``after`` over ``before``, with whole repetitions left out.

    Returns None if the record is too short.
    """
    parts = _Parts.of(estimator, after.count())
    return None if parts is None else parts.gain(parts.unseen(before), parts.unseen(after))


def of_written(
    estimator: Estimator,
    fitted: Fitted,
    given: Sequence[Effect],
    others: Iterable[Collection[int]],
    written: Collection[int],
) -> list[Gain | None]:
    """Returns each finding's gain: that of the written model over the ``given`` one with the other findings.

    ``others`` contains the places of the other findings' effects for each finding, and ``written`` the places
    of all changed effects. No model is refitted, so a fresh record can repeat the comparison. Only the
    record's nuisances are refitted, for the decision. The squared error of the written model includes the
    increase due to leaving out repetitions from its fit.
    """
    others = [*others]
    parts = _Parts.of(estimator, fitted.count())
    if parts is None:
        return [None] * len(others)
    effects = [each.tidied(estimator.data.ratio) for each in fitted.hypothesis.effects]

    def squares(places: Collection[int]) -> FloatArray:
        used = [
            effects[at] if at in places else given[at]
            for at in range(len(effects))
            if at in places or at < len(given)
        ]
        plain, beside = estimator.residual_of(used)[0], estimator.residual_with_nuisances(used)
        return np.stack([parts.squares(plain)[0], parts.squares(beside)[1]])

    lost = parts.unseen(fitted) - parts.squares(fitted.residual / estimator.weight)
    after = squares(written) + lost
    return [parts.gain(squares(each), after) for each in others]


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Repetitions in a record, which are left out in turn."""

    estimator: Estimator
    stretch: IntArray
    """Number of each point's repetition, shape (m,)."""
    over: str
    weight: FloatArray
    """Weight of each point's squared residual: inverse noise variance, scaled to a mean of 1, (m,)."""

    @classmethod
    def of(cls, estimator: Estimator, parameters: int) -> _Parts | None:
        """Divides the record; returns None if it is too short for this number of parameters."""
        stretch, over = repeats(estimator)
        largest = np.max(np.bincount(stretch % FOLDS))
        if np.max(stretch) + 1 < REPEATS or len(stretch) - largest < parameters:
            return None
        precision = estimator.weight**2
        return cls(estimator, stretch, over, precision / np.mean(precision))

    def squares(self, left_arcsec: FloatArray) -> FloatArray:
        """Returns the sums of squared residuals of each repetition, arcsec2, plain and weighted, (2, k)."""
        weights = np.ones_like(self.weight), self.weight
        return np.stack([np.bincount(self.stretch, each * left_arcsec**2) for each in weights])

    def unseen(self, fitted: Fitted) -> FloatArray:
        """Returns the sums (2, k) of squared errors of each repetition, predicted by a fit without its fold.

        Nuisances, such as zeros and the elastic state at the start, belong to the record. They keep their
        values, because no model predicts them. Shape parameters keep theirs too, because a linearised fit
        without a fold that alone shows a shape would change it without limit.
        """
        known = len(self.estimator.unknown.names)
        linear = [at for at, each in enumerate(fitted.parameters) if at >= known and not each.shape]
        predicted = np.array(linear, dtype=np.intp)
        fit, fold = fitted.linearised.of(predicted), self.stretch % FOLDS
        left = fit.residual.copy()
        steps = steps_without(fit, fold, lambda rows: White(np.ones(np.count_nonzero(rows))))
        for number, step in enumerate(steps):
            left[fold == number] -= fit.columns[fold == number] @ step
        return self.squares(left / self.estimator.weight)

    def gain(self, before: FloatArray, after: FloatArray) -> Gain:
        """Returns the gain, from the sums of squares (2, k) without and with the tested part."""
        samples = np.bincount(self.stretch).astype(np.float64)
        fall = before[1] - after[1]
        return Gain(self.over, int(np.max(self.stretch % FOLDS)) + 1, samples, before[0], after[0], fall)
