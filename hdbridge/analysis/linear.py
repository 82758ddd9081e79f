"""Linear algebra of fits: possibly singular symmetric systems, sandwich covariance, priors, held-out steps.

Columns that are not separable in a record share the variance they explain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress
from typing import NamedTuple, Protocol

import numpy as np

from hdbridge.axis.effects import BoolArray, Effect, FloatArray, IntArray
from hdbridge.axis.effects.described import Moves

NOTHING = 1e-20
"""Information below which a column counts as invisible."""
SEEN = 1e-9
"""Share of the largest eigenvalue of the scaled columns; a direction with a smaller eigenvalue is
undetermined."""
SUSPECT = 1e-6
"""Square of a Cholesky factor's diagonal below which the eigenvalues are computed instead."""


def solve_symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solves a positive semi-definite system with scaled columns; undetermined directions stay at zero."""
    from scipy.linalg.lapack import dposv  # noqa: PLC0415 - the daemon's service starts without scipy

    if not len(matrix):
        return np.zeros_like(right)
    seen = np.diag(matrix) > 0.0
    if not np.all(seen):  # unseen columns contain only rounding errors
        result = np.zeros_like(right)
        result[seen] = solve_symmetric(matrix[np.ix_(seen, seen)], right[seen])
        return result
    scale = np.sqrt(np.diag(matrix))
    spread = scale if right.ndim == 1 else scale[:, np.newaxis]
    scaled = matrix / np.outer(scale, scale)
    factor, solved, failed = dposv(scaled, right / spread, lower=1)
    if failed or np.min(np.diag(factor)) ** 2 < SUSPECT:
        directions = seen_directions(scaled)
        solved = directions @ (directions.T @ (right / spread))
    return np.asarray(solved / spread).reshape(right.shape)


def inverse_symmetric(matrix: FloatArray) -> FloatArray:
    """Inverts a positive semi-definite matrix by its scaled eigenvalues; huge where it is singular."""
    scale = np.sqrt(np.maximum(np.diag(matrix), NOTHING))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = vectors @ ((1.0 / np.maximum(values, 1e-12 * values[-1]))[:, np.newaxis] * vectors.T)
    return np.asarray(inverse / np.outer(scale, scale))


def seen_directions(gram: FloatArray) -> FloatArray:
    """Returns a factor R, shape (p, r), with R' gram R = 1 over the directions determined by the data.

    R R' is the pseudo-inverse of the scaled matrix, and ``columns @ R`` is an orthonormal basis of the
    columns.
    """
    if not len(gram):
        return np.empty((0, 0))
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > SEEN * max(float(values[-1]), 1e-300)
    factor = vectors[:, kept] / scale[:, np.newaxis] / np.sqrt(values[kept])
    return np.where((np.diag(gram) > 0.0)[:, np.newaxis], factor, 0.0)


def side_by_side(parts: Sequence[FloatArray | BoolArray], rows: int) -> FloatArray:
    """Concatenates columns into one matrix, shape (rows, p), each column contiguous in memory.

    Reading or writing one column of a row-major matrix takes as long as the whole matrix.
    """
    result = np.empty((sum(each.shape[1] for each in parts), rows)).T
    at = 0
    for each in parts:
        result[:, at : at + each.shape[1]] = each
        at += each.shape[1]
    return result


def orthonormal(columns: FloatArray) -> FloatArray:
    """Returns an orthonormal basis of the columns' span, shape (m, r)."""
    return np.asarray(columns @ seen_directions(columns.T @ columns))


# Stretches of a record, numbered point by point, and sums over them.


def of_length(time_s: FloatArray, length_s: float) -> IntArray:
    """Numbers the points by stretches of equal length; empty stretches are skipped."""
    return counted(np.floor((time_s - time_s[0]) / length_s).astype(np.intp))


def of_number(time_s: FloatArray, number: int) -> IntArray:
    """Numbers the points by ``number`` stretches of time of equal length, shape (n,)."""
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.asarray(np.minimum((time_s - time_s[0]) / span * number, number - 1), dtype=np.intp)


def counted(number: IntArray) -> IntArray:
    """Renumbers stretches without gaps."""
    return np.asarray(np.unique(number, return_inverse=True)[1])


def sums(rows: FloatArray, number: IntArray) -> FloatArray:
    """Sums rows (n, p) by their number, shape (numbers, p)."""
    return np.stack([np.bincount(number, each) for each in rows.T], axis=1)


def sandwich(influence: FloatArray, number: IntArray) -> FloatArray:
    """Returns the covariance (p, p) of the sum of the influences of all points, (n, p).

    Influences with the same number may be correlated (Liang and Zeger 1986).
    """
    summed = sums(influence, number)
    count = len(summed)
    return np.asarray(summed.T @ summed * (count / max(count - 1, 1)))


def about_zeros(left_arcsec: FloatArray, zero: IntArray, weight: FloatArray) -> FloatArray:
    """Subtracts the weighted mean of each absolute zero from a residual (n,); unchanged without weight."""
    total, weights = np.bincount(zero, weight * left_arcsec), np.bincount(zero, weight)
    return np.asarray(left_arcsec - (total / np.maximum(weights, 1e-300))[zero])


# Inputs of a fit: observations, columns, weighting, priors, effort.


LOCAL = frozenset({Moves.ANYWHERE})
"""Shapes that local steps improve from any start."""
FOUND = LOCAL | {Moves.NEARBY}
"""`LOCAL` shapes, and shapes that a search has brought close to their best value."""

Columns = Callable[[Effect], FloatArray]


class Weighting(Protocol):
    """The inverse covariance of the noise, K^-1."""

    def apply(self, columns: FloatArray) -> FloatArray:
        """Returns K^-1 times columns of shape (m,) or (m, p)."""
        ...


class Prior(NamedTuple):
    """Prior of a coefficient or shape, or of the logarithm of a logarithmic shape."""

    mean: float
    information: float
    """One over the variance. A negative value compensates for the apparent information of noisy columns."""


FREE = Prior(0.0, 0.0)
"""Prior without information."""


class Column(NamedTuple):
    """Parameter of one column of the fit."""

    effect: int
    """Place of the effect, or -1 for a nuisance."""
    name: str
    """Index of the coefficient, name of the shape, or name of the nuisance."""
    shape: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Effort:
    """Limits of a fit's iterations."""

    steps: int = 25
    converged: float = 1e-4
    """Predicted or actual fall in chi square below which the fit ends."""
    roughly: float = 0.0
    """Tolerance as a share of chi square, because a large residual requires no accuracy."""

    def enough(self, chi_square: float) -> float:
        """Returns the fall in chi square below which the fit ends."""
        return max(self.converged, self.roughly * chi_square)


@dataclass(frozen=True, slots=True, eq=False)
class Nuisances:
    """Columns that belong to no effect."""

    columns: FloatArray
    """Shape (b, q)."""
    names: tuple[str, ...]
    prior: tuple[Prior, ...]

    def and_also(self, other: Nuisances) -> Nuisances:
        """Returns these columns followed by others."""
        return Nuisances(
            side_by_side([self.columns, other.columns], len(self.columns)),
            (*self.names, *other.names),
            self.prior + other.prior,
        )

    def without(self, left_out: Callable[[str], bool]) -> Nuisances:
        """Returns the columns for whose names ``left_out`` returns False."""
        keep = np.array([not left_out(each) for each in self.names], dtype=np.bool_)
        return Nuisances(
            self.columns[:, keep], tuple(compress(self.names, keep)), tuple(compress(self.prior, keep))
        )


def unknown(columns: FloatArray | BoolArray, names: Sequence[str]) -> Nuisances:
    """Returns nuisances without prior information."""
    return Nuisances(np.asarray(columns, dtype=np.float64), tuple(names), (FREE,) * len(names))


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Inputs of a fit; arrays of m rows."""

    observed: FloatArray
    """Observations, arcsec, shape (m,)."""
    columns: Columns
    """Returns the columns of an effect, (m, p), independent of its coefficients."""
    weighting: Weighting
    nuisances: Nuisances
    prior: Mapping[tuple[int, str], Prior] = field(default_factory=dict)
    """Priors by place of the effect, and index of the coefficient or name of the shape."""
    sign: Callable[[Effect], float] = lambda _: 0.0
    """Sign required of an effect's coefficients; 0 for either sign."""
    moves: frozenset[Moves] = LOCAL
    """Kinds of shapes to fit; all others stay fixed."""

    def known(self, columns: Sequence[Column]) -> FloatArray:
        """Returns prior mean and information of columns, the nuisances first, shape (p, 2)."""
        others = columns[len(self.nuisances.prior) :]
        own = [self.prior.get((each.effect, each.name), FREE) for each in others]
        return np.array([*self.nuisances.prior, *own], dtype=np.float64).reshape(-1, 2)


# Fit linearised near its minimum, in coefficients and (by tangents) in shapes.


@dataclass(frozen=True, eq=False)
class Linearised:
    """Fit linearised at or near its minimum; rows in units of the noise, except for `steps_without`."""

    columns: FloatArray
    """Derivatives, shape (m, p)."""
    residual: FloatArray
    """Residual, shape (m,)."""
    known: FloatArray
    """Prior information of each column, and its product with (prior mean - value), shape (p, 2)."""

    @cached_property
    def directions(self) -> FloatArray:
        """R, shape (p, r), with R' (columns' columns + information) R = 1 over the determined directions."""
        return seen_directions(self.columns.T @ self.columns + np.diag(self.known[:, 0]))

    @cached_property
    def basis(self) -> FloatArray:
        """B, shape (m, r): a column's square c'c falls to c'c - (B'c)'(B'c); orthonormal without priors."""
        return np.asarray(self.columns @ self.directions)

    @cached_property
    def slack(self) -> FloatArray:
        """s, shape (r,): a column's moment c'r with the residual falls to c'r - (B'c)'s; 0 at the minimum."""
        return np.asarray(self.directions.T @ (self.columns.T @ self.residual + self.known[:, 1]))

    def of(self, places: IntArray) -> Linearised:
        """Returns the fit restricted to some of its columns."""
        return Linearised(self.columns[:, places], self.residual, self.known[places])

    def left(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns Gram matrix (k, k) and moment (k,) of other columns (m, k) after the fit."""
        shadow = self.basis.T @ columns
        return columns.T @ columns - shadow.T @ shadow, columns.T @ self.residual - shadow.T @ self.slack

    def taken_over(self, columns: FloatArray) -> FloatArray:
        """Returns the coefficients by which the fit would absorb other columns (m, k), shape (p, k)."""
        return np.asarray(self.directions @ (self.basis.T @ columns))


def steps_without(
    fit: Linearised, fold: IntArray, weighting: Callable[[BoolArray], Weighting]
) -> list[FloatArray]:
    """Returns, for each fold, the step (p,) to the fit without that fold; ``weighting`` weights a subset of
    rows.

    Each fold is weighted separately, so correlated noise does not connect folds. Parameters that only the
    fold itself determines stay unchanged.
    """
    grams, moments = [], []
    for number in range(int(np.max(fold)) + 1):
        rows = fold == number
        part = fit.columns[rows]
        weighted = weighting(rows).apply(part)
        grams.append(part.T @ weighted)
        moments.append(weighted.T @ fit.residual[rows])
    inside = np.diag(fit.known[:, 0])
    return [
        solve_symmetric(
            sum((each for each in grams if each is not gram), inside),
            sum((each for each in moments if each is not moment), fit.known[:, 1]),
        )
        for gram, moment in zip(grams, moments, strict=True)
    ]
