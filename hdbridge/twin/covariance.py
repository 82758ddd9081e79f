"""How sure a fit is of its coordinates: information by slopes, and a jackknife by legs."""

from __future__ import annotations

import numpy as np

from hdbridge.analysis.linear import counted as numbered
from hdbridge.analysis.linear import sums
from hdbridge.effects import FloatArray

LEAST = 1e-9
"""Of the information of all legs, a share that none of them has alone."""


def information_of(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """What residuals of unit variance and the prior say of the coordinates, shape (p, p)."""
    return np.asarray(slopes.T @ slopes + np.diag(spread**-2.0), dtype=np.float64)


def over_legs(rows: FloatArray, legs: FloatArray) -> FloatArray:
    """Sums of rows (n, p) over each leg, shape (legs, p); their squares make up for few legs."""
    by_leg = sums(rows, numbered(legs.astype(np.intp)))
    return np.asarray(by_leg * np.sqrt(len(by_leg) / max(len(by_leg) - 1, 1)), dtype=np.float64)


def principal(slopes: FloatArray, spread: FloatArray) -> FloatArray:
    """Directions of the coordinates, one a column, shape (p, p), in each of which the information is one.

    A long valley is one of them. Each may be known worse by a factor of its own; were each *coordinate*, what
    two of them have in common, which is known best of all, would be lost.
    """
    worth, directions = eigen(slopes, spread)
    return np.asarray(spread[:, None] * directions / np.sqrt(worth), dtype=np.float64)


def sandwich(slopes: FloatArray, left: FloatArray, legs: FloatArray, spread: FloatArray) -> FloatArray:
    """Covariance of the coordinates where residuals of one leg go together and legs are independent.

    By how far each leg alone has drawn the fit: without it, that would have ended elsewhere (jackknife by
    legs; Bell and McCaffrey, Survey Methodology 28, 2002). One leg that a replay cannot follow draws a fit
    by all that the others leave open, and has little left itself.

    By principal directions: of a few legs no more can be said. None is better known than independent
    residuals of the present size would have it, nor worse than before the fit. What the slopes would still
    take of the residuals is no scatter of the legs.
    """
    along = principal(slopes, spread)
    rows = slopes @ along
    left = left - slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
    numbers = numbered(legs.astype(np.intp))
    order = np.argsort(numbers, kind="stable")
    drawn = []
    for leg in np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1):
        others = (1.0 + LEAST) * np.eye(len(spread)) - rows[leg].T @ rows[leg]
        drawn.append(np.linalg.solve(others, rows[leg].T @ left[leg]))
    squares = np.sum(np.square(drawn), axis=0) * (1.0 - 1.0 / len(drawn))
    before = 1.0 / np.sum(np.square(along / spread[:, None]), axis=0)
    white = max(1.0, float(left @ left) / max(len(left) - len(spread), 1))
    times = np.minimum(np.maximum(squares, white), before)
    return np.asarray(along * times @ along.T, dtype=np.float64)


def eigen(slopes: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information and principal directions of the coordinates in units of their spreads."""
    _, size, directions = np.linalg.svd(root_of(slopes * spread, np.eye(len(spread))))
    return size**2, np.asarray(directions.T, dtype=np.float64)


def root_of(*tables: FloatArray) -> FloatArray:
    """Upper triangle whose transpose times it is the sum of these tables' own."""
    return np.asarray(np.linalg.qr(np.concatenate(tables), mode="r"), dtype=np.float64)
