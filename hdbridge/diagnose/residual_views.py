"""What a model gets wrong, over every coordinate that a cause may depend on.

A residual is looked at over motor angle, load angle, direction, speed, acceleration, torque, temperature,
time and what has passed since the last reversal: means over bins on every other stretch of time, and how much
of the residual they foretell on the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.effects import MEASURED, BoolArray, FloatArray, IntArray, Motion
from hdbridge.effects import coordinate as over
from hdbridge.effects.coordinate import Coordinate
from hdbridge.effects.kinematics import direction_of
from hdbridge.estimation.stretches import of_number

STRETCHES: Final = 64
"""Of time, every other one is held out in turn."""
COARSE: Final = 16
"""Bins of time: wide enough that each has stretches of either half."""
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
        odd = every_other(self.time_s)

        def share(each: Coordinate, values: FloatArray) -> float:
            coarse = replace(each, bins=COARSE) if each.name == "time" else each
            gain = foretold(coarse, values, self.direction, odd)
            return max(gain / max(float(np.mean(values**2)), 1e-300), 0.0)

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


def every_other(time_s: FloatArray) -> BoolArray:
    """The points in every other stretch of time, shape (m,)."""
    return np.asarray(of_number(time_s, STRETCHES) % 2 == 1)


def foretold(coordinate: Coordinate, values: FloatArray, direction: FloatArray, odd: BoolArray) -> float:
    """Mean square of ``values`` (m,) that bin means of one half of the points take away in the other."""
    number = coordinate.numbers()
    bins = int(np.max(number)) + 1
    if coordinate.both_ways:
        number = number + bins * (direction < 0.0)
        bins *= 2
    gained = 0.0
    for train in (odd, ~odd):
        count = np.bincount(number[train], minlength=bins)
        mean = np.bincount(number[train], values[train], bins) / (count + SHRUNK)
        test = values[~train]
        gained += float(np.sum(test**2) - np.sum((test - mean[number[~train]]) ** 2))
    return gained / len(values)
