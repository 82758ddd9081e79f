"""White noise and a slow wander, at a grid of points that are summed: nothing here is fitted to a residual.

The wander is a first-order Markov process S, whose inverse P is tridiagonal: with K = W + S and w = W^-1,
K^-1 = w - w (P + w)^-1 w, so everything is linear in the number of points (Rybicki and Press 1995).
"""

from __future__ import annotations

import numpy as np
from evidence.scales import Scales
from scipy.linalg import cho_solve_banded, cholesky_banded

from hdbridge.effects import FloatArray

Wander = tuple[float, float]
"""Standard deviation, arcsec (0: none), and the time in which it forgets, s."""


def ordinary(scales: Scales) -> list[Wander]:
    """What every record may have."""
    return [
        (0.0, 1.0), (scales.wander_arcsec, 2.0), (scales.wander_arcsec, 20.0),
        (scales.restless_arcsec, 5.0), (scales.drifting_arcsec, 20.0),
    ]  # fmt: skip


def unknown(scales: Scales) -> list[Wander]:
    """Something unknown that follows nothing but time."""
    return [(scales.size_arcsec, each) for each in (0.3, 1.0, 4.0, 16.0)]


class Noise:
    """The covariance K of one point of the grid."""

    def __init__(self, sigma_arcsec: FloatArray, time_s: FloatArray, wander: Wander) -> None:
        """White noise and time of each observation, shape (m,)."""
        self._weight = sigma_arcsec**-2.0
        self.log_determinant = -float(np.sum(np.log(self._weight)))
        self._factor: FloatArray | None = None
        size, forgets_s = wander
        if size > 0.0:
            step = np.maximum(np.abs(np.diff(time_s)), 1e-9) / forgets_s
            spread, decay = -np.expm1(-2.0 * step), np.exp(-step)
            band = np.ones((2, len(time_s)))
            band[0, :-1] += decay**2 / spread
            band[0, 1:] += decay**2 / spread
            band[1, :-1] = -decay / spread
            band /= size**2
            self.log_determinant += len(time_s) * np.log(size**2) + float(np.sum(np.log(spread)))
            band[0] += self._weight
            self._factor = cholesky_banded(band, lower=True, check_finite=False)
            self.log_determinant += 2.0 * float(np.sum(np.log(self._factor[0])))

    def solve(self, columns: FloatArray) -> FloatArray:
        """K^-1 times columns, shape (m,) or (m, p)."""
        weight = self._weight if columns.ndim == 1 else self._weight[:, np.newaxis]
        weighted = weight * columns
        if self._factor is None:
            return np.asarray(weighted)
        inner = cho_solve_banded((self._factor, True), weighted, check_finite=False)
        return np.asarray(weighted - weight * inner)
