"""Residuals of a model over each coordinate on which a cause may depend.

The coordinates are motor angle, load angle, direction, speed, acceleration, torque, temperature, time, and
travel and time since the last reversal. Residuals are averaged over bins. The bin means are tested as
predictions of other stretches of time than those from which they were computed.
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
"""Number of time bins, small enough for each to contain several stretches of time."""
SHRUNK: Final = 2.0
"""Number of zero-valued points added to each bin, because a mean of few points is a poor prediction."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualViews:
    """Two residuals, and the coordinates over which to view them; arrays of shape (m,)."""

    given_arcsec: FloatArray
    """Measurement minus the given model."""
    left_arcsec: FloatArray
    """Measurement minus the extended model."""
    direction: FloatArray
    time_s: FloatArray
    coordinates: Mapping[str, Coordinate]

    def shares(self) -> dict[str, tuple[float, float]]:
        """Returns the fractions of the mean square, 0 to 1, that bin means predict, by coordinate.

        The first fraction is for the given model, the second for the extended model. It is 0 for noise.
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
    """Returns the recorded coordinates that vary over the selected points, by name."""
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
    """Predicts the points of each fold from the bin means of all other folds, shape (m,)."""
    number = coordinate.numbers()
    if coordinate.both_ways:
        number = 2 * number + (direction < 0.0)
    bins = int(np.max(number)) + 1
    at = fold * bins + number
    total = np.bincount(at, values, FOLDS * bins).reshape(FOLDS, bins)
    count = np.bincount(at, minlength=FOLDS * bins).reshape(FOLDS, bins)
    mean = (np.sum(total, axis=0) - total) / (np.sum(count, axis=0) - count + SHRUNK)
    return np.asarray(mean.ravel()[at])
