"""What is known before the axis moves: the calibration's covariance, and how far each coefficient may go."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hdbridge.analysis.intervals import NORMAL_95, Interval, leaves, nested_half_widths, slopes
from hdbridge.analysis.linear import Column
from hdbridge.daemon.adaptation.estimator import Estimator
from hdbridge.daemon.adaptation.regressors import Regressors
from hdbridge.daemon.adaptation.settings import AdaptationSettings
from hdbridge.effects import Effect, FloatArray

DISC_ARCSEC = 10.0
"""Size that the load encoder's own errors per turn may have."""
ZERO_ARCSEC = 1000.0
"""The zero is not known beforehand: its standard deviation."""
LEAST_ARCSEC = 1e-3
"""No calibration is surer than this."""
ZERO_SCALE_ARCSEC = 200.0
"""What is common to all observations is put down to the zero, hardly to a disc that is met in one place."""
STEP_ARCSEC = 1e-4
SIGMAS_AT_BOUND = 3.0


def bounds_arcsec(regressors: Regressors, settings: AdaptationSettings) -> FloatArray:
    """The most that each followed coefficient may differ from the committed one, (followed,).

    The share is that of the largest coefficient of the effect: a sine that happens to be zero may grow.
    """
    bounds = np.empty(regressors.followed)
    for each in regressors.terms:
        largest = float(np.linalg.norm(each.effect.coefficients(), np.inf))
        bounds[each.columns] = max(settings.bound_share * largest, settings.least_bound_arcsec)
    return bounds


def estimator_of(regressors: Regressors, settings: AdaptationSettings) -> Estimator:
    """An estimator that knows what the committed model's ``uncertainty`` says, and nothing of the zero."""
    scale = np.full(regressors.count, DISC_ARCSEC)
    scale[: regressors.followed] = bounds_arcsec(regressors, settings) / SIGMAS_AT_BOUND
    scale[regressors.zero] = ZERO_SCALE_ARCSEC
    covariance = np.diag(scale**2)
    for each in regressors.terms:
        given = regressors.model.uncertainty.get(each.effect.name, {})
        covariance[each.columns, each.columns] = _covariance(each.effect, given, scale[each.columns])
    covariance[regressors.zero, regressors.zero] = ZERO_ARCSEC**2
    return Estimator(np.zeros(regressors.count), covariance, scale)


def uncertainty_of(effect: Effect, covariance: FloatArray, before: Mapping[str, Any]) -> dict[str, Any]:
    """95 % half widths of an effect's parameters by the covariance of its coefficients, for the model file.

    Parameters that are not followed keep what they had ``before``.
    """
    values = dict(leaves(effect.parameters()))
    halves = {
        name: NORMAL_95 * math.sqrt(max(float(slope @ covariance @ slope), 0.0))
        for name, slope in _slopes(effect).items()
    }
    known = {name: half for name, half in leaves(dict(before)) if name in values}
    intervals = [
        Interval(effect.name, name, values[name], half) for name, half in {**known, **halves}.items()
    ]
    return nested_half_widths(effect, intervals)


def _covariance(effect: Effect, uncertainty: Mapping[str, Any], scale: FloatArray) -> FloatArray:
    """Of the coefficients, from half widths of the parameters; where there are none, the scale."""
    halves = dict(leaves(dict(uncertainty)))
    information = np.diag(1.0 / scale**2)
    for name, slope in _slopes(effect).items():
        if name in halves:
            size = float(np.linalg.norm(slope))
            sigma = max(halves[name] / NORMAL_95, LEAST_ARCSEC * size)
            information += np.outer(slope, slope) / sigma**2
    return np.asarray(np.linalg.inv(information))


def _slopes(effect: Effect) -> dict[str, FloatArray]:
    """Derivatives of the parameters that the coefficients make, by the coefficients, (c,) each."""
    count = len(effect.coefficients())
    return slopes(effect, [Column(0, str(number)) for number in range(count)], np.full(count, STEP_ARCSEC))
