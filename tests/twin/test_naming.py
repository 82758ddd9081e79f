"""Names after a fit, on residuals that are known functions of the plant's parameters; rivals of a twin."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.demo import TRUTH

from hdbridge.axis.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import fitted_rows, legs_of_rows, solve
from hdbridge.twin.misfit import Scales
from hdbridge.twin.naming import Explained, InseparableSet, explain, inseparable_sets, worse_than_chance
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, named, with_values

NAMES = ("Coulomb friction", "servo dead time", "command filter")
ROWS, LEGS = 1200, 24
QUICK = 0.5
"""Acceleration that separates dead time and filter significantly, but by less than half the noise."""


class Known:
    """Replaces replays: the following error is a lag in proportion to the speed, the torque is a friction
    with the sign of the speed, and the measured values have noise.

    Dead time and filter cause the same lag, except that the filter also has a term with the acceleration of a
    ``quick`` motion.
    """

    def __init__(self, axis: Truth, quick: float) -> None:
        rng = np.random.default_rng(0)
        self.speed = np.sin(np.arange(ROWS) / 9.0)
        self.quick = quick * np.cos(np.arange(ROWS) / 9.0)
        shown = self._shown(axis)
        self.measured = {name: each + rng.standard_normal(ROWS) for name, each in shown.items()}
        leg = np.repeat(np.arange(LEGS), ROWS // LEGS)
        counts = {name: np.ones(ROWS, dtype=np.bool_) for name in shown}
        self.rough = self
        self.data: Any = SimpleNamespace(leg=leg, out=leg % 4 == 3, counts=counts)

    def __call__(self, truths: Iterable[Truth]) -> list[dict[str, FloatArray]]:
        return [
            {name: self.measured[name] - each for name, each in self._shown(truth).items()}
            for truth in truths
        ]

    def _shown(self, truth: Truth) -> dict[str, FloatArray]:
        filtered, dead = truth.servo.command_filter_ms, truth.servo.dead_time_ms
        lag = 20.0 * (2.0 * filtered + dead) * self.speed
        return {
            FOLLOWING: lag + filtered**2 * self.quick,
            TORQUE: 1000.0 * truth.motor.coulomb_nm * np.sign(self.speed),
            LOAD: np.zeros(ROWS),
        }


def diagnosed(
    axis: Truth, quick: float, *, ratio: bool = False
) -> tuple[Explained, tuple[InseparableSet, ...]]:
    """Returns the causes by which the axis differs from `TRUTH`, and the sets of inseparable parameters."""
    replays: Any = Known(axis, quick)
    parameters = named(*NAMES)
    noise = dict.fromkeys((FOLLOWING, TORQUE, LOAD), 1.0)
    fitted = solve(replays, TRUTH, parameters, 12, known=Scales(noise))
    found = explain(replays, TRUTH, parameters, dict.fromkeys(noise, np.ones(ROWS)), ratio=ratio)
    return found, inseparable_sets(fitted, legs_of_rows(replays.data, fitted_rows(replays.data)))


def test_nothing_is_named_for_a_correct_start() -> None:
    assert diagnosed(TRUTH, quick=50.0)[0].causes == ()


def test_only_wrong_values_are_named_if_the_motion_shows_them() -> None:
    found, sets = diagnosed(
        with_values(TRUTH, {"servo dead time": 1.0, "Coulomb friction": 0.06}), quick=50.0
    )
    assert set(found.causes) == {"servo dead time", "friction"}
    assert found.rivals == sets == ()


def test_dead_time_and_filter_are_a_set_if_inseparable() -> None:
    found, sets = diagnosed(with_values(TRUTH, {"servo dead time": 1.5}), quick=0.01)
    assert {*found.causes, *found.rivals} == {"servo dead time", "command filter"}
    assert {"servo dead time", "command filter"} in [set(each.names) for each in sets]


@pytest.mark.parametrize(("quick", "rivals"), [(QUICK, ("command filter",)), (50.0, ())])
def test_small_differences_between_causes_are_no_evidence_for_a_replay(
    quick: float, rivals: tuple[str, ...]
) -> None:
    axis = with_values(TRUTH, {"servo dead time": 1.5})
    assert diagnosed(axis, quick)[0].rivals == ()
    found = diagnosed(axis, quick, ratio=True)[0]
    assert (found.causes, found.rivals) == (("servo dead time",), rivals)


LEG_OF_ROW = np.repeat(np.arange(12), 100)
CHANGE = np.sin(np.arange(len(LEG_OF_ROW)) / 7.0)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(len(LEG_OF_ROW))


@pytest.mark.parametrize(("size", "least", "most"), [(0.01, 0.005, 0.05), (0.5, 1.0, 1.0)])
def test_changes_below_the_noise_keep_the_false_alarm_rate(size: float, least: float, most: float) -> None:
    detections = [worse_than_chance(noise(seed), size * CHANGE, LEG_OF_ROW) for seed in range(400)]
    assert least <= np.mean(detections) <= most


def test_correlated_residuals_hide_changes_that_white_noise_would_show() -> None:
    """Correlated residuals resemble the change in each leg, with a random sign per leg; white residuals of
    the same total power average out within a leg.
    """
    change = 0.5 * CHANGE
    signs = np.random.default_rng(3).choice([-1.0, 1.0], 12)
    together = (2.0 * change * signs[LEG_OF_ROW]) - change * (2.0 * np.mean(signs))
    white = np.random.default_rng(4).permutation(together)
    assert not worse_than_chance(together, change, LEG_OF_ROW)
    assert worse_than_chance(white, change, LEG_OF_ROW)


def test_a_better_rival_is_reported_as_inseparable() -> None:
    assert not worse_than_chance(CHANGE, -CHANGE, LEG_OF_ROW)
