"""A fit near its minimum, where it is linear: in coefficients and, by their tangents, in shapes.

Whatever is asked of a fit without its being made again is asked here: what it explains of something else,
and where it would stand without a part of the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray
from hdbridge.estimation.linear import seen_directions, solve_symmetric
from hdbridge.estimation.terms import Weighting


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
