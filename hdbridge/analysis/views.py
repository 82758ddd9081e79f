"""Residuals of a model over every coordinate that a cause may depend on.

The coordinates are motor angle, load angle, direction, speed, acceleration, torque, temperature, time, and
travel and time since the last reversal. Residuals are averaged over bins, and the bin means are tested as
predictions of stretches of time from which they were not computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.analysis.gain import FOLDS, STRETCHES
from hdbridge.analysis.linear import of_number
from hdbridge.axis.effects import MEASURED, FloatArray, IntArray, Motion
from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.kinematics import direction_of

COARSE: Final = 16
"""Number of time bins, few enough that each has several stretches."""
SHRUNK: Final = 2.0
"""Number of zero-valued points added to each bin, because a mean of few points has no predictive value."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualViews:
    """Two residuals, and the coordinates over which to view them; arrays of shape (m,)."""

    given_arcsec: FloatArray
    """Measurement minus the given model, about zero."""
    left_arcsec: FloatArray
    """Measurement minus the extended model."""
    direction: FloatArray
    time_s: FloatArray
    coordinates: Mapping[str, Coordinate]

    def shares(self) -> dict[str, tuple[float, float]]:
        """Returns, per coordinate, the shares of the mean square that bin means predict, 0 to 1.

        The first share is that of the given model, the second that of the extended model. Noise has a share
        of zero.
        """
        fold = folds(self.time_s)

        def share(each: Coordinate, values: FloatArray) -> float:
            coarse = replace(each, bins=COARSE) if each.name == "time" else each
            left = values - predicted(coarse, values, self.direction, fold)
            return max(1.0 - float(left @ left) / max(float(values @ values), 1e-300), 0.0)

        return {
            name: (share(each, self.given_arcsec), share(each, self.left_arcsec))
            for name, each in self.coordinates.items()
        }


def coordinates(motion: Motion, rows: IntArray, ratio: float) -> dict[str, Coordinate]:
    """Returns the recorded coordinates that vary, at some points of a record."""
    found = (
        over.motor_angle(motion),
        over.load_angle(motion, ratio),
        over.position(motion, ratio),
        Coordinate("direction", "", direction_of(motion), bins=2),
        over.speed(motion),
        over.time(motion),
        over.since_reversal(motion),
        over.time_since_reversal(motion),
        over.since_change(motion),
        over.acceleration(motion),
        *(over.measured(motion, each) for each in MEASURED),
    )
    kept = (each.at(rows) for each in found)
    return {each.name: each for each in kept if each.varies()}


def folds(time_s: FloatArray) -> IntArray:
    """Assigns each point to one of `FOLDS` folds, shape (m,): every `FOLDS`-th stretch of time."""
    return np.asarray(of_number(time_s, STRETCHES) % FOLDS)


def predicted(
    coordinate: Coordinate, values: FloatArray, direction: FloatArray, fold: IntArray
) -> FloatArray:
    """Predicts the points of each fold by the bin means of all other folds, shape (m,)."""
    number = coordinate.numbers()
    if coordinate.both_ways:
        number = 2 * number + (direction < 0.0)
    bins = int(np.max(number)) + 1
    at = fold * bins + number
    total = np.bincount(at, values, FOLDS * bins).reshape(FOLDS, bins)
    count = np.bincount(at, minlength=FOLDS * bins).reshape(FOLDS, bins)
    mean = (np.sum(total, axis=0) - total) / (np.sum(count, axis=0) - count + SHRUNK)
    return np.asarray(mean.ravel()[at])
