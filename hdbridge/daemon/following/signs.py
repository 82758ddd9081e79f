"""Signs that distinguish a load encoder fault from a change of the gear. Pure functions of arrays.

A gear's error depends on its motor: it does not jump while the motor hardly moves, does not stay constant
while the motor turns, does not become noisier within a second, and does not drift while the axis rests.

The signs are in the residual: measured minus predicted transmission error. The prediction in a sample is that
at the motor angle *issued* in its cycle. The encoders are read at its SYNC, when the motor still lags, so the
prediction is taken from an earlier time, by the mean lag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hdbridge.analysis.linear import SEEN, orthonormal
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleArray, SampleFlag
from hdbridge.effects import BoolArray, FloatArray
from hdbridge.units import ARCSEC_PER_DEG

DRIVEN: Final = (AxisState.ENABLED, AxisState.STOPPING)
"""States in which the motor follows the issued targets."""
LONGEST_LAG_S: Final = 0.05
"""Largest lag of a motor that follows."""
SIDE = 5
"""Samples on either side of a jump; their median ignores two misread ones."""
MEDIAN_ERROR = 1.25
"""Standard deviation of a median of few values, relative to that of their mean."""
PREDICTED_SHARE = 0.5
"""Share of the predicted change within a window that may appear too early or too late."""
UNMODELLED_ARCSEC = 20.0
UNMODELLED_DEG = 36.0
"""Largest unmodelled change of the gear's error over this or a longer motor travel: an order of 10 per turn
with an amplitude of 10 arcsec (`effects.motor_order` is at most 3).
"""
SHAKE_S = 0.002
"""Time by which a speed change may show in the error, through wind-up and skew between the encoders."""
MEDIAN_DIFFERENCE = 1.0 / (0.6745 * np.sqrt(2.0))
"""Standard deviation of Gaussian values, relative to the median difference of neighbours."""
STEP_ARCSEC = 6.0
STEP_SIGMAS = 8.0
STEP_BLOCKS = 20
"""Minimum number of blocks on either side of a step of the zero."""
STEP_BETTER = 0.6
"""Largest ratio of the mean squares left by a step and by a trend."""
MAX_CORRELATION = 0.95
"""Largest correlation of neighbouring residuals that a standard error allows for."""

Residuals = NDArray[np.void]
"""Samples of one axis with the dtype `RESIDUAL`, shape (n,)."""
RESIDUAL: Final = np.dtype([
    ("cycle", np.int64),
    ("time_s", np.float64),
    ("motor_deg", np.float64),
    ("load_deg", np.float64),
    ("velocity_deg_s", np.float64),  # of the load target
    ("predicted_arcsec", np.float64),  # at the motor's actual position
    ("residual_arcsec", np.float64),  # includes the difference of the encoders' zeros
    ("fresh", np.bool_),
    ("usable", np.bool_),  # fresh, driven, hysteresis state known, no model change under way
])  # fmt: skip


def residuals(samples: SampleArray, index: int, ratio: float, period_s: float) -> Residuals:
    """Returns the residuals of the axis at ``index`` in consecutive samples; ``ratio`` is the gear ratio."""
    axis: Any = samples["axes"][:, index]
    found = np.empty(len(samples), RESIDUAL)
    found["cycle"] = samples["cycle"]
    found["time_s"] = time_s = samples["cycle"] * period_s
    found["motor_deg"] = motor = axis["motor_position_deg"]
    found["load_deg"] = load = axis["load_position_deg"]
    found["velocity_deg_s"] = velocity = axis["velocity_deg_s"]
    predicted: FloatArray = axis["predicted_arcsec"]
    found["fresh"] = axis["flags"] & SampleFlag.FRESH
    needed = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
    usable = (axis["flags"] & (needed | SampleFlag.CHANGING)) == needed
    usable &= in_states(axis, DRIVEN) & np.isfinite(predicted)
    found["usable"] = usable
    lag_s = _lag_s((axis["issued_deg"] - motor)[usable], ratio * velocity[usable])
    if lag_s and len(samples) > 1:
        predicted = np.asarray(np.interp(time_s - lag_s, time_s, predicted), dtype=np.float64)
    found["predicted_arcsec"] = predicted
    found["residual_arcsec"] = (load - motor / ratio) * ARCSEC_PER_DEG - predicted
    return found


def in_states(axis: NDArray[Any], states: Sequence[AxisState]) -> BoolArray:
    """Returns a mask of the samples of `AXIS_SAMPLE` in one of these states, shape (n,)."""
    found = axis["state"] == states[0]
    for each in states[1:]:
        found |= axis["state"] == each
    return np.asarray(found)


def _lag_s(behind_deg: FloatArray, speed_deg_s: FloatArray) -> float:
    """Returns the lag of the motor behind the issued target in seconds, by least squares."""
    square = float(speed_deg_s @ speed_deg_s)
    if not square or not np.all(np.isfinite(behind_deg)):
        return 0.0
    return min(max(float(speed_deg_s @ behind_deg) / square, 0.0), LONGEST_LAG_S)


class Jump(NamedTuple):
    """A step of the residual."""

    row: int
    by_arcsec: float
    allowed_arcsec: float


def find_jump(found: Residuals, noise_arcsec: float, count_arcsec: float, sigmas: float) -> Jump | None:
    """Returns the first step of the residual that neither noise nor motion nor model can cause.

    ``noise_arcsec`` is the standard deviation of one reading, ``count_arcsec`` a motor encoder count at the
    load.
    """
    span = 2 * SIDE
    if len(found) < span:
        return None
    middle = _median(found["residual_arcsec"])
    step = middle[SIDE:] - middle[:-SIDE]
    turned = _ranges(span, found["motor_deg"])
    allowed = (
        sigmas * noise_arcsec * MEDIAN_ERROR * np.sqrt(2.0 / SIDE)
        + count_arcsec
        + _motion_arcsec(found, span)
        + UNMODELLED_ARCSEC * np.minimum(turned / UNMODELLED_DEG, 1.0)
    )
    together = np.all(_windows(found["usable"], span), axis=0)
    together &= found["cycle"][span - 1 :] - found["cycle"][: len(together)] < 2 * span
    rows = np.flatnonzero(together & (np.abs(step) > allowed))
    if not len(rows):
        return None
    # Several windows contain the step; the one centred on it shows it best.
    near = rows[rows < rows[0] + span]
    row = int(near[np.argmax(np.abs(step[near]))])
    return Jump(row + SIDE, float(step[row]), float(allowed[row]))


def misread(found: Residuals, noise_arcsec: float, count_arcsec: float, sigmas: float) -> int:
    """Returns the number of samples that jump away and return with the next one or two."""
    if len(found) < SIDE:
        return 0
    middle = slice(SIDE // 2, len(found) - SIDE // 2)
    away = np.abs(found["residual_arcsec"][middle] - _median(found["residual_arcsec"]))
    allowed = sigmas * noise_arcsec + count_arcsec + _motion_arcsec(found, SIDE)
    return int(np.count_nonzero((away > allowed) & np.all(_windows(found["usable"], SIDE), axis=0)))


def local_noise_arcsec(found: Residuals) -> float:
    """Returns the standard deviation of one reading, by the median difference of neighbours."""
    steps = np.abs(found["residual_arcsec"][1:] - found["residual_arcsec"][:-1])
    return float(MEDIAN_DIFFERENCE * np.median(steps)) if len(steps) else 0.0


def stuck_arcsec(load_deg: FloatArray, motor_deg: FloatArray, ratio: float) -> tuple[int, float]:
    """Returns the last row at which the load reading changed (0 if none), and the motor travel since.

    The travel is in arcsec at the load.
    """
    changed = np.flatnonzero(np.diff(load_deg) != 0.0)
    since = int(changed[-1]) + 1 if len(changed) else 0
    travel = np.max(np.abs(motor_deg[since:] - motor_deg[since])) / ratio * ARCSEC_PER_DEG
    return since, float(travel)


_Any = TypeVar("_Any", np.bool_, np.float64)


def _windows(values: NDArray[_Any], width: int) -> NDArray[_Any]:
    """Returns a copy of all windows, shape (width, windows); faster than a view of short batches."""
    rows = np.arange(width)[:, None] + np.arange(len(values) - width + 1)
    return np.asarray(values[rows])


def _median(values: FloatArray) -> FloatArray:
    """Returns the median of each window of `SIDE` samples."""
    return np.asarray(np.sort(_windows(values, SIDE), axis=0)[SIDE // 2])


def _ranges(width: int, values: FloatArray) -> FloatArray:
    """Returns the range of the values in each window."""
    windows = _windows(values, width)
    return np.asarray(windows.max(axis=0) - windows.min(axis=0))


def _motion_arcsec(found: Residuals, width: int) -> FloatArray:
    """Returns the change of the residual that motion permits in each window."""
    predicted, speed = _ranges(width, found["predicted_arcsec"]), _ranges(width, found["velocity_deg_s"])
    return PREDICTED_SHARE * predicted + SHAKE_S * ARCSEC_PER_DEG * speed


class Partial(NamedTuple):
    """Coefficient of one column in a least-squares fit with others."""

    value: float
    error: float
    """Standard error, allowing for coloured noise; infinite if the column is not separable."""
    mean_square: float
    """Mean square of the residual."""


def partial_fit(column: FloatArray, others: FloatArray, values: FloatArray) -> Partial:
    """Fits values (n,) with a column (n,) and others (n, m)."""
    basis = orthonormal(others)
    own = column - basis @ (basis.T @ column)
    rest = values - basis @ (basis.T @ values)
    square, free = float(own @ own), len(values) - basis.shape[1] - 1
    if free < 1 or square <= SEEN * float(column @ column):
        return Partial(0.0, math.inf, math.inf)
    value = float(own @ rest) / square
    left = rest - value * own
    mean_square = float(left @ left) / free + 1e-12
    correlation = min(max(float(left[1:] @ left[:-1]) / (free * mean_square), 0.0), MAX_CORRELATION)
    error = math.sqrt(mean_square / square * (1.0 + correlation) / (1.0 - correlation))
    return Partial(value, error, mean_square)


class Trend(NamedTuple):
    """Trend of the residual's zero, corrected for direction and speed of motion."""

    rate_arcsec_min: float
    error_arcsec_min: float
    zero_arcsec: float
    """Zero in the middle of the time span."""


class Step(NamedTuple):
    """Step of the residual's zero between two blocks."""

    time_s: float
    by_arcsec: float
    error_arcsec: float


def trend(
    time_s: FloatArray, residual_arcsec: FloatArray, direction: FloatArray, velocity_deg_s: FloatArray
) -> Trend | None:
    """Fits a trend to block means; returns None if it is not separable from the motion."""
    minutes = (time_s - float(np.mean(time_s))) / 60.0
    plain = _motion_columns(direction, velocity_deg_s)
    rate = partial_fit(minutes, plain, residual_arcsec)
    zero = partial_fit(plain[:, 0], np.column_stack([minutes, plain[:, 1:]]), residual_arcsec)
    if math.isinf(rate.error) or math.isinf(zero.error):
        return None
    return Trend(rate.value, rate.error, zero.value)


def find_step(
    time_s: FloatArray, residual_arcsec: FloatArray, direction: FloatArray, velocity_deg_s: FloatArray
) -> Step | None:
    """Returns the step in the block means, if a step fits far better than a trend."""
    plain = _motion_columns(direction, velocity_deg_s)
    basis = orthonormal(plain)
    rest = residual_arcsec - basis @ (basis.T @ residual_arcsec)
    count = len(rest)
    after = np.arange(1, count)
    mean_step = np.cumsum(rest[::-1])[::-1][1:] / (count - after) - np.cumsum(rest)[:-1] / after
    near = slice(STEP_BLOCKS, count - STEP_BLOCKS)
    likely = np.abs(mean_step * np.sqrt(after * (count - after) / count))[near]
    if not len(likely):
        return None
    row = int(np.argmax(likely)) + STEP_BLOCKS + 1
    # Both fits include a trend, because a ramp that begins or ends is not a step.
    minutes = (time_s - time_s[0]) / 60.0
    stepped = (np.arange(count) >= row).astype(np.float64)
    step = partial_fit(stepped, np.column_stack([minutes, plain]), residual_arcsec)
    slope = partial_fit(minutes, plain, residual_arcsec)
    if abs(step.value) < max(STEP_ARCSEC, STEP_SIGMAS * step.error):
        return None
    if step.mean_square > STEP_BETTER * slope.mean_square:
        return None
    return Step(float(time_s[row]), step.value, step.error)


def _motion_columns(direction: FloatArray, velocity_deg_s: FloatArray) -> FloatArray:
    """Returns a constant, the direction and the speed, (n, 1 to 3)."""
    columns = [np.ones(len(direction))]
    for each in (direction, velocity_deg_s):
        size = float(np.ptp(each))
        if size:
            columns.append(each / size)
    return np.column_stack(columns)
