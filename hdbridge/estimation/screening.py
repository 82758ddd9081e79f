"""Screening: every candidate's score on the residual, with the whole present hypothesis projected out.

One matrix product for all columns: with Q an orthonormal basis of the hypothesis's tangent and C a
candidate's columns, C'C - (Q'C)'(Q'C) is what is left of it, and its score is the chi square that it would
gain. So a grid of hundreds of shapes costs no more than one fit. A column of which less than `SHARE_LEFT` is
left is not in the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import CATALOGUE, Effect, FloatArray, Observations, Start, causes, unmet
from hdbridge.estimation.hypothesis import Estimator, Fitted

SHARE_LEFT = 1e-4


def candidates(observations: Observations, base: Sequence[Effect], screened: bool = True) -> list[Effect]:
    """What the catalogue proposes for a record and the model ``base``, over grids of shapes; all whose
    channels are there. Their coefficients are of no account.

    To be ``screened`` are those that would be an addition to the model, and that a grid covers; else all.
    """
    kinds = [CATALOGUE[each] for each in causes()]
    if screened:
        kinds = [each for each in kinds if each.changes is None and each.sought is None]
    return [each for kind in kinds for each in proposed(kind, observations, base)]


def proposed(kind: type[Effect], observations: Observations, base: Sequence[Effect] = ()) -> list[Effect]:
    """What a kind proposes for a record and the model ``base``, where its channels are there."""
    available = observations.motion.available()
    return [each for each in kind.proposals(observations, base) if not unmet([each], available)]


@dataclass(frozen=True, slots=True)
class Score:
    """What a candidate promises."""

    effect: Effect
    gain: float
    """Chi square that it would take away, linearised."""
    freedom: int
    """Directions of it that the hypothesis leaves."""
    share: float
    """Largest share of a column's square that the hypothesis leaves."""


class Screen:
    """The weighted columns of all candidates, made once."""

    def __init__(self, estimator: Estimator, candidates: Sequence[Effect], start: Start) -> None:
        self._candidates = tuple(candidates)
        blocks = [estimator.weighted(estimator.columns(each, start)) for each in candidates]
        self._slices: list[slice] = []
        at = 0
        for block in blocks:
            self._slices.append(slice(at, at + block.shape[1]))
            at += block.shape[1]
        self._matrix = np.hstack(blocks) if blocks else np.empty((len(estimator.index), 0))
        self._grams = [block.T @ block for block in blocks]

    def scores(self, fitted: Fitted) -> list[Score]:
        """Each candidate's, in their order."""
        fit, matrix = fitted.linearised, self._matrix
        shadow = fit.basis.T @ matrix
        moment = matrix.T @ fit.residual - shadow.T @ fit.slack
        return [
            _score(effect, np.diag(gram), gram - shadow[:, part].T @ shadow[:, part], moment[part])
            for effect, gram, part in zip(self._candidates, self._grams, self._slices, strict=True)
        ]


def score_of(effect: Effect, columns: FloatArray, fitted: Fitted) -> Score:
    """The score of one candidate from its weighted columns."""
    return _score(effect, np.sum(columns**2, axis=0), *fitted.linearised.left(columns))


def _score(effect: Effect, size: FloatArray, gram: FloatArray, moment: FloatArray) -> Score:
    """From the squares of its columns, and what a hypothesis leaves of their Gram matrix and moment."""
    seen = size > 0.0
    if not np.any(seen):
        return Score(effect, 0.0, 0, 0.0)
    scale = np.sqrt(size[seen])
    left = gram[np.ix_(seen, seen)] / np.outer(scale, scale)
    share = float(np.max(np.diag(left)))
    values, vectors = np.linalg.eigh(left)
    kept = values > SHARE_LEFT
    if not np.any(kept):
        return Score(effect, 0.0, 0, share)
    inner = vectors[:, kept].T @ (moment[seen] / scale)
    return Score(effect, float(np.sum(inner**2 / values[kept])), int(np.count_nonzero(kept)), share)
