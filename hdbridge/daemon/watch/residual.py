"""What the load encoder says beyond the model, of one axis in the loop's samples.

The model's prediction in a sample is that at the motor angle that was *issued* in that cycle; the encoders
were read at its SYNC, when the motor was still behind. So the prediction is taken from when the motor's
present place was issued: earlier by the mean lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleArray, SampleFlag
from hdbridge.effects import FloatArray
from hdbridge.units import ARCSEC_PER_DEG

BoolArray = NDArray[np.bool_]

DRIVEN: Final = (AxisState.ENABLED, AxisState.STOPPING)
"""The motor follows the issued targets."""
LONGEST_LAG_S: Final = 0.05
"""A motor that is later than this does not follow."""
STANDING_DEG_S: Final = 1e-6
"""Speed of the load target that is rest."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Columns of one axis, all of shape (n,)."""

    cycle: NDArray[np.int64]
    time_s: FloatArray
    """Cycles times the period."""
    motor_deg: FloatArray
    load_deg: FloatArray
    velocity_deg_s: FloatArray
    """Of the load target."""
    predicted_arcsec: FloatArray
    """Transmission error that the model predicts where the motor is."""
    residual_arcsec: FloatArray
    """Measured transmission error minus predicted, with the difference of the encoders' zeros in it."""
    usable: BoolArray
    """Fresh, driven, the state of the hysteresis known, no switch between models under way."""
    fresh: BoolArray

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.cycle)

    @property
    def standing(self) -> BoolArray:
        """Where the load target rests."""
        return np.abs(self.velocity_deg_s) < STANDING_DEG_S

    def rows(self, chosen: BoolArray | slice) -> Residuals:
        """Some of the samples."""
        return Residuals(*(getattr(self, name)[chosen] for name in self.__slots__))


def any_of(states: NDArray[np.uint8], wanted: Sequence[AxisState]) -> BoolArray:
    """Where an axis is in one of these states."""
    found = states == wanted[0]
    for each in wanted[1:]:
        found |= states == each
    return np.asarray(found)


def joined(parts: Sequence[Residuals]) -> Residuals:
    """One after the other."""
    names = Residuals.__slots__
    return Residuals(*(np.concatenate([getattr(each, name) for each in parts]) for name in names))


def residuals(samples: SampleArray, place: int, ratio: float, period_s: float) -> Residuals:
    """Of the axis at ``place`` in samples that follow each other; ``ratio`` is the gear's."""
    axis: Any = samples["axes"][:, place]
    cycle = samples["cycle"].astype(np.int64)
    time_s = np.asarray(cycle * period_s, dtype=np.float64)
    flags = axis["flags"]
    fresh = (flags & SampleFlag.FRESH) != 0
    motor, load = axis["motor_position_deg"], axis["load_position_deg"]
    velocity = axis["velocity_deg_s"]
    predicted: FloatArray = axis["predicted_arcsec"]
    needed = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
    usable = (flags & (needed | SampleFlag.CHANGING)) == needed
    usable &= any_of(axis["state"], DRIVEN) & np.isfinite(predicted)
    if len(samples) > 1:
        lag_s = _lag_s(axis["issued_deg"] - motor, ratio * velocity, usable)
        if lag_s:
            predicted = np.asarray(np.interp(time_s - lag_s, time_s, predicted), dtype=np.float64)
    measured = np.asarray((load - motor / ratio) * ARCSEC_PER_DEG)
    return Residuals(
        cycle, time_s, motor, load, velocity, predicted, measured - predicted, usable, fresh
    )  # fmt: skip


def _lag_s(behind_deg: FloatArray, speed_deg_s: FloatArray, usable: BoolArray) -> float:
    """How much later the motor is where it was told to be, by least squares over what moves."""
    behind, speed = behind_deg[usable], speed_deg_s[usable]
    square = float(speed @ speed)
    if not square or not np.all(np.isfinite(behind)):
        return 0.0
    return min(max(float(speed @ behind) / square, 0.0), LONGEST_LAG_S)
