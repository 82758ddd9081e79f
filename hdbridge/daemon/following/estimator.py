"""Recursive least squares with directional forgetting, its prior from the calibration, and its limits.

Each batch of observations ``y = H theta + noise`` is reduced to its information ``H' H / sigma^2``, with each
parameter scaled by its expected range. The eigenvectors are the directions that the batch observes. A
direction is *excited* if the batch alone determines it better than that range. The covariance grows before
the update only along excited directions (Cao and Schwartz 2000, *A directional forgetting algorithm based on
the decomposition of the information matrix*, Automatica 36; here for a batch at a time). Unobserved
directions are therefore neither learned nor forgotten. There is no covariance wind-up, because the variance
grows only where the same batch then reduces it below the scale.

Parameters may be held: their uncertainty is accounted for, but neither they nor their variance change
(Schmidt's consider filter). Without forgetting, the result is that of `analysis.linear` for one batch.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdbridge.analysis import intervals
from hdbridge.analysis.intervals import NORMAL_95, Interval, leaves, nested_half_widths, slopes
from hdbridge.analysis.linear import Column, Linearised
from hdbridge.axis.effects import BoolArray, Effect, FloatArray
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.following.measuring import DriftModel
from hdbridge.daemon.machinefile import AdaptationSettings

EXCITED = 1.0
"""Information of a batch along a direction, in units of 1 / scale^2, above which the direction counts as
excited."""
RANK_TOLERANCE = 1e-12
"""Eigenvalue, relative to the largest, below which a direction counts as unobserved."""
DISC_ARCSEC = 10.0
"""Expected size of the load encoder's own errors per turn."""
ZERO_ARCSEC = 1000.0
"""Standard deviation of the initially unknown zero."""
ZERO_SCALE_ARCSEC = 200.0
"""Scale of the zero; it exceeds that of the disc, so that a common shift is attributed to the zero."""
LEAST_ARCSEC = 1e-3
"""Minimum standard deviation of a calibrated coefficient."""
STEP_ARCSEC = 1e-4
"""Step of a coefficient for the derivatives of parameters."""
SIGMAS_AT_BOUND = 3.0
MAX_CORRELATION = 0.95
"""Upper limit of the correlation of neighbouring residuals in a standard error."""


@dataclass(slots=True)
class Estimator:
    """An estimate and its covariance."""

    estimate: FloatArray
    """Shape (p,)."""
    covariance: FloatArray
    """Shape (p, p), positive definite."""
    scale: FloatArray
    """Expected range (standard deviation) of each parameter, shape (p,), positive."""

    def update(
        self,
        rows: FloatArray,
        observed: FloatArray,
        sigma: float,
        *,
        retention: float = 1.0,
        held: BoolArray | None = None,
    ) -> None:
        """Updates the estimate with a batch: rows (n, p), observed (n,), noise standard deviation.

        ``retention`` is the fraction of the old information that remains along excited directions (1 without
        forgetting). Parameters in ``held`` (p,) do not change.
        """
        free = np.ones(len(self.estimate), dtype=bool) if held is None else ~held
        scale = self.scale[free]
        cross = scale[:, np.newaxis] * (rows[:, free].T @ rows) / sigma**2
        right = scale * (rows[:, free].T @ (observed - rows @ self.estimate)) / sigma**2
        values, vectors = np.linalg.eigh(cross[:, free] * scale)
        seen = values > max(RANK_TOLERANCE * values[-1], 1e-300) if len(values) else np.zeros(0, dtype=bool)
        if not np.any(seen):
            return
        values, vectors = values[seen], vectors[:, seen]
        excited = values >= EXCITED
        if retention < 1.0 and np.any(excited):
            directions = np.zeros((len(self.estimate), int(np.count_nonzero(excited))))
            directions[free] = scale[:, np.newaxis] * vectors[:, excited]
            information = directions.T @ np.linalg.solve(self.covariance, directions)
            growth = directions @ np.linalg.solve(information, directions.T)
            self.covariance = self.covariance + (1.0 / retention - 1.0) * 0.5 * (growth + growth.T)
        # The batch as one observation per direction, of variance 1 / information.
        directions = (vectors.T @ cross) / values[:, np.newaxis]
        spread = self.covariance @ directions.T
        gain = np.linalg.solve(directions @ spread + np.diag(1.0 / values), spread.T).T
        gain[~free] = 0.0
        self.estimate = self.estimate + gain @ ((vectors.T @ right) / values)
        reduction = np.eye(len(self.estimate)) - gain @ directions
        after = reduction @ self.covariance @ reduction.T + (gain / values) @ gain.T
        self.covariance = 0.5 * (after + after.T)


def calibrated_estimator(drift: DriftModel, settings: AdaptationSettings) -> Estimator:
    """Returns an estimator with the covariance of the model's ``uncertainty`` and an unknown zero."""
    scale = np.full(drift.count, DISC_ARCSEC)
    scale[: drift.zero] = bounds_arcsec(drift, settings) / SIGMAS_AT_BOUND
    scale[drift.zero] = ZERO_SCALE_ARCSEC
    covariance = np.diag(scale**2)
    for each in drift.terms:
        given = drift.model.uncertainty.get(each.effect.name, {})
        covariance[each.columns, each.columns] = _covariance(each.effect, given, scale[each.columns])
    covariance[drift.zero, drift.zero] = ZERO_ARCSEC**2
    return Estimator(np.zeros(drift.count), covariance, scale)


def bounds_arcsec(drift: DriftModel, settings: AdaptationSettings) -> FloatArray:
    """Returns the largest permitted deviation of each coefficient from the committed value, (zero,).

    The relative bound refers to the largest coefficient of the effect, so that a sine that happens to be zero
    may grow.
    """
    bounds = np.empty(drift.zero)
    for each in drift.terms:
        largest = float(np.linalg.norm(each.effect.coefficients(), np.inf))
        bounds[each.columns] = max(settings.bound_share * largest, settings.least_bound_arcsec)
    return bounds


def half_widths(effect: Effect, covariance: FloatArray, before: Mapping[str, Any]) -> dict[str, Any]:
    """Returns 95 % half widths of an effect's parameters for the model file, from the covariance.

    Parameters that do not drift keep the half widths of ``before``.
    """
    values = dict(leaves(effect.parameters()))
    found = {name: half for name, half in leaves(dict(before)) if name in values}
    found |= intervals.half_widths(effect, _columns(effect), covariance)
    return nested_half_widths(
        effect, [Interval(effect.name, name, values[name], half) for name, half in found.items()]
    )


def _covariance(effect: Effect, uncertainty: Mapping[str, Any], scale: FloatArray) -> FloatArray:
    """Returns the coefficients' covariance from the parameters' half widths, else from the scale."""
    halves = dict(leaves(dict(uncertainty)))
    information = np.diag(1.0 / scale**2)
    columns = _columns(effect)
    for name, slope in slopes(effect, columns, np.full(len(columns), STEP_ARCSEC)).items():
        if name in halves:
            size = float(np.linalg.norm(slope))
            sigma = max(halves[name] / NORMAL_95, LEAST_ARCSEC * size)
            information += np.outer(slope, slope) / sigma**2
    return np.asarray(np.linalg.inv(information))


def _columns(effect: Effect) -> list[Column]:
    """Returns the columns of all coefficients of an effect."""
    return [Column(0, str(number)) for number in range(len(effect.coefficients()))]


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one parameter."""

    parameter: str
    """Name, such as ``hysteresis.offset_arcsec`` or ``synchronous.orders[2].phase_deg``."""
    committed: float
    before: float
    after: float


def changes_between(
    committed: TransmissionModel, before: TransmissionModel, after: TransmissionModel
) -> tuple[Change, ...]:
    """Returns the parameters that differ between ``before`` and ``after``."""
    first, old, new = (
        {f"{each.name}.{path}": value for each in model.effects for path, value in leaves(each.parameters())}
        for model in (committed, before, after)
    )
    return tuple(
        Change(name, first.get(name, 0.0), old.get(name, 0.0), value)
        for name, value in new.items()
        if value != old.get(name, 0.0)
    )


def ranged_fit(
    rows: FloatArray, observed: FloatArray, sigma: float, information: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fits rows (n, p) to observed (n,) with noise ``sigma`` and coefficients of a limited range.

    ``information`` (p,) is 1 / range^2 of each coefficient. Returns the coefficients and their covariance.
    """
    known = np.column_stack([information, np.zeros(len(information))])
    fit = Linearised(rows / sigma, observed / sigma, known)
    return fit.directions @ fit.slack, fit.directions @ fit.directions.T


def variance_factor(residual: FloatArray) -> float:
    """Returns the factor by which correlation of neighbouring residuals (n,) increases a variance."""
    correlation = float(residual[1:] @ residual[:-1]) / max(float(residual @ residual), 1e-300)
    correlation = min(max(correlation, 0.0), MAX_CORRELATION)
    return (1.0 + correlation) / (1.0 - correlation)
