"""Recursive least squares with directional forgetting and held parameters. Pure: numpy alone.

Each batch of observations ``y = H theta + noise`` is reduced to its information ``H' H / sigma^2``, with
each parameter scaled by its expected range. Its eigenvectors are the directions that the batch observes. A
direction is *excited* if the batch alone determines it better than that range. Only along excited directions
does the covariance grow before the update (Cao and Schwartz 2000, *A directional forgetting algorithm based
on the decomposition of the information matrix*, Automatica 36; here for a batch at a time). So unobserved
directions are neither learned nor forgotten, and there is no covariance wind-up: the variance grows only
where the batch reduces it below its scale again.

Parameters may be held: their uncertainty is accounted for, but neither they nor their variance change
(Schmidt's consider filter).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import FloatArray

EXCITED = 1.0
"""Information of a batch along a direction, in units of 1 / scale^2, above which the direction is excited."""
NOTHING = 1e-12
"""Share of the largest eigenvalue below which a direction has no information."""


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
        keep: float = 1.0,
        held: NDArray[np.bool_] | None = None,
    ) -> int:
        """Updates the estimate with a batch: rows (n, p), observed (n,), noise standard deviation.

        Returns the number of excited directions. ``keep`` is the share of the old information that remains
        along them (1: nothing is forgotten). Parameters in ``held`` (p,) do not change.
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
        """Returns the variance of ``rows @ estimate``, shape (n,)."""
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
