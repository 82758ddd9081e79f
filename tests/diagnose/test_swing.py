"""Tests with fast moves of a compliant axis: a normal axis has no findings, a soft one has wind-up."""

from __future__ import annotations

import math
import re
from types import ModuleType

import numpy as np
import pytest
from support.filters import filtered

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

STEP_S, EVERY, SYNC = 5e-4, 20, 32
"""Time step of the plant, s; number of steps between samples (100 Hz) and between set-points (62.5 Hz)."""
DAMPING = 0.1


def moved(rng: np.random.Generator) -> np.ndarray:
    """Returns motor angles, degrees, shape (n,): moves with raised-cosine speed, and rests between them."""
    speed = [np.zeros(2000)]
    for _ in range(40):
        rows = int(rng.integers(200, 700))
        shape = 1.0 - np.cos(math.tau * np.arange(rows) / rows)
        speed += [rng.choice([-1.0, 1.0]) * rng.uniform(300.0, 1500.0) * shape, np.zeros(1000)]
    return np.cumsum(np.concatenate(speed)) * STEP_S


def on_spring(base: np.ndarray, hertz: float) -> np.ndarray:
    """Returns the motion of a mass on a spring and a damper behind ``base``, by the bilinear transform."""
    natural = math.tau * hertz
    damper, double = 4.0 * DAMPING * natural / STEP_S, 4.0 / STEP_S**2
    spring = natural**2 * np.array([1.0, 2.0, 1.0])
    forward = damper * np.array([1.0, 0.0, -1.0]) + spring
    back = forward + double * np.array([1.0, -2.0, 1.0])
    return base[0] + filtered(forward / back[0], back / back[0], base - base[0])


@pytest.fixture
def seen(plant: ModuleType, model: TransmissionModel):
    """Returns a function that diagnoses fast moves of a load with this natural frequency, optionally with a
    count loss halfway.
    """

    def run(hertz: float, lost_arcsec: float = 0.0, sync: int = 0) -> Diagnosis:
        rng = np.random.default_rng(3)
        motor = moved(rng)
        if sync:
            rows = np.arange(len(motor))
            motor = np.interp(rows, rows[::sync], motor[::sync])
        error = plant.loop(motor, "plain", 40.0, 20.0, 1.6)
        for order, amplitude, phase in plant.ORDERS:
            error = error + amplitude * np.cos(np.radians(order * motor + phase))
        load = on_spring(motor / plant.RATIO * 3600.0 + error, hertz)
        load[len(load) // 2 :] += lost_arcsec
        rows = slice(0, None, sync or EVERY)
        noisy = load[rows] + 0.3 * rng.normal(size=len(load[rows]))
        columns = {
            "time_s": np.arange(len(motor))[rows] * STEP_S,
            "motor_position_deg": np.round(motor[rows] / 0.022) * 0.022,
            "motor_target_deg": motor[rows],
            "load_position_deg": np.round(noisy / 0.45) * 0.45 / 3600.0,
        }
        return diagnose(Record(columns), model)

    return run


def test_an_ordinary_load_is_silent(seen) -> None:
    found = seen(45.0)
    assert not found.findings
    assert any("oscillates on its spring at 4" in each for each in found.remarks)
    assert "ordinary" in found.identifiability["inertial_windup"].reason


def test_set_points_joined_by_straight_lines_are_silent(seen) -> None:
    """Each set-point excites the load more than a spline through the samples shows."""
    found = seen(65.0, sync=SYNC)
    assert not found.findings
    assert not found.identifiability["inertial_windup"].detectable


def test_the_wind_up_of_a_soft_load_is_named_without_its_ringing(seen) -> None:
    result = seen(28.0)
    assert result.identifiability["inertial_windup"].detectable
    (found,) = result.findings
    assert found.cause == "inertial_windup"
    stated = found.parameters["inertia_over_stiffness_s2"].value
    assert stated == pytest.approx(1.0 / (math.tau * 28.0) ** 2, rel=0.1)


def test_a_larger_cause_does_not_hide_the_swing(seen) -> None:
    found = seen(45.0, lost_arcsec=60.0)
    assert [each.cause for each in found.findings] == ["count_loss"]
    assert any(re.search(r"oscillates on its spring at [45]\d Hz", each) for each in found.remarks)
