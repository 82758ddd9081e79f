"""Signs that distinguish a load encoder fault from a change of the gear. Pure functions of arrays.

A gear's error depends on its motor: it does not jump while the motor hardly moves, does not stay constant
while the motor turns, does not become noisier within a second, and does not drift while the axis rests.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hdbridge.daemon.watch.residual import Residuals
from hdbridge.effects import FloatArray
from hdbridge.units import ARCSEC_PER_DEG

SIDE = 5
"""Samples on either side of a jump; their median ignores two misread ones."""
_MEDIAN = 1.25
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


_DIFFERENCES = 1.0 / (0.6745 * np.sqrt(2.0))
STEP_ARCSEC = 6.0
STEP_SIGMAS = 8.0
STEP_BLOCKS = 20
"""Minimum number of blocks on either side of a step of the zero."""
STEP_BETTER = 0.6
"""Largest ratio of the mean squares left by a step and by a trend."""


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
    middle = _median(found.residual_arcsec)
    step = middle[SIDE:] - middle[:-SIDE]
    predicted, speed, turned = _spans(span, found.predicted_arcsec, found.velocity_deg_s, found.motor_deg)
    allowed = (
        sigmas * noise_arcsec * _MEDIAN * np.sqrt(2.0 / SIDE)
        + count_arcsec
        + PREDICTED_SHARE * predicted
        + SHAKE_S * ARCSEC_PER_DEG * speed
        + UNMODELLED_ARCSEC * np.minimum(turned / UNMODELLED_DEG, 1.0)
    )
    together = np.all(_windows(found.usable, span), axis=0)
    together &= found.cycle[span - 1 :] - found.cycle[: len(together)] < 2 * span
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
    away = np.abs(found.residual_arcsec[middle] - _median(found.residual_arcsec))
    predicted, speed = _spans(SIDE, found.predicted_arcsec, found.velocity_deg_s)
    allowed = (
        sigmas * noise_arcsec + count_arcsec + PREDICTED_SHARE * predicted + SHAKE_S * ARCSEC_PER_DEG * speed
    )
    return int(np.count_nonzero((away > allowed) & np.all(_windows(found.usable, SIDE), axis=0)))


_Any = TypeVar("_Any", np.bool_, np.float64)


def _windows(values: NDArray[_Any], width: int) -> NDArray[_Any]:
    """Returns a copy of all windows, shape (..., width, windows); faster than a view of short batches."""
    return values[..., np.arange(width)[:, None] + np.arange(values.shape[-1] - width + 1)]


def _median(values: FloatArray) -> FloatArray:
    """Returns the median of each window of `SIDE` samples."""
    return np.asarray(np.sort(_windows(values, SIDE), axis=0)[SIDE // 2])


def _spans(width: int, *columns: FloatArray) -> FloatArray:
    """Returns the range of each column (row of the result) in each window."""
    windows = _windows(np.array(columns), width)
    return np.asarray(windows.max(axis=1) - windows.min(axis=1))


def local_noise_arcsec(found: Residuals) -> float:
    """Returns the standard deviation of one reading, by the median difference of neighbours."""
    steps = np.abs(found.residual_arcsec[1:] - found.residual_arcsec[:-1])
    return float(_DIFFERENCES * np.median(steps)) if len(steps) else 0.0


class Trend(NamedTuple):
    """Trend of the residual's zero, corrected for direction and speed of motion."""

    rate_arcsec_min: float
    error_arcsec_min: float
    """Standard error, allowing for coloured noise."""
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
    """Fits a trend to block means by least squares; returns None for too few blocks."""
    minutes = (time_s - float(np.mean(time_s))) / 60.0
    design = np.column_stack([minutes, _plain(direction, velocity_deg_s)])
    fitted = _fit(design, residual_arcsec)
    if fitted is None:
        return None
    solution, _, error = fitted
    return Trend(float(solution[0]), error, float(solution[1]))


def find_step(
    time_s: FloatArray, residual_arcsec: FloatArray, direction: FloatArray, velocity_deg_s: FloatArray
) -> Step | None:
    """Returns the step in the block means, if a step fits far better than a trend."""
    plain = _plain(direction, velocity_deg_s)
    basis, _ = np.linalg.qr(plain)
    rest = residual_arcsec - basis @ (basis.T @ residual_arcsec)
    count = len(rest)
    after = np.arange(1, count)
    mean_step = np.cumsum(rest[::-1])[::-1][1:] / (count - after) - np.cumsum(rest)[:-1] / after
    near = slice(STEP_BLOCKS, count - STEP_BLOCKS)
    weight = np.sqrt(after * (count - after) / count)
    likely = np.abs(mean_step * weight)[near]
    if not len(likely):
        return None
    row = int(np.argmax(likely)) + STEP_BLOCKS + 1
    # Both fits include a trend, because a ramp that begins or ends is not a step.
    trended = np.column_stack([time_s - time_s[0], plain])
    stepped = _fit(np.column_stack([np.arange(count) >= row, trended]), residual_arcsec)
    sloping = _fit(trended, residual_arcsec)
    if stepped is None or sloping is None:
        return None
    solution, left, error = stepped
    by = float(solution[0])
    if abs(by) < max(STEP_ARCSEC, STEP_SIGMAS * error) or left > STEP_BETTER * sloping[1]:
        return None
    return Step(float(time_s[row]), by, error)


def _plain(direction: FloatArray, velocity_deg_s: FloatArray) -> FloatArray:
    """Returns the other columns of the fit: a constant, the direction and the speed."""
    columns = [np.ones(len(direction))]
    for each in (direction, velocity_deg_s):
        size = float(np.ptp(each))
        if size:
            columns.append(each / size)
    return np.column_stack(columns)


def _fit(design: FloatArray, values: FloatArray) -> tuple[FloatArray, float, float] | None:
    """Returns solution, mean square left and standard error of the first coefficient; None if singular."""
    free = len(values) - design.shape[1]
    if free < 10:
        return None
    solution, _, rank, _ = np.linalg.lstsq(design, values, rcond=1e-9)
    if rank < design.shape[1]:
        return None
    left = values - design @ solution
    variance = float(left @ left) / free + 1e-12
    follows = float(left[1:] @ left[:-1]) / (free * variance)
    follows = min(max(follows, 0.0), 0.95)
    inflation = (1.0 + follows) / (1.0 - follows)
    spread = np.linalg.inv(design.T @ design)[0, 0] * variance * inflation
    return np.asarray(solution, dtype=np.float64), variance, float(np.sqrt(spread))


def stuck_arcsec(load_deg: FloatArray, motor_deg: FloatArray, ratio: float) -> tuple[int, float]:
    """Returns the last row at which the load reading changed (0 if none), and the motor travel since.

    The travel is in arcsec at the load.
    """
    changed = np.flatnonzero(np.diff(load_deg) != 0.0)
    since = int(changed[-1]) + 1 if len(changed) else 0
    travel = np.max(np.abs(motor_deg[since:] - motor_deg[since])) / ratio * ARCSEC_PER_DEG
    return since, float(travel)
