"""Recursive least squares with directional forgetting and held parameters. Pure: numpy alone.

Each batch of observations ``y = H theta + noise`` is reduced to its information ``H' H / sigma^2``. The
eigenvectors of that, in parameters scaled by how far each may stray, are the directions that the batch shows.
Only along directions that are *excited* (which the batch by itself determines better than that scale) does
the covariance grow before the update (Cao and Schwartz 2000, *A directional forgetting algorithm based on the
decomposition of the information matrix*, Automatica 36; here for a batch at a time). So what is not shown is
neither learned nor forgotten, and no direction's variance can wind up beyond its scale: growth happens only
where the batch itself brings the variance back below it.

Parameters may be held: their uncertainty is accounted for, but neither they nor their variance change
(Schmidt's consider filter).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import FloatArray

EXCITED = 1.0
"""Information of a batch along a direction, in units of 1 / scale^2, from which on it is excited."""
NOTHING = 1e-12
"""Share of the largest information below which there is none."""


@dataclass(slots=True)
class Estimator:
    """An estimate and its covariance."""

    estimate: FloatArray
    """Shape (p,)."""
    covariance: FloatArray
    """Shape (p, p), positive definite."""
    scale: FloatArray
    """How far each parameter may stray (a standard deviation), shape (p,), positive."""

    def update(
        self,
        rows: FloatArray,
        observed: FloatArray,
        sigma: float,
        *,
        keep: float = 1.0,
        held: NDArray[np.bool_] | None = None,
    ) -> int:
        """Take a batch in: rows (n, p), observed (n,), the noise of each; the number of excited directions.

        ``keep`` is the share of the old information that stays along excited directions (1: nothing is
        forgotten). ``held`` (p,) are not changed.
        """
        free = np.ones(len(self.estimate), dtype=bool) if held is None else ~held
        scale = self.scale[free]
        cross = scale[:, np.newaxis] * (rows[:, free].T @ rows) / sigma**2
        right = scale * (rows[:, free].T @ (observed - rows @ self.estimate)) / sigma**2
        values, vectors = np.linalg.eigh(cross[:, free] * scale)
        seen = values > max(NOTHING * values[-1], 1e-300) if len(values) else np.zeros(0, dtype=bool)
        if not np.any(seen):
            return 0
        values, vectors = values[seen], vectors[:, seen]
        excited = values >= EXCITED
        if keep < 1.0 and np.any(excited):
            directions = np.zeros((len(self.estimate), int(np.count_nonzero(excited))))
            directions[free] = scale[:, np.newaxis] * vectors[:, excited]
            self._forget(directions, keep)
        # The batch as one observation per direction, of variance 1 / information.
        measured = (vectors.T @ cross) / values[:, np.newaxis]
        self._correct(measured, (vectors.T @ right) / values, 1.0 / values, free)
        return int(np.count_nonzero(excited))

    def variance_of(self, rows: FloatArray) -> FloatArray:
        """Variance of ``rows @ estimate``, shape (n,)."""
        return np.asarray(np.einsum("ij,jk,ik->i", rows, self.covariance, rows))

    def _forget(self, directions: FloatArray, keep: float) -> None:
        information = directions.T @ np.linalg.solve(self.covariance, directions)
        growth = directions @ np.linalg.solve(information, directions.T)
        self.covariance = self.covariance + (1.0 / keep - 1.0) * 0.5 * (growth + growth.T)

    def _correct(
        self, rows: FloatArray, innovation: FloatArray, variance: FloatArray, free: NDArray[np.bool_]
    ) -> None:
        spread = self.covariance @ rows.T
        gain = np.linalg.solve(rows @ spread + np.diag(variance), spread.T).T
        gain[~free] = 0.0
        self.estimate = self.estimate + gain @ innovation
        left = np.eye(len(self.estimate)) - gain @ rows
        after = left @ self.covariance @ left.T + (gain * variance) @ gain.T
        self.covariance = 0.5 * (after + after.T)
