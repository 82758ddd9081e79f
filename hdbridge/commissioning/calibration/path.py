"""Path errors: deviation of the load from its path during and after a move.

The motor's lag and the wind-up of the gear's spring would be the same on a gear without error. They are
fitted to the runs as responses to the target, and removed. The gear's error depends on the angle, so a
response to a smooth target cannot reproduce it. The error with wind-up is relative to the target delayed by
the following lag.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hdbridge.axis.effects import FloatArray, Motion
from hdbridge.axis.model import TransmissionModel
from hdbridge.motion.procedures.path_test import PathRun
from hdbridge.units import ARCSEC_PER_DEG

SETTLED_ARCSEC = 3.0
"""Maximum distance from the rest position at which the load counts as settled."""
AT_REST_S = 0.2
"""Duration of the final part of the rest, over which the rest error is averaged; s."""


LAGS = (0, 1, 2, 4, 8, 16, 32, 64)
"""Limits of the lag intervals, in cycles; the motor's response is fitted to the mean target speed in each."""
WIND_UP_LAGS = LAGS[:6]
"""Same for the wind-up, with the target acceleration; longer lags would absorb the hysteresis."""


@dataclass(frozen=True, slots=True)
class PathError:
    """Position error of the load on one path."""

    name: str
    path_arcsec: float
    """Rms error over the path, without servo lag and wind-up."""
    rest_arcsec: float
    """Mean error at rest after the path."""
    settle_s: float
    """Time from the end of the path until the load has settled."""
    delayed_arcsec: float
    """Rms error over the path relative to the delayed target, wind-up and servo error included."""


def path_errors(variants: Sequence[Sequence[PathRun]], ratio: float, lag_s: float) -> list[list[PathError]]:
    """Returns the errors on the same paths for each of several corrections; the first is no correction.

    ``lag_s`` is the following lag of the axis. The motor's response is fitted to the motor encoder of the
    first run, and the wind-up to the others, because hysteresis hides it in the first.
    """
    servo = _fit(
        [_servo_columns(run) for run in variants[0]],
        [_off(run, "motor_position_deg", ratio) for run in variants[0]],
    )
    errors = [
        [_off(run, "load_position_deg", 1.0) - _servo_columns(run) @ servo for run in variant]
        for variant in variants
    ]
    compensated = [run for variant in variants[1:] for run in variant]
    spring = _fit(
        [_wind_up_columns(run) for run in compensated], [each for variant in errors[1:] for each in variant]
    )
    return [
        [
            _judged(run, error - _wind_up_columns(run) @ spring, lag_s)
            for run, error in zip(variant, found, strict=True)
        ]
        for variant, found in zip(variants, errors, strict=True)
    ]


def inertia_over_stiffness(
    runs: Sequence[PathRun], model: TransmissionModel, lag_s: float
) -> tuple[float, float]:
    """Fits J / K (load inertia over stiffness) to compensated runs; returns it and its 95 % half width, s^2.

    The load lags behind the motor by J / K times the acceleration, in addition to the model's motor orders.
    """
    found = []
    for run in runs:
        motor_deg = np.array([each.motor_position_deg for each in run.samples])
        load_deg = np.array([each.load_position_deg for each in run.samples])
        rest = load_deg - motor_deg / model.ratio - model.predict(Motion(motor_deg)) / ARCSEC_PER_DEG
        late = _delayed(run, lag_s)
        period_s = run.samples[1].time_s - run.samples[0].time_s
        acceleration = np.gradient(np.gradient(late)) / period_s**2
        design = np.column_stack([-acceleration, np.ones_like(late)])
        found.append(float(np.linalg.lstsq(design, rest, rcond=None)[0][0]))
    return float(np.mean(found)), 2.0 * float(np.std(found, ddof=1)) / math.sqrt(len(found))


def _delayed(run: PathRun, lag_s: float) -> FloatArray:
    """Returns the load target delayed by a lag; degrees, shape (n,)."""
    time_s = np.array([each.time_s for each in run.samples])
    target = np.array([each.load_target_deg for each in run.samples])
    late: FloatArray = np.interp(time_s - lag_s, time_s, target)
    return late


def _judged(run: PathRun, error_arcsec: FloatArray, lag_s: float) -> PathError:
    load = np.array([each.load_position_deg for each in run.samples])
    delayed = ARCSEC_PER_DEG * (load - _delayed(run, lag_s))
    time = np.array([each.time_s for each in run.rest])
    error = ARCSEC_PER_DEG * np.array([each.load_position_deg - each.load_target_deg for each in run.rest])
    mean = float(error[time > time[-1] - AT_REST_S].mean())
    moving = np.flatnonzero(abs(error - mean) > SETTLED_ARCSEC)
    settle_s = float(time[moving[-1]] - run.samples[-1].time_s) if moving.size else 0.0
    path, late = (float(np.sqrt(np.mean(each[run.skipped :] ** 2))) for each in (error_arcsec, delayed))
    return PathError(run.name, path, mean, max(settle_s, 0.0), late)


def _servo_columns(run: PathRun) -> FloatArray:
    """Returns the regressors of the motor's response: past speeds of the load target, and the sign of the
    speed for friction; shape (n, columns).
    """
    speed = _speed(run)
    return np.column_stack([*_averages(speed, LAGS), np.sign(speed)])


def _wind_up_columns(run: PathRun) -> FloatArray:
    """Returns the regressors of the wind-up: past accelerations of the load target; shape (n, columns)."""
    return np.column_stack(_averages(np.gradient(_speed(run)), WIND_UP_LAGS))


def _averages(values: FloatArray, lags: Sequence[int]) -> list[FloatArray]:
    """Returns the mean of the values over each lag interval, shape (n,); values before the first are zero."""
    total = np.concatenate([np.zeros(lags[-1] + 1), np.cumsum(values)])
    end = len(total)
    count = len(values)
    return [
        (total[end - count - near : end - near] - total[end - count - far : end - far]) / (far - near)
        for near, far in pairwise(lags)
    ]


def _speed(run: PathRun) -> FloatArray:
    """Returns the speed of the load target, degrees per cycle, shape (n,)."""
    target = np.array([each.load_target_deg for each in run.samples])
    return np.diff(target, prepend=target[0])


def _fit(columns: Sequence[FloatArray], values: Sequence[FloatArray]) -> FloatArray:
    solution: FloatArray = np.linalg.lstsq(np.vstack(columns), np.concatenate(values), rcond=None)[0]
    return solution


def _off(run: PathRun, encoder: str, turns: float) -> FloatArray:
    """Returns the encoder angle divided by ``turns``, minus the load target; arcsec, shape (n,)."""
    off = [getattr(each, encoder) / turns - each.load_target_deg for each in run.samples]
    return ARCSEC_PER_DEG * np.array(off)
