"""Coordinates: quantities on which an error may depend, for plots and unexplained residuals."""

from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, Self

import numpy as np

from hdbridge.axis.effects.motion import BoolArray, Channel, FloatArray, IntArray, Motion
from hdbridge.axis.effects.path import branches
from hdbridge.units import DEG_PER_TURN

POINTS_PER_BIN: Final = 8
LEAST_BINS: Final = 2
SAME: Final = 1e-6
"""Range, relative to the largest value, below which a quantity counts as constant, to allow for rounding."""
NOTHING: Final = 1e-9
"""Absolute range below which a quantity counts as constant, in its unit."""
SMALLEST_WAY_DEG: Final = 0.01
SMALLEST_TIME_S: Final = 0.01
"""Lower limits of the angle and the time since a reversal, for a finite logarithm."""


class Spacing(Enum):
    """Spacing of the bins over a coordinate."""

    EVEN = "even"
    FILLED = "filled"
    """Equal numbers of points per bin, for quantities with few different values, such as a speed."""
    LOGARITHMIC = "logarithmic"


@dataclass(frozen=True, slots=True, eq=False)
class Coordinate:
    """A quantity on which an error may depend, at each sample of a motion."""

    name: str
    unit: str
    values: FloatArray
    """One value per sample, shape (n,)."""
    both_ways: bool = False
    """True if forward and backward motion are shown separately."""
    spacing: Spacing = Spacing.EVEN
    bins: int = 72
    """Maximum number of bins; reduced to keep at least `POINTS_PER_BIN` points per bin."""

    @property
    def label(self) -> str:
        """Name and unit, for a plot axis."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def at(self, rows: BoolArray | IntArray) -> Self:
        """Returns the coordinate restricted to the samples in ``rows``."""
        return replace(self, values=self.values[rows])

    def varies(self) -> bool:
        """Returns True if the quantity is not constant, apart from rounding."""
        return bool(np.ptp(self.values) > SAME * np.max(np.abs(self.values)) + NOTHING)

    def edges(self) -> FloatArray:
        """Returns the bin edges in ascending order, shape (b + 1,)."""
        low, high = float(np.min(self.values)), float(np.max(self.values))
        bins = min(self.bins, max(len(self.values) // POINTS_PER_BIN, LEAST_BINS))
        if self.spacing is Spacing.FILLED:
            return np.asarray(np.unique(np.quantile(self.values, np.linspace(0.0, 1.0, bins + 1))))
        if self.spacing is Spacing.LOGARITHMIC and low > 0.0:
            return np.geomspace(low, high, bins + 1)
        return np.linspace(low, high, bins + 1)

    def numbers(self) -> IntArray:
        """Returns the bin number of each sample, shape (n,)."""
        edges = self.edges()
        found = np.searchsorted(edges, self.values, "right") - 1
        return np.asarray(np.clip(found, 0, max(len(edges) - 2, 0)), dtype=np.intp)


def motor_angle(motion: Motion) -> Coordinate:
    """Returns the motor angle modulo one turn."""
    return Coordinate("motor angle", "deg", np.mod(motion.motor_deg, DEG_PER_TURN), both_ways=True)


def load_angle(motion: Motion, ratio: float) -> Coordinate:
    """Returns the load angle modulo one turn."""
    return Coordinate("load angle", "deg", np.mod(motion.motor_deg / ratio, DEG_PER_TURN), both_ways=True)


def position(motion: Motion, ratio: float) -> Coordinate:
    """Returns the multi-turn load position."""
    return Coordinate("position", "deg of the load", motion.motor_deg / ratio, both_ways=True)


def speed(motion: Motion) -> Coordinate:
    """Returns the signed motor speed; falls back to `time` if the speed is not known."""
    values = motion.motor_speed_deg_s
    if values is None:
        return time(motion)
    return Coordinate("speed", "motor deg/s", values, spacing=Spacing.FILLED, bins=40)


def acceleration(motion: Motion) -> Coordinate:
    """Returns the motor acceleration; falls back to `time` if the acceleration is not known."""
    values = motion.motor_acceleration_deg_s2
    if values is None:
        return time(motion)
    return Coordinate(
        "acceleration", "motor deg/s\N{SUPERSCRIPT TWO}", values, spacing=Spacing.FILLED, bins=40
    )


def time(motion: Motion) -> Coordinate:
    """Returns the time on the record's clock, or the sample number of a motion without time."""
    values = motion.time_s
    if values is None:
        return Coordinate("sample", "", np.arange(len(motion), dtype=np.float64), bins=100)
    return Coordinate("time", "s", values, bins=100)


def measured(motion: Motion, channel: Channel) -> Coordinate:
    """Returns a measured channel; falls back to `time` if the channel was not measured."""
    values = motion.measured.get(channel)
    if values is None:
        return time(motion)
    spacing = Spacing.EVEN if channel is Channel.TEMPERATURE else Spacing.FILLED
    return Coordinate(channel.title, channel.unit, values, spacing=spacing, bins=40)


def since_reversal(motion: Motion) -> Coordinate:
    """Returns the motor angle since the last reversal or the start of the record."""
    angle, last = motion.motor_deg, _last_reversal(motion)
    away = np.abs(angle - angle[last])
    return _logarithmic("motor angle since the last reversal", "deg", away, SMALLEST_WAY_DEG)


def time_since_reversal(motion: Motion) -> Coordinate:
    """Returns the time since the last reversal or the start of the record."""
    clock = time(motion).values
    since = np.maximum(clock - clock[_last_reversal(motion)], 0.0)
    return _logarithmic("time since the last reversal", "s", since, SMALLEST_TIME_S)


def since_change(motion: Motion) -> Coordinate:
    """Returns the time since the axis last stopped, started or reversed; `time` if speed is not known."""
    if motion.motor_speed_deg_s is None:
        return time(motion)
    clock = time(motion).values
    change = np.flatnonzero(np.diff(np.sign(motion.motor_speed_deg_s), prepend=np.nan) != 0.0)
    last = change[np.searchsorted(change, np.arange(len(motion)), "right") - 1]
    return _logarithmic("time since the last stop or start", "s", clock - clock[last], SMALLEST_TIME_S)


def _last_reversal(motion: Motion) -> IntArray:
    turning = np.asarray(branches(motion.motor_deg)[0][:-1] or [0], dtype=np.intp)
    before = np.searchsorted(turning, np.arange(len(motion)), "left") - 1
    return np.asarray(turning[np.maximum(before, 0)])


def _logarithmic(name: str, unit: str, values: FloatArray, smallest: float) -> Coordinate:
    return Coordinate(name, unit, np.maximum(values, smallest), True, Spacing.LOGARITHMIC, 40)
