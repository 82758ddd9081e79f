"""Symmetric systems that may be singular: columns that a record cannot tell apart share what they explain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg.lapack import dposv

from hdbridge.effects import BoolArray, Effect, FloatArray, IntArray
from hdbridge.effects.described import Moves

NOTHING = 1e-20
"""Information below this is none."""
SEEN = 1e-9
"""Share of the largest eigenvalue of scaled columns below which a direction is not in the data."""
SUSPECT = 1e-6
"""Square of a Cholesky factor's diagonal below which the smallest eigenvalue is looked at."""


def solve_symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of a positive semi-definite system, columns scaled to one; what is not seen stays at zero."""
    if not len(matrix):
        return np.zeros_like(right)
    seen = np.diag(matrix) > 0.0
    if not np.all(seen):  # rounding on the scale of nothing could be anything
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
    """Inverse of a positive semi-definite matrix by its scaled eigenvalues; huge where it has none."""
    scale = np.sqrt(np.maximum(np.diag(matrix), NOTHING))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = vectors @ ((1.0 / np.maximum(values, 1e-12 * values[-1]))[:, np.newaxis] * vectors.T)
    return np.asarray(inverse / np.outer(scale, scale))


def seen_directions(gram: FloatArray) -> FloatArray:
    """Factor R, shape (p, r), with R' gram R = 1 over the directions that the data see.

    R R' is the pseudo-inverse of columns scaled to one, and ``columns @ R`` an orthonormal basis of theirs.
    """
    if not len(gram):
        return np.empty((0, 0))
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > SEEN * max(float(values[-1]), 1e-300)
    factor = vectors[:, kept] / scale[:, np.newaxis] / np.sqrt(values[kept])
    return np.where((np.diag(gram) > 0.0)[:, np.newaxis], factor, 0.0)


def side_by_side(parts: Sequence[FloatArray | BoolArray], rows: int) -> FloatArray:
    """Columns of some parts in one matrix, shape (rows, p), each column in one piece of memory.

    A long column that is spread over all rows takes as long to write, and to read, as the whole matrix.
    """
    result = np.empty((sum(each.shape[1] for each in parts), rows)).T
    at = 0
    for each in parts:
        result[:, at : at + each.shape[1]] = each
        at += each.shape[1]
    return result


def orthonormal(columns: FloatArray) -> FloatArray:
    """An orthonormal basis of what the columns span, shape (m, r)."""
    return np.asarray(columns @ seen_directions(columns.T @ columns))


# Stretches of a record, numbered point by point, and what is summed over them.


def of_length(time_s: FloatArray, length_s: float) -> IntArray:
    """A number per point that changes after every so many seconds; empty stretches are not counted."""
    return counted(np.floor((time_s - time_s[0]) / length_s).astype(np.intp))


def of_number(time_s: FloatArray, number: int) -> IntArray:
    """In which of so many equally long stretches of time each point lies, shape (n,)."""
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.asarray(np.minimum((time_s - time_s[0]) / span * number, number - 1), dtype=np.intp)


def counted(number: IntArray) -> IntArray:
    """The same stretches, numbered without gaps."""
    return np.asarray(np.unique(number, return_inverse=True)[1])


def sums(rows: FloatArray, number: IntArray) -> FloatArray:
    """Sums of rows (n, p) by their number, shape (numbers, p)."""
    return np.stack([np.bincount(number, each) for each in rows.T], axis=1)


def sandwich(influence: FloatArray, number: IntArray) -> FloatArray:
    """Covariance (p, p) of what is the sum of the influences of all points, (n, p), where those of one number
    may hang together (Liang and Zeger 1986).
    """
    summed, count = sums(influence, number), int(number[-1]) + 1
    return np.asarray(summed.T @ summed * (count / max(count - 1, 1)))


def about_zeros(left_arcsec: FloatArray, zero: IntArray, weight: FloatArray) -> FloatArray:
    """What is left (n,) about the weighted mean of each absolute zero; as it is where that weighs nothing."""
    total, weights = np.bincount(zero, weight * left_arcsec), np.bincount(zero, weight)
    return np.asarray(left_arcsec - (total / np.maximum(weights, 1e-300))[zero])


# What a fit is given: observations, columns, their weighting, what is known beforehand, its effort.


LOCAL = frozenset({Moves.ANYWHERE})
"""Shapes that a local step improves from anywhere."""
FOUND = LOCAL | {Moves.NEARBY}
"""... and those that a search has brought next to their best value."""

Columns = Callable[[Effect], FloatArray]


class Weighting(Protocol):
    """The inverse covariance of the noise, K^-1."""

    def apply(self, columns: FloatArray) -> FloatArray:
        """K^-1 times columns of shape (m,) or (m, p)."""
        ...


class Prior(NamedTuple):
    """What is known of a coefficient or shape beforehand (of a logarithmic shape: of its logarithm)."""

    mean: float
    information: float
    """One over the variance; less than nothing takes back what columns that are noisy themselves claim."""


FREE = Prior(0.0, 0.0)
"""Nothing is known."""


class Column(NamedTuple):
    """What a column of the fit stands for."""

    effect: int
    """Place of the effect, or -1 for a column that is no effect's."""
    name: str
    """Number of the coefficient, name of the shape parameter, or of the other column."""
    shape: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Effort:
    """How far a fit goes."""

    steps: int = 25
    converged: float = 1e-4
    """A step that promises, or gains, less than this in chi square is the last."""
    roughly: float = 0.0
    """... or less than this share of chi square: where much is left, exactness is of no use."""

    def enough(self, chi_square: float) -> float:
        """Gain in chi square below which the fit stands."""
        return max(self.converged, self.roughly * chi_square)


@dataclass(frozen=True, slots=True, eq=False)
class Nuisances:
    """Columns that are no effect's."""

    columns: FloatArray
    """Shape (b, q)."""
    names: tuple[str, ...]
    prior: tuple[Prior, ...]
    """What is known of each coefficient beforehand."""

    def and_also(self, other: Nuisances) -> Nuisances:
        """With further columns."""
        return Nuisances(
            side_by_side([self.columns, other.columns], len(self.columns)),
            (*self.names, *other.names),
            self.prior + other.prior,
        )

    def without(self, left_out: Callable[[str], bool]) -> Nuisances:
        """Without the columns whose names answer."""
        keep = np.array([not left_out(each) for each in self.names])
        return Nuisances(
            self.columns[:, keep], tuple(compress(self.names, keep)), tuple(compress(self.prior, keep))
        )


def unknown(columns: FloatArray | BoolArray, names: Sequence[str]) -> Nuisances:
    """Columns of which nothing is known."""
    return Nuisances(np.asarray(columns, dtype=np.float64), tuple(names), (FREE,) * len(names))


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """What is fitted to what; arrays of m rows."""

    observed: FloatArray
    """Arcsec, shape (m,)."""
    columns: Columns
    """Of an effect, (m, p): whatever its coefficients are."""
    weighting: Weighting
    nuisances: Nuisances
    prior: Mapping[tuple[int, str], Prior] = field(default_factory=dict)
    """By place of the effect, and number of the coefficient or name of the shape."""
    sign: Callable[[Effect], float] = lambda _: 0.0
    """The sign that an effect's coefficients have; 0 where they may have either."""
    moves: frozenset[Moves] = LOCAL
    """Shapes that are moved; the others stay as they are."""

    def known(self, columns: Sequence[Column]) -> FloatArray:
        """Mean and information beforehand of columns that begin with the nuisances', shape (p, 2)."""
        others = columns[len(self.nuisances.prior) :]
        own = [self.prior.get((each.effect, each.name), FREE) for each in others]
        return np.array([*self.nuisances.prior, *own], dtype=np.float64).reshape(-1, 2)


# A fit near its minimum, where it is linear: in coefficients and, by their tangents, in shapes.


@dataclass(frozen=True, eq=False)
class Linearised:
    """A fit at its minimum, or near it; rows in units of the noise, but for `steps_without`."""

    columns: FloatArray
    """Derivatives, shape (m, p)."""
    residual: FloatArray
    """Shape (m,)."""
    known: FloatArray
    """Per column the information beforehand, and that times how far its mean is off, shape (p, 2)."""

    @cached_property
    def directions(self) -> FloatArray:
        """R, shape (p, r), with R' (columns' columns + information) R = 1 over what the data see."""
        return seen_directions(self.columns.T @ self.columns + np.diag(self.known[:, 0]))

    @cached_property
    def basis(self) -> FloatArray:
        """B, shape (m, r): of a column c the fit leaves c'c - (B'c)'(B'c); orthonormal without a prior."""
        return np.asarray(self.columns @ self.directions)

    @cached_property
    def slack(self) -> FloatArray:
        """s, shape (r,): of a column's moment c'r the fit leaves c'r - (B'c)'s; none at its minimum."""
        return np.asarray(self.directions.T @ (self.columns.T @ self.residual + self.known[:, 1]))

    def of(self, places: IntArray) -> Linearised:
        """With some of its columns only."""
        return Linearised(self.columns[:, places], self.residual, self.known[places])

    def left(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the fit leaves of the Gram matrix (k, k) and of the moment (k,) of other columns (m, k)."""
        shadow = self.basis.T @ columns
        return columns.T @ columns - shadow.T @ shadow, columns.T @ self.residual - shadow.T @ self.slack

    def taken_over(self, columns: FloatArray) -> FloatArray:
        """Coefficients with which the fit would take over other columns (m, k), shape (p, k)."""
        return np.asarray(self.directions @ (self.basis.T @ columns))


def steps_without(
    fit: Linearised, fold: IntArray, weighting: Callable[[BoolArray], Weighting]
) -> list[FloatArray]:
    """For each fold the step, (p,), to the fit without it; ``weighting`` is that of some of the rows.

    A fold is weighted by itself, so that none knows of another by the noise that they have in common. What
    only the fold itself shows stays where it is.
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
