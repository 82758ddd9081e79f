"""Means over the bins of a coordinate, as a chart shows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray
from hdbridge.effects.coordinate import Coordinate

LEAST_IN_BIN: Final = 3
"""Points; the mean of fewer is not shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Means over bins, those with points enough; arrays of one length."""

    place: FloatArray
    """Mean of the coordinate."""
    mean: FloatArray
    spread: FloatArray
    """Standard deviation of the points, not of their mean."""
    count: IntArray


def binned(
    coordinate: Coordinate, y: FloatArray, rows: BoolArray | None = None, least: int = LEAST_IN_BIN
) -> Bins:
    """Means of y over a coordinate; of the chosen ``rows`` only, where given.

    Bins of fewer than ``least`` points are left out.
    """
    number, x = coordinate.numbers(), coordinate.values
    if rows is not None:
        number, x, y = number[rows], x[rows], y[rows]
    count = np.bincount(number)
    kept = np.flatnonzero(count >= least)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(number, values, len(count))[kept] / count[kept])

    middle = mean(y)
    spread = np.sqrt(np.maximum(mean(y**2) - middle**2, 0.0))
    return Bins(mean(x), middle, np.asarray(spread), count[kept])
