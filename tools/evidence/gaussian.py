"""The log evidence of a Gaussian model: columns with a prior, noise that may be correlated.

y = r + C x + n, x ~ N(mean, diag d^2), n ~ N(0, K). With the mean taken off, S = I + D C'K^-1 C D = L L' and
L z = D C'K^-1 r: log Z = -1/2 log|2 pi K| - 1/2 r'K^-1 r + 1/2 z'z - sum log L_ii.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf

from hdbridge.effects import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """All that the evidence needs of the data."""

    gram: FloatArray
    """C'K^-1 C, (p, p)."""
    moment: FloatArray
    """C'K^-1 r, (p,)."""
    square: float
    """r'K^-1 r."""
    constant: float
    """-1/2 log|2 pi K|."""


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """The evidence, and what further columns need to be scored beside these."""

    log_evidence: float
    mean: FloatArray
    """Of the coefficients, (p,)."""
    _factor: FloatArray
    _z: FloatArray
    _deviation: FloatArray

    def gain(self, cross: FloatArray, gram: FloatArray, moment: FloatArray) -> float:
        """What a group of columns with unit priors adds to the log evidence.

        ``cross`` C'K^-1 G (p, g), ``gram`` G'K^-1 G, ``moment`` G'K^-1 r (prior means off).
        """
        x = solve_triangular(
            self._factor, self._deviation[:, np.newaxis] * cross, lower=True, check_finite=False
        )
        left = gram - x.T @ x + np.eye(len(gram))
        factor, failed = dpotrf(left, lower=1)
        if failed:
            return -np.inf
        inner = solve_triangular(factor, moment - x.T @ self._z, lower=True, check_finite=False)
        return 0.5 * float(inner @ inner) - float(np.sum(np.log(np.diag(factor))))


def posterior(moments: Moments, mean: FloatArray, deviation: FloatArray) -> Posterior:
    """Evidence and posterior mean under the prior N(mean, diag deviation^2), each of shape (p,)."""
    shifted = moments.gram @ mean
    moment = moments.moment - shifted
    square = moments.square - 2.0 * float(mean @ moments.moment) + float(mean @ shifted)
    scaled = moments.gram * np.outer(deviation, deviation)
    scaled[np.diag_indices_from(scaled)] += 1.0
    factor, failed = dpotrf(scaled, lower=1)
    assert not failed, "one plus a positive matrix is positive"
    z = solve_triangular(factor, deviation * moment, lower=True, check_finite=False)
    inner = solve_triangular(factor, z, lower=True, trans="T", check_finite=False)
    log_evidence = (
        moments.constant - 0.5 * square + 0.5 * float(z @ z) - float(np.sum(np.log(np.diag(factor))))
    )
    return Posterior(log_evidence, mean + deviation * inner, np.tril(factor), z, deviation)
