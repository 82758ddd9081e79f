"""Gain of a model on held-out data."""

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
"""Minimum significance of a gain, standard errors."""
NEARLY_ALL = 0.75
"""Minimum share of recordings that a cause must predict better: all of three or four, four of five."""
SHARED = 1.5
"""Minimum number of stretches that share a gain; one event is one or, at their border, two unequal ones."""
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
        """True if it lowers the error of what was left out, in nearly all recordings or more than one part.

        The square of the sum over the sum of squares is the number of stretches among which the fall is
        shared.
        """
        fall = self.before_arcsec2 - self.after_arcsec2
        shared = float(np.sum(fall)) ** 2 > SHARED * float(fall @ fall)
        return self.recovered > 0.0 and (self.repeated if self.over == RECORDINGS else shared)

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
    """Returns the number of each point's repetition, (m,): recordings, else moves, else stretches of time.

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
    parts = _Parts.of(estimator, after.count())
    return None if parts is None else parts.gain(parts.unseen(before), parts.unseen(after))


def of_written(
    estimator: Estimator,
    fitted: Fitted,
    given: Sequence[Effect],
    others: Iterable[Collection[int]],
    written: Collection[int],
) -> list[Gain | None]:
    """Returns the gain of the written model for each finding, over the ``given`` one with the other findings.

    ``others``, for each finding, and ``written`` are places of effects in the fit. No model is fitted again,
    so a fresh record can repeat the comparison. The squares of the written model include the loss of its fit
    in repetitions that are left out.
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
        return parts.squares(estimator.left_by(used)[0])

    lost = parts.unseen(fitted) - parts.squares(fitted.residual / estimator.weight)
    after = squares(written) + lost
    return [parts.gain(squares(each), after) for each in others]


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Repetitions in a record, each of which is left out in turn."""

    estimator: Estimator
    stretch: IntArray
    """Number of each point's stretch, shape (m,)."""
    over: str

    @classmethod
    def of(cls, estimator: Estimator, parameters: int) -> _Parts | None:
        """Returns the parts; None if the record is too short for this number of parameters."""
        stretch, over = repeats(estimator)
        largest = np.max(np.bincount(stretch % FOLDS))
        if np.max(stretch) + 1 < REPEATS or len(stretch) - largest < parameters:
            return None
        return cls(estimator, stretch, over)

    def squares(self, left_arcsec: FloatArray) -> FloatArray:
        """Returns the sum of squares of each stretch, arcsec2."""
        return np.asarray(np.bincount(self.stretch, left_arcsec**2))

    def unseen(self, fitted: Fitted) -> FloatArray:
        """Returns the squares of each stretch, as predicted by a fit without its fold.

        Nuisances, such as zeros and the elastic state at the start, belong to the record. They keep their
        values, because no model predicts them.
        """
        predicted = np.arange(len(self.estimator.unknown.names), fitted.count())
        fit, fold = fitted.linearised.of(predicted), self.stretch % FOLDS
        left = fit.residual.copy()
        steps = steps_without(fit, fold, lambda rows: White(np.ones(np.count_nonzero(rows))))
        for number, step in enumerate(steps):
            left[fold == number] -= fit.columns[fold == number] @ step
        return self.squares(left / self.estimator.weight)

    def gain(self, before: FloatArray, after: FloatArray) -> Gain:
        """Returns the gain from the sums of squares."""
        samples = np.bincount(self.stretch).astype(np.float64)
        return Gain(self.over, int(np.max(self.stretch % FOLDS)) + 1, samples, before, after)
