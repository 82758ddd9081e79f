"""Tests that fast effects are separated from noise: noise floor, frequency, and decay after a stop."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.special import bdtr
from support.filters import filtered

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.prepared import between_lines, noise_arcsec
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record, concatenate

NOISE_ARCSEC = 0.35
"""Noise of the plant: white noise, and rounding of the load encoder."""


def diagnosed(plant: ModuleType, effects: dict[str, Any], seed: int, rate_hz: float = 16.0) -> Diagnosis:
    plan = plant.Plan(rate_hz=rate_hz, scale=0.1, load_turns=1.05, steps=8)
    record = plant.record(plant.Truth(effects=effects), plan, seed)
    return diagnose(Record(record), TransmissionModel.from_text(plant.model_text(seed + 5)))


def names(found: Diagnosis) -> list[str]:
    return [each.cause for each in found.findings]


def often_enough(right: int, of: int, rate: float) -> bool:
    """Returns True if this number of correct findings does not contradict the rate at the 1 % level."""
    return float(bdtr(right, of, rate)) > 0.01


@pytest.mark.parametrize("hz", [3.0, 8.0, 15.0, 22.0])
def test_a_vibration_is_not_noise(hz: float) -> None:
    time_s = np.arange(6000) / 50.0
    noise = 0.3 * np.random.default_rng(int(hz)).standard_normal(len(time_s))
    shaken = noise + 5.0 * np.cos(2.0 * np.pi * hz * time_s)
    still = time_s < 40.0
    assert noise_arcsec(shaken, still, 0.0, 0.0, True) == pytest.approx(0.3, rel=0.25)


def test_white_noise_is_estimated_without_slow_terms() -> None:
    rng = np.random.default_rng(4)
    rows = np.arange(20_000) % 50 < 40
    slow = 40.0 * np.sin(np.arange(len(rows)) / 300.0)
    assert between_lines(rng.standard_normal(len(rows)) + slow, rows) == pytest.approx(1.0, rel=0.1)


def test_a_short_vibration_has_no_spectrum() -> None:
    assert between_lines(np.zeros(60), np.ones(60, dtype=bool)) == np.inf


def test_a_resolved_vibration_is_removed_completely(plant: ModuleType) -> None:
    found = diagnosed(plant, {"vibration": {"size": 5.0, "hz": 10.43}}, seed=31, rate_hz=50.0)
    assert names(found) == ["vibration"]
    assert found.noise_floor_arcsec == pytest.approx(NOISE_ARCSEC, rel=0.15)
    assert found.extended.rms_arcsec == pytest.approx(NOISE_ARCSEC, rel=0.15)


def creeping(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    tau_s, build_up = (
        float(np.exp(rng.uniform(np.log(0.3), np.log(12.0)))),
        float(rng.choice([0.03, 0.3, 1.0])),
    )
    return {"creep": {"size": float(rng.uniform(3.0, 6.0)), "tau": tau_s, "build": build_up}}


def damaged(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    size = float(rng.uniform(4.0, 7.0))
    return {
        "load_order": {"orders": [(1, 1.4 * size, float(rng.uniform(0, 360))), (2, 0.7 * size, 80.0)]},
        "local_defect": {"size": size, "at": float(rng.uniform(30, 330)), "width": 2.0},
    }


def test_fast_creep_is_named(plant: ModuleType) -> None:
    assert names(diagnosed(plant, {"creep": {"size": 4.0, "tau": 0.5, "build": 1.0}}, seed=43)) == ["creep"]


def test_a_damaged_tooth_is_named_next_to_a_load_order(plant: ModuleType) -> None:
    assert names(diagnosed(plant, damaged(51), seed=51)) == ["load_order", "local_defect"]


def test_an_unattributed_arcsec_is_unexplained(plant: ModuleType) -> None:
    """The error varies slowly in motion, by 1.7 arcsec rms; the motor encoder's counts add 0.9 arcsec rms."""
    record = plant.record(plant.Truth(), plant.Plan(rate_hz=16.0, scale=0.1, load_turns=1.05, steps=8), 71)
    time_s = record["time_s"]
    decay = float(np.exp(time_s[0] - time_s[1]))
    white = np.sqrt(1.0 - decay**2) * np.random.default_rng(7).standard_normal(len(time_s))
    moves = np.gradient(record["motor_target_deg"]) != 0.0
    record["load_position_deg"] += 1.7 * moves * filtered([1.0], [1.0, -decay], white) / 3600.0
    del record["motor_target_deg"]
    found = diagnose(Record(record), TransmissionModel.from_text(plant.model_text(76)))
    assert "unexplained" in names(found)


def one_way(seed: int) -> Record:
    """Returns four equal one-second moves with a motor order, a speed term, and slow and white noise."""
    rng = np.random.default_rng(seed)
    part = np.arange(100) / 100.0
    turns, phase, drag = rng.uniform(1.2, 2.5), rng.uniform(0.0, 6.0), rng.uniform(0.01, 0.03)
    moves = []
    for number in range(4):
        motor = 100.0 + 360.0 * turns * part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        error = 20.0 * np.cos(np.radians(2.0 * motor) + phase) - drag * np.gradient(motor, 0.01)
        slow = filtered([0.6], [1.0, -0.95], rng.standard_normal(300))[200:]
        load = motor / 100.0 + (error + 40.0 * number + slow + rng.standard_normal(100)) / 3600.0
        moves.append(Record({"time_s": part, "motor_position_deg": motor, "load_position_deg": load}))
    return concatenate(moves)


def test_a_speed_term_is_not_a_vibration_of_equal_moves() -> None:
    found = [
        names(diagnose(one_way(seed), TransmissionModel(100.0, ()), independent_zeros=True))
        for seed in range(20, 26)
    ]
    assert often_enough(sum(bool({"channel_skew", "velocity_windup"} & set(each)) for each in found), 6, 0.95)
    assert often_enough(sum("vibration" not in each for each in found), 6, 0.95)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [creeping, damaged])
def test_only_hidden_causes_are_named(plant: ModuleType, draw: Callable[[int], dict[str, Any]]) -> None:
    right = sum(set(names(diagnosed(plant, draw(seed), seed))) == set(draw(seed)) for seed in range(601, 613))
    assert often_enough(right, 12, 0.95)
