"""Tests that similar causes are distinguished, and tests of the probability of a named cause."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.filters import filtered

from hdbridge.analysis.acceptance import Gate
from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis, Finding
from hdbridge.analysis.gain import Gain
from hdbridge.analysis.probability import weighed
from hdbridge.analysis.scales import Scales
from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

Diagnosed = Callable[..., Diagnosis]


def names(diagnosis: Diagnosis) -> list[str]:
    return [each.cause for each in diagnosis.findings]


@pytest.fixture
def drifting(columns: Callable[..., dict[str, Any]], model: TransmissionModel) -> Callable[..., Diagnosis]:
    """Returns a function that diagnoses a ripple that grows with temperature, at temperatures above the
    model's reference of 20 deg C.
    """

    def run(growth_per_k: float, rise_k: float, warmer_k: float) -> Diagnosis:
        record = columns({"amplitude_drift": {"ripple": growth_per_k}}, temperature_rise_k=rise_k)
        record["temperature_c"] = record["temperature_c"] + warmer_k
        return diagnose(Record(record), model)

    return run


def test_drift_is_reported_from_the_model_temperature(drifting: Callable[..., Diagnosis]) -> None:
    """Relative to any other temperature, the model's amplitudes would appear to have changed, too."""
    result = drifting(0.025, rise_k=10.0, warmer_k=14.0)
    assert names(result) == ["amplitude_drift"]
    growth = result.findings[0].parameters["ripple_percent_per_k"]
    assert growth.value == pytest.approx(2.5, rel=0.15)  # the gear follows the sensor with a lag


def test_ripple_drift_is_found_next_to_a_larger_skew(diagnosed: Diagnosed) -> None:
    """The skew has opposite signs in the two directions; the ripple is equal in both."""
    effects = {"channel_skew": {"ms": 0.7}, "amplitude_drift": {"ripple": 0.006}}
    assert set(names(diagnosed(effects, temperature_rise_k=14.0))) == {"channel_skew", "amplitude_drift"}


def test_a_ripple_that_is_loaded_and_warm_has_grown_by_both(diagnosed: Diagnosed) -> None:
    """The causes combine as a product; a sum would attribute a quarter of one to the other."""
    effects = {"torque_modulation": {"growth": 0.06}, "amplitude_drift": {"ripple": -0.04}}
    result = diagnosed(effects, torque_nm=9.0, temperature_rise_k=10.0)
    found = {each.cause: each.parameters for each in result.findings}
    assert set(found) == set(effects)
    growth = found["torque_modulation"]["growth_percent_per_nm"]
    assert growth.value == pytest.approx(6.0, rel=0.02)
    drift = found["amplitude_drift"]["ripple_percent_per_k"]
    assert drift.value == pytest.approx(-4.0, rel=0.12)  # the gear follows the sensor with a lag


def test_a_wave_close_to_a_calibrated_order_is_not_a_change_of_it(
    plant: ModuleType, model: TransmissionModel
) -> None:
    """Over a quarter of a load turn, the waves differ by half a period; a free order explains most of it."""
    truth = plant.Truth(effects={"flexspline_order": {"orders": [(2, 16.0, 30.0)]}})
    plan = plant.Plan(rate_hz=16.0, scale=0.2, load_turns=0.25, steps=16)
    found = diagnose(Record(plant.record(truth, plan, 1, True)), model).findings[0]
    assert found.cause == "flexspline_order"
    assert found.parameters["order_2_amplitude_arcsec"].value == pytest.approx(16.0, rel=0.05)


def test_residuals_of_one_episode_do_not_hide_global_causes(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    record = columns({"torque_modulation": {"growth": 0.03}}, torque_nm=9.0)
    time_s = record["time_s"]
    share = time_s / time_s[-1]
    jolts = 10.0 * np.sign(np.sin(2 * np.pi * time_s / 7.3) + 0.3 * np.sin(2 * np.pi * time_s / 2.9))
    record["load_position_deg"] = (
        record["load_position_deg"] + jolts * ((share > 0.5) & (share < 0.56)) / 3600.0
    )
    assert names(diagnose(Record(record), model)) == ["unexplained", "torque_modulation"]


def test_ordinary_wind_up_is_not_named(diagnosed: Diagnosed) -> None:
    result = diagnosed({"inertial_windup": {"s2": 6e-6}})
    assert names(result) == []
    assert "inertial_windup" not in {each.name for each in result.model.effects}


def test_small_steps_next_to_a_large_one_are_not_named(diagnosed: Diagnosed) -> None:
    effects = {"count_loss": {"size": 6.0, "at": 0.4}, "creep": {"size": 8.0, "tau": 3.0}}
    result = diagnosed(effects)
    assert set(names(result)) == set(effects)
    (loss,) = [each for each in result.findings if each.cause == "count_loss"]
    assert sum(name.endswith("size_arcsec") for name in loss.parameters) == 1


@pytest.fixture
def sprung(columns: Callable[..., dict[str, Any]], model: TransmissionModel) -> Callable[..., Diagnosis]:
    """Returns a function that diagnoses a compliance under an eccentric mass, with noisy load torque."""

    def run(spring: dict[str, float], torque_nm: float, noise_nm: float) -> Diagnosis:
        record = columns({"compliance": spring}, torque_nm=torque_nm)
        noise = np.random.default_rng(3).normal(size=len(record["time_s"]))
        record["load_torque_nm"] = record["load_torque_nm"] + noise_nm * noise
        return diagnose(Record(record), model)

    return run


def test_a_spring_needs_no_order_for_the_noise_of_its_sensor(sprung: Callable[..., Diagnosis]) -> None:
    result = sprung({"c1": 1.5, "c2": 1.0, "t1": 4.0}, torque_nm=9.0, noise_nm=0.15)
    assert names(result) == ["compliance"]
    assert result.findings[0].parameters["c1_arcsec_per_nm"].value == pytest.approx(1.5, rel=0.1)


def test_a_spring_under_noisy_torque_is_not_a_load_order(
    sprung: Callable[..., Diagnosis],
) -> None:
    (found,) = sprung({"c1": 3.0, "c2": 3.0, "t1": 4.0}, torque_nm=2.0, noise_nm=0.1).findings
    assert (found.cause, found.aliases) == ("compliance", ("load_order",))


def test_flanks_shift_an_order_that_the_model_lacks_as_well(diagnosed: Diagnosed, plant: ModuleType) -> None:
    orders = (*plant.ORDERS, (9, 4.0, 60.0))
    found = diagnosed({"direction_phase": {"shift": 6.0}}, orders=orders)
    assert set(names(found)) == {"direction_phase", "motor_order"}


def test_a_vibration_of_varying_amplitude_is_named_once(
    columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> None:
    record = columns()
    time_s = record["time_s"]
    swell = 1.0 + 0.3 * np.sign(np.sin(time_s / 6.0))
    record["load_position_deg"] = (
        record["load_position_deg"] + swell * 3.0 * np.cos(2 * np.pi * 5.3 * time_s) / 3600
    )
    assert names(diagnose(Record(record), model)).count("vibration") == 1


def test_two_speed_dependent_causes_hiding_each_other_are_found(diagnosed: Diagnosed) -> None:
    effects = {"rate_dependence": {"growth": 0.06, "reference": 2.0}, "channel_skew": {"ms": -0.2}}
    assert set(names(diagnosed(effects))) == {"rate_dependence", "channel_skew"}


def test_settling_within_half_a_second_is_not_creep(diagnosed: Diagnosed) -> None:
    assert "creep" not in names(diagnosed({"creep": {"size": 4.0, "tau": 0.1}}))


def test_relaxation_longer_than_any_rest_is_not_creep(diagnosed: Diagnosed) -> None:
    assert "creep" not in names(diagnosed({"creep": {"size": 4.0, "tau": 2000.0, "build": 0.02}}))


def test_a_wider_loop_of_the_same_height_has_changed(diagnosed: Diagnosed) -> None:
    assert names(diagnosed(width=26.0)) == ["hysteresis_parameters"]


def test_a_sticking_loop_is_not_count_loss(plant: ModuleType) -> None:
    """Friction is higher near rest, and the axis moves back and forth within the width of the loop."""
    rng = np.random.default_rng(2)
    time_s = np.arange(0.0, 28.0, 1.0 / 256.0)
    shaken = rng.normal(size=len(time_s))
    for _ in range(3):
        shaken = filtered([0.03], [1.0, -0.97], shaken)
    motor = 10.0 * shaken / np.std(shaken) * np.sin(np.pi * time_s / 28.0)
    sticks = 1.0 + 0.4 * np.exp(-np.abs(np.gradient(motor, time_s)) / 8.0)
    error = filtered([0.2], [1.0, -0.8], sticks * plant.loop(motor, "memory", 95.0, 32.0, 2.2))
    error = error + 0.2 * rng.normal(size=len(motor))
    record = Record(
        {"time_s": time_s, "motor_position_deg": motor, "load_position_deg": motor / 50.0 + error / 3600.0}
    )
    law = Hysteresis(offset_arcsec=95.0, width_deg=32.0, exponent=2.2)
    found = diagnose(record, TransmissionModel(50.0, (law,)))
    named = {each.cause for each in found.findings if each.probability > 0.5}
    assert {"hysteresis_memory", "unexplained"} <= named
    assert "count_loss" not in named


def test_the_orders_of_one_interpolation_error_are_one_finding(diagnosed: Diagnosed) -> None:
    orders = [(1, 4.0, 30.0), (2, 3.0, 80.0), (4, 2.5, 10.0)]
    result = diagnosed({"subdivisional_error": {"lines": 5000, "orders": orders}})
    assert names(result) == ["subdivisional_error"]


def finding(cause: str, robust: float, peak_arcsec: float) -> Finding:
    gate = Gate(robust=robust / 10.0, needed=25.0)
    gain = Gain("stretches of time", 8, np.ones(8), np.full(8, 4.0), np.full(8, 1.0))
    return Finding(cause, 0.5, (), {}, gain, "", peak_arcsec, robust=robust, gate=gate)


def test_an_unexplained_residual_lowers_the_probability_of_a_cause() -> None:
    alone, beside = (weighed([finding("count_loss", 400.0, 2.0)], each, Scales()) for each in (False, True))
    assert beside[0].probability < alone[0].probability


def test_stronger_evidence_raises_the_probability() -> None:
    weak, strong = (weighed([finding("creep", each, 1.0)], False, Scales())[0] for each in (400.0, 40000.0))
    assert weak.probability < strong.probability < 1.0


def test_a_lagging_load_is_a_loop_of_the_opposite_sign(
    columns: Callable[..., dict[str, Any]], plant: ModuleType
) -> None:
    """Nothing is named if the load lags in the model, too; if it leads in the model, the loop has changed."""
    record = Record(columns(offset=-30.0))
    lags = TransmissionModel.from_text(plant.model_text(5, truth=plant.Truth(offset=-30.0)))
    assert [each.cause for each in diagnose(record, lags).findings] == []
    leads = TransmissionModel.from_text(plant.model_text(5, truth=plant.Truth(offset=30.0)))
    found = diagnose(record, leads)
    assert [each.cause for each in found.findings] == ["hysteresis_parameters"]
    loop = next(each for each in found.model.effects if each.name == "hysteresis")
    assert loop.parameters()["offset_arcsec"] == pytest.approx(-30.0, abs=0.5)
    assert found.extended.rms_arcsec < 1.5 * found.noise_floor_arcsec


@pytest.mark.parametrize(
    "effects",
    [
        {"motor_order": {"orders": [(each, 2.0, 37.0 * each) for each in (5, 7, 9, 10, 11, 12)]}},
        {"unknown": {"kind": "bursts", "size": 5.0}, "load_order": {"orders": [(2, 1.0, 30.0)]}},
    ],
    ids=["more equal orders than one cause has", "bursts beside a small order of the load"],
)
def test_an_unexplained_residual_leads_the_list(diagnosed: Diagnosed, effects: dict[str, Any]) -> None:
    """Without `Scales.near`, the orders count as one cause; the bursts have a larger rms than the order."""
    assert names(diagnosed(effects))[0] == "unexplained"


def test_a_cause_of_most_of_the_error_precedes_an_unexplained_peak(diagnosed: Diagnosed) -> None:
    found = names(
        diagnosed({"unknown": {"kind": "bursts", "size": 5.0}, "load_order": {"orders": [(2, 4.0, 30.0)]}})
    )
    assert found == ["load_order", "unexplained"]
