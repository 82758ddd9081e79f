"""Uncertainty of a fit's parameters if the residuals of one leg are correlated."""

from __future__ import annotations

import numpy as np

from hdbridge.twin.fit import principal, sandwich


def test_what_slopes_would_still_take_is_no_scatter_of_the_legs() -> None:
    rng = np.random.default_rng(1)
    slopes = rng.standard_normal((600, 1)) + 0.01 * rng.standard_normal((600, 3))  # a valley
    spread, legs = np.full(3, 0.7), np.repeat([0.0, 1.0], 300)
    white = rng.standard_normal(600)
    for left in (white, white + 5.0 * slopes[:, 0]):
        covariance = sandwich(slopes, left, legs, spread)
        least = np.linalg.inv(slopes.T @ slopes + np.diag(spread**-2.0))
        times = np.linalg.eigvals(covariance @ np.linalg.inv(least)).real
        assert np.all(times > 0.9), "never better than by independent residuals"
        assert np.all(times < 8.0), "nor much worse where they are"
        assert np.all(np.linalg.eigvalsh(covariance / 0.49) < 1.0 + 1e-9), "nor than before the fit"


def test_intervals_hold_the_truth_where_one_leg_draws_the_fit_more_than_the_others() -> None:
    """Each leg has a value of its own, and one of eight has as much information as four others."""
    legs = np.repeat(np.arange(8.0), 50)
    slopes = np.where(legs == 0.0, 2.0, 1.0)[:, None]
    off = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        own = rng.standard_normal(8)
        seen = slopes[:, 0] * own[legs.astype(int)] + rng.standard_normal(400)
        found = np.linalg.lstsq(slopes, seen, rcond=None)[0]
        covariance = sandwich(slopes, seen - slopes @ found, legs, np.full(1, 10.0))
        off.append(float(found[0]) / float(np.sqrt(covariance[0, 0])))
    assert 0.88 <= np.mean(np.abs(off) < 1.96) <= 0.98


def test_what_a_simulation_next_to_unstable_shows_of_one_direction_leaves_the_others_to_the_prior() -> None:
    rng = np.random.default_rng(2)
    slopes = 1e10 * np.outer(rng.standard_normal(200), [1.0, 2.0, -1.0])
    along = principal(slopes, np.full(3, 0.7))
    assert np.all(np.isfinite(along))
    lengths = np.sort(np.linalg.norm(along, axis=0))
    assert lengths[0] < 1e-9
    np.testing.assert_allclose(lengths[1:], 0.7, rtol=1e-6)
