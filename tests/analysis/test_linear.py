"""Singular systems: coefficients without data stay at zero despite rounding."""

from __future__ import annotations

import numpy as np

from hdbridge.analysis.linear import solve_symmetric


def test_zero_columns_next_to_collinear_columns_stay_at_zero() -> None:
    """The columns are those of an unused second spring constant, and of two orders that coincide on a short
    arc.
    """
    for seed in range(20):
        rng = np.random.default_rng(seed)
        columns = rng.standard_normal((200, 9)) @ rng.standard_normal((9, 9))
        columns[:, 2] = columns[:, 1]
        columns[:, [3, 5]] = 0.0
        right = columns.T @ rng.standard_normal(200)
        for each in (right, np.column_stack([right, 3.0 * right])):
            solved = solve_symmetric(columns.T @ columns, each)
            assert np.all(solved[[3, 5]] == 0.0)
            assert np.all(np.isfinite(solved))
