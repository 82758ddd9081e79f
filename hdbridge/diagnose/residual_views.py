"""Seeing: what a model gets wrong, over every coordinate that a cause may depend on.

A residual is looked at over motor angle, load angle, direction, speed, acceleration, torque, temperature,
time and what has passed since the last reversal: means over bins, and how much of the residual they foretell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import Channel, FloatArray, Motion
from hdbridge.effects.base import MEASURED
from hdbridge.effects.path import branches
from hdbridge.units import DEG_PER_TURN

if TYPE_CHECKING:
    from hdbridge.diagnose.result import Diagnosis, Traces

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

LEAST_IN_BIN: Final = 3
"""Points; the mean of fewer is not shown."""
POINTS_PER_BIN: Final = 8
LEAST_BINS: Final = 2
SAME: Final = 1e-6
"""A quantity that varies by less than this share of itself is one value, rounded."""
NOTHING: Final = 1e-9
"""... and so is one that varies by no more than this in its unit."""
STRETCHES: Final = 64
"""Of time, every other one is held out in turn."""
SMALLEST_WAY_DEG: Final = 0.01
SMALLEST_TIME_S: Final = 0.01
"""Less than this since a reversal counts as this, so that a logarithm can be taken."""
COARSE: Final = 16
"""Bins of time: wide enough that each has stretches of either half."""


class Spacing(Enum):
    """How the bins over a coordinate lie."""

    EVEN = "even"
    FILLED = "filled"
    """With equally many points in each: for what mostly keeps to a few values, like a speed."""
    LOGARITHMIC = "logarithmic"


@dataclass(frozen=True, slots=True, eq=False)
class Coordinate:
    """A quantity along a record, at the points of `Traces`."""

    name: str
    unit: str
    values: FloatArray
    both_ways: bool = False
    """Whether forward and backward are looked at apart."""
    spacing: Spacing = Spacing.EVEN
    bins: int = 72
    """At most; fewer where there are not `POINTS_PER_BIN` points for each."""

    @property
    def label(self) -> str:
        """Name and unit, for an axis."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def edges(self) -> FloatArray:
        """Of the bins, shape (b + 1,), rising; two equal ones where there is but one value."""
        low, high = float(np.min(self.values)), float(np.max(self.values))
        bins = min(self.bins, max(len(self.values) // POINTS_PER_BIN, LEAST_BINS))
        if self.spacing is Spacing.FILLED:
            return np.asarray(np.unique(np.quantile(self.values, np.linspace(0.0, 1.0, bins + 1))))
        if self.spacing is Spacing.LOGARITHMIC and low > 0.0:
            return np.geomspace(low, high, bins + 1)
        return np.linspace(low, high, bins + 1)

    def numbers(self) -> IntArray:
        """The bin of each point, shape (m,)."""
        edges = self.edges()
        found = np.searchsorted(edges, self.values, "right") - 1
        return np.asarray(np.clip(found, 0, max(len(edges) - 2, 0)), dtype=np.intp)


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
        odd = _stretches(self.time_s) % 2 == 1
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
    motor = traces.motor_deg
    load = motor / ratio
    way, since_s = since_reversal(motion)
    found = [
        Coordinate("motor angle", "deg", np.mod(motor, DEG_PER_TURN), both_ways=True),
        Coordinate("load angle", "deg", np.mod(load, DEG_PER_TURN), both_ways=True),
        Coordinate("position", "deg of the load", load, both_ways=True),
        Coordinate("direction", "", traces.direction, bins=2),
        Coordinate("speed", "motor deg/s", traces.speed_deg_s, spacing=Spacing.FILLED, bins=40),
        Coordinate("time", "s", traces.time_s, bins=100),
        _logarithmic("motor angle since the last reversal", "deg", way[rows], SMALLEST_WAY_DEG),
        _logarithmic("time since the last reversal", "s", since_s[rows], SMALLEST_TIME_S),
        _logarithmic("time since the last stop or start", "s", since_change_s(motion)[rows], SMALLEST_TIME_S),
    ]
    for name, unit, values in (
        ("acceleration", "motor deg/s\N{SUPERSCRIPT TWO}", motion.motor_acceleration_deg_s2),
        *((each.title, each.unit, motion.measured.get(each)) for each in MEASURED),
    ):
        if values is not None:
            spacing = Spacing.EVEN if name == Channel.TEMPERATURE.title else Spacing.FILLED
            found.append(Coordinate(name, unit, values[rows], spacing=spacing, bins=40))
    return {each.name: each for each in found if _varies(each.values)}


def since_reversal(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Motor angle (degrees) and time (s) since the axis last reversed or the record began, shape (n,)."""
    angle = motion.motor_deg
    time = _time(motion)
    turning = np.asarray(branches(angle)[0][:-1] or [0], dtype=np.intp)
    last = turning[np.maximum(np.searchsorted(turning, np.arange(len(angle)), "left") - 1, 0)]
    return np.abs(angle - angle[last]), np.maximum(time - time[last], 0.0)


def since_change_s(motion: Motion) -> FloatArray:
    """Time since the axis last stopped, started or reversed, seconds, shape (n,)."""
    speed, time = motion.motor_speed_deg_s, _time(motion)
    assert speed is not None, "a diagnosis gives its motion the speed"
    change = np.flatnonzero(np.diff(np.sign(speed), prepend=np.nan) != 0.0)
    last = change[np.searchsorted(change, np.arange(len(motion)), "right") - 1]
    return np.asarray(time - time[last])


def _varies(values: FloatArray) -> bool:
    return bool(np.ptp(values) > SAME * np.max(np.abs(values)) + NOTHING)


def _time(motion: Motion) -> FloatArray:
    assert motion.time_s is not None, "a diagnosis gives its motion the time"
    return motion.time_s


def _logarithmic(name: str, unit: str, values: FloatArray, smallest: float) -> Coordinate:
    return Coordinate(name, unit, np.maximum(values, smallest), True, Spacing.LOGARITHMIC, 40)


def _stretches(time_s: FloatArray) -> IntArray:
    span = max(float(time_s[-1] - time_s[0]), 1e-9)
    return np.asarray(np.minimum((time_s - time_s[0]) / span * STRETCHES, STRETCHES - 1), dtype=np.intp)


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
