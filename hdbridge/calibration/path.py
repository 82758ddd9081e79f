"""Path errors: deviation of the load from its path during a move and after it.

The servo's lag and the wind-up of the gear's spring would be the same on a gear without error, so both are
fitted to the runs and removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdbridge.procedures.moves import Sample
from hdbridge.procedures.path_test import PathRun
from hdbridge.units import ARCSEC_PER_DEG

FloatArray = NDArray[np.float64]

SETTLED_ARCSEC = 3.0
"""The load has settled once it stays this close to where it comes to rest."""
AT_REST_S = 0.2
"""Length of the final part of the rest over which the rest error is taken."""


@dataclass(frozen=True, slots=True)
class PathError:
    """Error of the load on one path."""

    name: str
    path_arcsec: float
    """Rms over the path."""
    rest_arcsec: float
    """Mean error at rest after it."""
    settle_s: float
    """Time from the end of the path until the load has settled."""


def path_errors(variants: Sequence[Sequence[PathRun]], ratio: float) -> list[list[PathError]]:
    """Returns the errors of the same paths run with several corrections, the first without one.

    The servo's lag is fitted to the motor encoder of the first, which does not contain the gear's hysteresis;
    hysteresis has the sign of the speed as well.
    """
    derivatives = [[_derivatives(run.samples) for run in variant] for variant in variants]
    lag = _fit(derivatives[0], [_off(run, "motor_position_deg", ratio) for run in variants[0]])
    errors = [
        [_off(run, "load_position_deg", 1.0) - each @ lag for run, each in zip(*pair, strict=True)]
        for pair in zip(variants, derivatives, strict=True)
    ]
    wound = [each[:, 1:] for variant in derivatives for each in variant]
    spring = _fit(wound, [each for variant in errors for each in variant])
    return [
        [_judged(run, error - each[:, 1:] @ spring) for run, error, each in zip(*triple, strict=True)]
        for triple in zip(variants, errors, derivatives, strict=True)
    ]


def _judged(run: PathRun, error_arcsec: FloatArray) -> PathError:
    time = np.array([each.time_s for each in run.rest])
    error = ARCSEC_PER_DEG * np.array([each.load_position_deg - each.load_target_deg for each in run.rest])
    mean = float(error[time > time[-1] - AT_REST_S].mean())
    moving = np.flatnonzero(abs(error - mean) > SETTLED_ARCSEC)
    settle_s = float(time[moving[-1]] - run.samples[-1].time_s) if moving.size else 0.0
    return PathError(run.name, float(np.sqrt(np.mean(error_arcsec**2))), mean, max(settle_s, 0.0))


def _fit(columns: Sequence[FloatArray], values: Sequence[FloatArray]) -> FloatArray:
    solution: FloatArray = np.linalg.lstsq(np.vstack(columns), np.concatenate(values), rcond=None)[0]
    return solution


def _derivatives(samples: Sequence[Sample]) -> FloatArray:
    """Returns speed, acceleration and jerk of the load target, shape (n, 3)."""
    target = np.array([each.load_target_deg for each in samples])
    cycle_s = (samples[-1].time_s - samples[0].time_s) / (len(samples) - 1)
    speed = np.gradient(target, cycle_s)
    acceleration = np.gradient(speed, cycle_s)
    return np.column_stack([speed, acceleration, np.gradient(acceleration, cycle_s)])


def _off(run: PathRun, encoder: str, turns: float) -> FloatArray:
    """Returns the encoder angle over ``turns``, minus the load target; arcsec, shape (n,)."""
    off = [getattr(each, encoder) / turns - each.load_target_deg for each in run.samples]
    return ARCSEC_PER_DEG * np.array(off)
