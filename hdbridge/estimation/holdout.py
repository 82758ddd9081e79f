"""Fits that have not seen a part of the data, for what is left of that part to be judged.

Near its minimum a fit is linear (in coefficients and, by their tangents, in shapes): without a part of the
data it is a step away, by the Gram matrices of the other parts. Each part is weighted by itself, so that
none knows of another by the noise that they have in common.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray
from hdbridge.estimation.linear import solve_symmetric
from hdbridge.estimation.terms import Weighting


class Linearised(NamedTuple):
    """A fit at its minimum, or near it."""

    columns: FloatArray
    """Derivatives, shape (m, p)."""
    residual: FloatArray
    """Shape (m,)."""
    known: FloatArray
    """Per column the information beforehand, and that times how far its mean is off, shape (p, 2)."""


def steps_without(
    fit: Linearised, fold: IntArray, weighting: Callable[[BoolArray], Weighting]
) -> list[FloatArray]:
    """For each fold the step, (p,), to the fit without it; ``weighting`` is that of some of the rows.

    What only the fold itself shows stays where it is.
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
