"""What a model gets wrong, over every coordinate that a cause may depend on.

A residual is looked at over motor angle, load angle, direction, speed, acceleration, torque, temperature,
time and what has passed since the last reversal: means over bins, and how much of the residual they foretell
on stretches of time that had no part in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.analysis.gain import FOLDS, STRETCHES
from hdbridge.analysis.linear import of_number
from hdbridge.effects import MEASURED, FloatArray, IntArray, Motion
from hdbridge.effects import coordinate as over
from hdbridge.effects.coordinate import Coordinate
from hdbridge.effects.kinematics import direction_of

COARSE: Final = 16
"""Bins of time: wide enough that each has several stretches."""
SHRUNK: Final = 2.0
"""Points with a mean of zero that each bin has in addition: a mean of few points foretells nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualViews:
    """Two residuals and what they are looked at over; arrays of shape (m,)."""

    given_arcsec: FloatArray
    """Measurement less the model as it was given, about zero."""
    left_arcsec: FloatArray
    """Measurement less the extended model."""
    direction: FloatArray
    time_s: FloatArray
    coordinates: Mapping[str, Coordinate]
    """By name."""

    def shares(self) -> dict[str, tuple[float, float]]:
        """Per coordinate the share of the mean square that bin means foretell, of both residuals, 0 to 1.

        Noise has a share of zero.
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
    """What a record can be looked at over at some of its points; only what was recorded, and what varies."""
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
    """Which of `FOLDS` parts of the record each point is in, shape (m,): every so many-th stretch of time."""
    return np.asarray(of_number(time_s, STRETCHES) % FOLDS)


def predicted(
    coordinate: Coordinate, values: FloatArray, direction: FloatArray, fold: IntArray
) -> FloatArray:
    """What the bin means of all other folds say of the points of each, shape (m,)."""
    number = coordinate.numbers()
    if coordinate.both_ways:
        number = 2 * number + (direction < 0.0)
    bins = int(np.max(number)) + 1
    at = fold * bins + number
    total = np.bincount(at, values, FOLDS * bins).reshape(FOLDS, bins)
    count = np.bincount(at, minlength=FOLDS * bins).reshape(FOLDS, bins)
    mean = (np.sum(total, axis=0) - total) / (np.sum(count, axis=0) - count + SHRUNK)
    return np.asarray(mean.ravel()[at])
