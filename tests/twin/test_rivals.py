"""Residuals of a recording that distinguish a twin from a rival, or do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hdbridge.sim.truth import Truth
from hdbridge.twin.naming import put_back, told_apart
from hdbridge.twin.parameters import BY_NAME, with_values

DEMO = Truth.load(Path(__file__).parents[2] / "profiles" / "demo")

LEGS = np.repeat(np.arange(12.0), 100)
CHANGE = np.sin(np.arange(len(LEGS)) / 7.0)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(len(LEGS))


@pytest.mark.parametrize(("size", "least", "most"), [(0.01, 0.005, 0.05), (0.5, 1.0, 1.0)])
def test_a_change_below_the_noise_is_told_as_seldom_as_a_false_alarm_may_be(
    size: float, least: float, most: float
) -> None:
    told = [told_apart(noise(seed), size * CHANGE, LEGS) for seed in range(400)]
    assert least <= np.mean(told) <= most


def test_residuals_that_go_together_within_a_leg_hide_a_change_that_white_noise_would_show() -> None:
    """In each leg they are as large as the change, of a sign of its own; white ones are as large in all."""
    change = 0.5 * CHANGE
    signs = np.random.default_rng(3).choice([-1.0, 1.0], 12)
    together = (2.0 * change * signs[LEGS.astype(int)]) - change * (2.0 * np.mean(signs))
    white = np.random.default_rng(4).permutation(together)
    assert not told_apart(together, change, LEGS)
    assert told_apart(white, change, LEGS)


def test_a_rival_that_leaves_less_is_not_told_apart() -> None:
    assert not told_apart(CHANGE, -CHANGE, LEGS)


def test_a_spring_that_is_put_back_is_no_stiffer_than_the_time_step_resolves() -> None:
    """The stiff axis had a larger inertia; with the twin's it would ring faster than the time step."""
    light = with_values(DEMO, {"motor inertia": 1e-7, "load inertia": 1e-3, "gear stiffness": 100.0})
    rival = put_back(DEMO, light, [BY_NAME["gear stiffness"]])
    assert rival.load_.inertia_kg_m2 == pytest.approx(1e-3)
    assert 100.0 < rival.gear.stiffness_nm_per_rad < DEMO.gear.stiffness_nm_per_rad
