"""Seeing: what a model gets wrong, over every coordinate that a cause may depend on.

A residual is looked at over motor angle, load angle, direction, speed, acceleration, torque, temperature,
time and what has passed since the last reversal: means over bins, and how much of the residual they foretell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdbridge.effects import MEASURED, BoolArray, FloatArray
from hdbridge.effects import coordinate as over
from hdbridge.effects.coordinate import Coordinate
from hdbridge.estimation.stretches import of_number

if TYPE_CHECKING:
    from hdbridge.diagnose.result import Diagnosis, Traces


STRETCHES: Final = 64
"""Of time, every other one is held out in turn."""
COARSE: Final = 16
"""Bins of time: wide enough that each has stretches of either half."""


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

        Means are taken on every other stretch of time and judged on the rest: noise has a share of zero.
        """
        odd = of_number(self.time_s, STRETCHES) % 2 == 1
        return {
            name: (
                _share(each, self.given_arcsec, self.direction, odd),
                _share(each, self.left_arcsec, self.direction, odd),
            )
            for name, each in self.coordinates.items()
        }


def see(diagnosis: Diagnosis) -> ResidualViews:
    """Look at a diagnosis's residuals."""
    traces = diagnosis.traces
    return ResidualViews(
        traces.measured_arcsec - traces.model_arcsec,
        traces.measured_arcsec - traces.extended_arcsec,
        traces.direction,
        traces.time_s,
        coordinates(traces, diagnosis.model.ratio),
    )


def shares_by_coordinate(diagnosis: Diagnosis) -> dict[str, Any]:
    """`ResidualViews.shares` for machines."""
    seen = see(diagnosis)
    return {
        name: {"share_of_baseline": round(before, 4), "share_of_extended": round(after, 4)}
        for name, (before, after) in seen.shares().items()
    }


def coordinates(traces: Traces, ratio: float) -> dict[str, Coordinate]:
    """What a record can be looked at over; only what was recorded, and what varies."""
    motion, rows = traces.motion, traces.rows
    found = [
        over.motor_angle(motion),
        over.load_angle(motion, ratio),
        over.position(motion, ratio),
        over.speed(motion),
        over.time(motion),
        over.since_reversal(motion),
        over.time_since_reversal(motion),
        over.since_change(motion),
        over.acceleration(motion),
        *(over.measured(motion, each) for each in MEASURED),
    ]
    kept = [Coordinate("direction", "", traces.direction, bins=2), *(each.at(rows) for each in found)]
    order = ("motor angle", "load angle", "position", "direction")
    kept.sort(key=lambda each: order.index(each.name) if each.name in order else len(order))
    return {each.name: each for each in kept if each.varies()}


def _share(coordinate: Coordinate, y: FloatArray, direction: FloatArray, odd: BoolArray) -> float:
    if coordinate.name == "time":
        coordinate = replace(coordinate, bins=COARSE)
    number = coordinate.numbers()
    bins = int(np.max(number)) + 1
    if coordinate.both_ways:
        number = number + bins * (direction < 0.0)
        bins *= 2
    total = left = 0.0
    for train in (odd, ~odd):
        count = np.bincount(number[train], minlength=bins)
        mean = np.bincount(number[train], y[train], bins) / (count + 1.0)
        test = y[~train]
        total += float(np.sum(test**2))
        left += float(np.sum((test - mean[number[~train]]) ** 2))
    return max(1.0 - left / total, 0.0) if total > 0.0 else 0.0
