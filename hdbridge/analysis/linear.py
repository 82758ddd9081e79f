"""Linear algebra of fits: possibly singular symmetric systems, sandwich covariance, priors, held-out steps.

Columns that are not separable in a record share the variance they explain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, wraps
from itertools import compress
from typing import NamedTuple, ParamSpec, Protocol, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from hdbridge.axis.effects import BoolArray, Effect, FloatArray, IntArray
from hdbridge.axis.effects.described import Moves

NOTHING = 1e-20
"""Minimum information used for scaling; a column with less is invisible."""
SEEN = 1e-9
"""Minimum eigenvalue of a determined direction, relative to the largest eigenvalue of the scaled matrix."""
SUSPECT = 1e-6
"""Squared diagonal element of the Cholesky factor below which eigenvalues are used instead."""


P = ParamSpec("P")
R = TypeVar("R")


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorates a function: its linear algebra runs on one thread.

    The matrices are small, so threads mostly wait for each other: next to other work, a diagnosis took 40
    times the processor time.
    """

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return run


def solve_symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solves a positive semi-definite system; the solution is zero in undetermined directions."""
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
    """Inverts a positive semi-definite matrix by eigenvalues; the result is huge in singular directions."""
    scale = np.sqrt(np.maximum(np.diag(matrix), NOTHING))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = vectors @ ((1.0 / np.maximum(values, 1e-12 * values[-1]))[:, np.newaxis] * vectors.T)
    return np.asarray(inverse / np.outer(scale, scale))


def seen_directions(gram: FloatArray) -> FloatArray:
    """Returns a factor R, shape (p, r), with R' gram R = 1 over the directions determined by the data.

    R R' is a pseudo-inverse of ``gram``. If ``gram`` is the Gram matrix of columns, ``columns @ R`` is an
    orthonormal basis of their span.
    """
    if not len(gram):
        return np.empty((0, 0))
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > SEEN * max(float(values[-1]), 1e-300)
    factor = vectors[:, kept] / scale[:, np.newaxis] / np.sqrt(values[kept])
    return np.where((np.diag(gram) > 0.0)[:, np.newaxis], factor, 0.0)


def side_by_side(parts: Sequence[FloatArray | BoolArray], rows: int) -> FloatArray:
    """Concatenates columns into one matrix, shape (rows, p), with each column contiguous in memory.

    In a row-major matrix, access to one column takes as long as access to the whole matrix.
    """
    result = np.empty((sum(each.shape[1] for each in parts), rows)).T
    at = 0
    for each in parts:
        result[:, at : at + each.shape[1]] = each
        at += each.shape[1]
    return result


def orthonormal(columns: FloatArray) -> FloatArray:
    """Returns an orthonormal basis of the span of the columns, shape (m, r)."""
    return np.asarray(columns @ seen_directions(columns.T @ columns))


# Division of a record into stretches, each point with the number of its stretch, and sums over stretches.


def of_length(time_s: FloatArray, length_s: float) -> IntArray:
    """Returns the number of each point's stretch, for stretches of equal duration; skips empty stretches."""
    return counted(np.floor((time_s - time_s[0]) / length_s).astype(np.intp))


def of_number(time_s: FloatArray, number: int) -> IntArray:
    """Returns the number of each point's stretch, (n,), for ``number`` stretches of equal duration."""
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.asarray(np.minimum((time_s - time_s[0]) / span * number, number - 1), dtype=np.intp)


def counted(number: IntArray) -> IntArray:
    """Renumbers stretches consecutively, without gaps."""
    return np.asarray(np.unique(number, return_inverse=True)[1])


def sums(rows: FloatArray, number: IntArray) -> FloatArray:
    """Returns the sum of all rows (n, p) with the same number, shape (numbers, p)."""
    return np.stack([np.bincount(number, each) for each in rows.T], axis=1)


def sandwich(influence: FloatArray, number: IntArray) -> FloatArray:
    """Returns the covariance (p, p) of the sum of all rows of ``influence`` (n, p).

    Rows with the same number may be correlated (Liang and Zeger 1986).
    """
    summed = sums(influence, number)
    count = len(summed)
    return np.asarray(summed.T @ summed * (count / max(count - 1, 1)))


def about_zeros(left_arcsec: FloatArray, zero: IntArray, weight: FloatArray) -> FloatArray:
    """Subtracts from a residual (n,) its weighted mean for each encoder zero, or 0 if the weights are 0."""
    total, weights = np.bincount(zero, weight * left_arcsec), np.bincount(zero, weight)
    return np.asarray(left_arcsec - (total / np.maximum(weights, 1e-300))[zero])


# Inputs of a fit: observations, columns, weighting, priors, effort.


LOCAL = frozenset({Moves.ANYWHERE})
"""Kinds of shape parameters for which local steps converge from any initial value."""
FOUND = LOCAL | {Moves.NEARBY}
"""`LOCAL` kinds, and those that converge if a search has found a value close to the best one."""

Columns = Callable[[Effect], FloatArray]


class Weighting(Protocol):
    """Interface of the inverse covariance of the noise, K^-1."""

    def apply(self, columns: FloatArray) -> FloatArray:
        """Returns K^-1 times columns of shape (m,) or (m, p)."""
        ...


class Prior(NamedTuple):
    """Prior of a coefficient or a shape parameter; of the logarithm if the shape is logarithmic."""

    mean: float
    information: float
    """Inverse variance. A negative value compensates for the apparent information of noisy columns."""


FREE = Prior(0.0, 0.0)
"""Prior without information."""


class Column(NamedTuple):
    """Parameter to which a column of the fit belongs."""

    effect: int
    """Index of the effect in the fit; -1 for a nuisance."""
    name: str
    """Index of the coefficient, name of the shape, or name of the nuisance."""
    shape: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Effort:
    """Limits of a fit's iterations."""

    steps: int = 25
    converged: float = 1e-4
    """Decrease in chi square, predicted or actual, below which the fit ends."""
    roughly: float = 0.0
    """Tolerance relative to chi square, because a large residual requires little accuracy."""

    def enough(self, chi_square: float) -> float:
        """Returns the decrease in chi square below which the fit ends."""
        return max(self.converged, self.roughly * chi_square)


@dataclass(frozen=True, slots=True, eq=False)
class Nuisances:
    """Columns of a fit that belong to no effect."""

    columns: FloatArray
    """Columns, shape (b, q)."""
    names: tuple[str, ...]
    prior: tuple[Prior, ...]

    def and_also(self, other: Nuisances) -> Nuisances:
        """Returns these columns followed by those of ``other``."""
        return Nuisances(
            side_by_side([self.columns, other.columns], len(self.columns)),
            (*self.names, *other.names),
            self.prior + other.prior,
        )

    def without(self, left_out: Callable[[str], bool]) -> Nuisances:
        """Returns the nuisances except those for whose names ``left_out`` returns True."""
        keep = np.array([not left_out(each) for each in self.names], dtype=np.bool_)
        return Nuisances(
            self.columns[:, keep], tuple(compress(self.names, keep)), tuple(compress(self.prior, keep))
        )


def unknown(columns: FloatArray | BoolArray, names: Sequence[str]) -> Nuisances:
    """Returns nuisances without prior information."""
    return Nuisances(np.asarray(columns, dtype=np.float64), tuple(names), (FREE,) * len(names))


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Inputs of a fit; arrays have m rows."""

    observed: FloatArray
    """Observations, arcsec, shape (m,)."""
    columns: Columns
    """Function that returns an effect's columns (m, p), which do not depend on its coefficients."""
    weighting: Weighting
    nuisances: Nuisances
    prior: Mapping[tuple[int, str], Prior] = field(default_factory=dict)
    """Priors, by the effect's index and the coefficient's index or shape parameter's name."""
    sign: Callable[[Effect], float] = lambda _: 0.0
    """Function that returns the required sign of an effect's coefficients; 0 permits either sign."""
    moves: frozenset[Moves] = LOCAL
    """Kinds of shape parameters to fit; all others stay fixed."""

    def known(self, columns: Sequence[Column]) -> FloatArray:
        """Returns the prior mean and information of each column, nuisances first, shape (p, 2)."""
        others = columns[len(self.nuisances.prior) :]
        own = [self.prior.get((each.effect, each.name), FREE) for each in others]
        return np.array([*self.nuisances.prior, *own], dtype=np.float64).reshape(-1, 2)


# Fit linearised near its minimum, in coefficients and (by tangents) in shape parameters.


@dataclass(frozen=True, eq=False)
class Linearised:
    """Fit linearised at or near its minimum. Rows are in standard deviations of the noise, except for
    `steps_without`.
    """

    columns: FloatArray
    """Derivatives of the prediction by the parameters, shape (m, p)."""
    residual: FloatArray
    """Residual, shape (m,)."""
    known: FloatArray
    """Prior information of each column, and its product with (prior mean - value), shape (p, 2)."""

    @cached_property
    def directions(self) -> FloatArray:
        """R, shape (p, r), with R' (C'C + prior information) R = 1 over the determined directions; C are the
        columns.
        """
        return seen_directions(self.columns.T @ self.columns + np.diag(self.known[:, 0]))

    @cached_property
    def basis(self) -> FloatArray:
        """B, shape (m, r). The fit reduces a column's c'c to c'c - (B'c)'(B'c). Without priors, B is
        orthonormal.
        """
        return np.asarray(self.columns @ self.directions)

    @cached_property
    def slack(self) -> FloatArray:
        """s, shape (r,). The fit reduces a column's product c'r with the residual r to c'r - (B'c)'s. At the
        minimum, s is 0.
        """
        return np.asarray(self.directions.T @ (self.columns.T @ self.residual + self.known[:, 1]))

    def of(self, places: IntArray) -> Linearised:
        """Returns the fit restricted to the columns at ``places``."""
        return Linearised(self.columns[:, places], self.residual, self.known[places])

    def left(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the Gram matrix (k, k) and moment (k,) of columns (m, k), less the fit's contribution."""
        shadow = self.basis.T @ columns
        return columns.T @ columns - shadow.T @ shadow, columns.T @ self.residual - shadow.T @ self.slack

    def taken_over(self, columns: FloatArray) -> FloatArray:
        """Returns the parameter changes (p, k) by which the fit would absorb other columns (m, k)."""
        return np.asarray(self.directions @ (self.basis.T @ columns))


def steps_without(
    fit: Linearised, fold: IntArray, weighting: Callable[[BoolArray], Weighting]
) -> list[FloatArray]:
    """Returns, for each fold, the parameter step (p,) from the full fit to the fit without that fold.

    ``weighting`` returns the weighting of a subset of rows. Each fold is weighted separately, so correlated
    noise does not connect folds. Parameters that only the fold itself determines stay unchanged.
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
