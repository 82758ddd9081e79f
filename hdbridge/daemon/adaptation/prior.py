"""Prior of the adaptation: the calibration's covariance, and the bounds of each coefficient."""

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
"""Expected size of the load encoder's own errors per turn."""
ZERO_ARCSEC = 1000.0
"""Standard deviation of the zero, which is unknown at first."""
LEAST_ARCSEC = 1e-3
"""Minimum standard deviation of a calibrated coefficient."""
ZERO_SCALE_ARCSEC = 200.0
"""Scale of the zero; it exceeds that of the disc, so that a common shift is attributed to the zero."""
STEP_ARCSEC = 1e-4
SIGMAS_AT_BOUND = 3.0


def bounds_arcsec(regressors: Regressors, settings: AdaptationSettings) -> FloatArray:
    """Returns the largest deviation of each adapted coefficient from the committed one, (followed,).

    The share applies to the largest coefficient of the effect, so that a sine that happens to be zero may
    grow.
    """
    bounds = np.empty(regressors.followed)
    for each in regressors.terms:
        largest = float(np.linalg.norm(each.effect.coefficients(), np.inf))
        bounds[each.columns] = max(settings.bound_share * largest, settings.least_bound_arcsec)
    return bounds


def estimator_of(regressors: Regressors, settings: AdaptationSettings) -> Estimator:
    """Returns an estimator with the committed model's ``uncertainty`` and an unknown zero."""
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
    """Returns 95 % half widths of an effect's parameters for the model file, from the covariance.

    Parameters that are not adapted keep those of ``before``.
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
    """Returns the coefficients' covariance by the parameters' half widths, or the scale without them."""
    halves = dict(leaves(dict(uncertainty)))
    information = np.diag(1.0 / scale**2)
    for name, slope in _slopes(effect).items():
        if name in halves:
            size = float(np.linalg.norm(slope))
            sigma = max(halves[name] / NORMAL_95, LEAST_ARCSEC * size)
            information += np.outer(slope, slope) / sigma**2
    return np.asarray(np.linalg.inv(information))


def _slopes(effect: Effect) -> dict[str, FloatArray]:
    """Returns the derivatives of each parameter with respect to the coefficients, (c,) each."""
    count = len(effect.coefficients())
    return slopes(effect, [Column(0, str(number)) for number in range(count)], np.full(count, STEP_ARCSEC))
