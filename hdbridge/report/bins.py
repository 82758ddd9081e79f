"""Binned means of a coordinate, for charts."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge.axis.effects import BoolArray, FloatArray, IntArray
from hdbridge.axis.effects.coordinate import Coordinate

LEAST_IN_BIN: Final = 3
"""Minimum number of points per bin; emptier bins are not shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Means over sufficiently filled bins; arrays of one length."""

    place: FloatArray
    """Mean of the coordinate."""
    mean: FloatArray
    spread: FloatArray
    """Standard deviation of the points, not of their mean."""
    count: IntArray


def binned(
    coordinate: Coordinate, y: FloatArray, rows: BoolArray | None = None, least: int = LEAST_IN_BIN
) -> Bins:
    """Returns the means of y over a coordinate, using only ``rows`` if given.

    Bins with fewer than ``least`` points are left out.
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
