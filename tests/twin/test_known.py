"""Certainty of a twin, as its file states it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hdbridge.sim.truth import Truth
from hdbridge.twin.check import Known
from hdbridge.twin.fit import free_parameters

TRUTH = Truth.load(Path(__file__).parents[2] / "profiles" / "demo")
PARAMETERS = free_parameters(TRUTH)
PRIOR = np.array([each.spread for each in PARAMETERS])


def known(covariance: np.ndarray) -> Known:
    return Known(tuple(each.name for each in PARAMETERS), covariance, {})


def test_what_a_fit_knows_better_than_the_prior_is_as_the_fit_says():
    rng = np.random.default_rng(1)
    some = rng.standard_normal((len(PRIOR), len(PRIOR)))
    covariance = np.outer(PRIOR, PRIOR) * (some @ some.T / np.linalg.norm(some, 2) ** 2)
    root = known(covariance).root(PARAMETERS)
    assert root @ root.T == pytest.approx(covariance, abs=1e-9)


def test_no_direction_is_known_worse_than_before_the_fit():
    """Residuals of six legs and sixteen parameters gave 81 in the logarithm of an inertia."""
    direction = np.ones(len(PRIOR)) / np.sqrt(len(PRIOR))
    covariance = np.outer(PRIOR, PRIOR) * (
        1e-4 * np.eye(len(PRIOR)) + 6000.0 * np.outer(direction, direction)
    )
    root = known(covariance).root(PARAMETERS) / PRIOR[:, None]
    along = float(direction @ root @ root.T @ direction)
    across = np.linalg.eigvalsh(root @ root.T)[:-1]
    assert along == pytest.approx(1.0)
    assert across == pytest.approx(1e-4)
