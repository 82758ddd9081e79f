"""Residual of the model in the loop's samples of one axis.

The predicted error in a sample is that at the motor angle *issued* in that cycle. The encoders are read at
its SYNC, when the motor still lags. So the prediction is taken from an earlier time, by the mean lag.
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
"""States in which the motor follows the issued targets."""
LONGEST_LAG_S: Final = 0.05
"""Largest lag of a motor that follows."""
STANDING_DEG_S: Final = 1e-6
"""Speed of the load target below which it is at rest."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Columns of one axis, each of shape (n,)."""

    cycle: NDArray[np.int64]
    time_s: FloatArray
    """Cycle number times the period."""
    motor_deg: FloatArray
    load_deg: FloatArray
    velocity_deg_s: FloatArray
    """Velocity of the load target."""
    predicted_arcsec: FloatArray
    """Predicted transmission error at the motor's actual position."""
    residual_arcsec: FloatArray
    """Measured minus predicted transmission error, including the difference of the encoders' zeros."""
    usable: BoolArray
    """True for fresh samples of a driven axis with known hysteresis state and no model change under way."""
    fresh: BoolArray

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.cycle)

    @property
    def standing(self) -> BoolArray:
        """True where the load target is at rest."""
        return np.abs(self.velocity_deg_s) < STANDING_DEG_S

    def rows(self, chosen: BoolArray | slice) -> Residuals:
        """Returns the chosen samples."""
        return Residuals(*(getattr(self, name)[chosen] for name in self.__slots__))


def any_of(states: NDArray[np.uint8], wanted: Sequence[AxisState]) -> BoolArray:
    """Returns a mask of the samples in one of these states."""
    found = states == wanted[0]
    for each in wanted[1:]:
        found |= states == each
    return np.asarray(found)


def joined(parts: Sequence[Residuals]) -> Residuals:
    """Returns the concatenation of the parts."""
    names = Residuals.__slots__
    return Residuals(*(np.concatenate([getattr(each, name) for each in parts]) for name in names))


def residuals(samples: SampleArray, place: int, ratio: float, period_s: float) -> Residuals:
    """Returns the residuals of the axis at ``place`` in consecutive samples; ``ratio`` is the gear ratio."""
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
    """Returns the lag of the motor behind the issued target in seconds, by least squares."""
    behind, speed = behind_deg[usable], speed_deg_s[usable]
    square = float(speed @ speed)
    if not square or not np.all(np.isfinite(behind)):
        return 0.0
    return min(max(float(speed @ behind) / square, 0.0), LONGEST_LAG_S)
