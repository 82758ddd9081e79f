"""The recursive estimator equals least squares, and learns or forgets only excited parameters."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.linear import solve_symmetric
from hdbridge.daemon.following.estimator import Estimator

SIGMA = 0.9
seeds = st.integers(0, 10_000)


def fresh(count: int, seed: int = 0) -> Estimator:
    """A prior with correlations."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, count))
    scale = rng.uniform(1.0, 20.0, count)
    return Estimator(np.zeros(count), np.diag(scale**2) + 0.1 * root @ root.T, scale)


def data(count: int, rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(rows, count))
    return columns, columns @ rng.normal(0.0, 3.0, count) + rng.normal(0.0, SIGMA, rows)


@given(seed=seeds, cuts=st.lists(st.integers(1, 39), max_size=6))
def test_without_forgetting_it_equals_least_squares_with_a_prior(seed, cuts):
    columns, observed = data(5, 40, seed)
    estimator = fresh(5, seed)
    prior = np.linalg.inv(estimator.covariance)
    for rows in np.split(np.arange(40), sorted(set(cuts))):
        estimator.update(columns[rows], observed[rows], SIGMA)
    information = prior + columns.T @ columns / SIGMA**2
    expected = solve_symmetric(information, columns.T @ observed / SIGMA**2)
    assert estimator.estimate == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert estimator.covariance == pytest.approx(np.linalg.inv(information), rel=1e-5, abs=1e-9)


@given(seed=seeds, keep=st.floats(0.3, 1.0), correlated=st.booleans())
def test_unexcited_parameters_are_neither_learnt_nor_forgotten(seed, keep, correlated):
    estimator = fresh(6, seed)
    hidden, shown = slice(0, 4), slice(4, 6)
    if not correlated:
        estimator.covariance[hidden, shown] = estimator.covariance[shown, hidden] = 0.0
    before = estimator.covariance.copy()
    rows, observed = data(6, 30, seed)
    rows[:, hidden] = 0.0
    estimator.update(rows, observed, SIGMA, retention=keep)
    gained = np.linalg.eigvalsh(estimator.covariance[hidden, hidden] - before[hidden, hidden])
    assert np.all(gained <= 1e-9 * before[0, 0])
    if not correlated:
        assert np.array_equal(estimator.estimate[hidden], np.zeros(4))
        assert estimator.covariance[hidden, hidden] == pytest.approx(before[hidden, hidden], rel=1e-12)


@given(seed=seeds, keep=st.floats(0.3, 1.0))
def test_held_parameters_keep_value_and_variance(seed, keep):
    estimator = fresh(5, seed)
    before = estimator.covariance.copy()
    columns, observed = data(5, 30, seed)
    held = np.array([True, False, True, False, False])
    estimator.update(columns, observed, SIGMA, retention=keep, held=held)
    assert np.array_equal(estimator.estimate[held], np.zeros(2))
    assert estimator.covariance[np.ix_(held, held)] == pytest.approx(before[np.ix_(held, held)], rel=1e-9)
    assert np.all(estimator.estimate[~held] != 0.0)


@settings(max_examples=20)
@given(seed=seeds, keep=st.floats(0.05, 0.99), shown=st.integers(1, 5))
def test_endless_forgetting_does_not_inflate_the_variance(seed, keep, shown):
    estimator = fresh(5, seed)
    first = estimator.covariance.copy()
    rng = np.random.default_rng(seed)
    kept = rng.normal(size=(shown, 5))
    for _ in range(200):
        rows = rng.normal(size=(6, shown)) @ kept
        estimator.update(rows, rng.normal(size=6), SIGMA, retention=keep)
        values = np.linalg.eigvalsh(estimator.covariance)
        assert values[0] > 0.0
    # In units of the scale, no direction is less certain than the prior or the scale.
    scaled = estimator.covariance / np.outer(estimator.scale, estimator.scale)
    prior = first / np.outer(estimator.scale, estimator.scale)
    most = max(float(np.linalg.eigvalsh(prior)[-1]), 1.0)
    assert float(np.linalg.eigvalsh(scaled)[-1]) <= 2.0 * most


def test_forgetting_tracks_changes():
    rng = np.random.default_rng(0)
    estimator = fresh(3)
    truth = np.zeros(3)
    for step in range(400):
        truth[0] = 0.05 * step
        rows = rng.normal(size=(10, 3))
        estimator.update(rows, rows @ truth + rng.normal(0.0, 0.1, 10), SIGMA, retention=0.8)
    assert estimator.estimate == pytest.approx(truth, abs=0.5)
