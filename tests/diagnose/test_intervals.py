"""Tests that 95 % intervals of parameters have their nominal coverage and a reasonable width."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.filters import least

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Parameter
from hdbridge.analysis.hypothesis import Estimator, Hypothesis
from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.linear import Column
from hdbridge.analysis.parameters import covariance, named_parameters, parameters_of, precisely
from hdbridge.analysis.prepared import gather
from hdbridge.axis.effects import FlexsplineOrders, LoadOrders, RatioError, Start, VelocityWindup
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

Columns = Callable[..., dict[str, Any]]
SEEDS = range(10, 20)
LEAST = 0.9
"""Minimum fraction of true values within the intervals."""


def held(parameter: Parameter, name: str, truth: float) -> bool:
    if name.endswith("phase_deg"):
        truth = parameter.value + math.remainder(truth - parameter.value, 360.0)
    return parameter.low <= truth <= parameter.high


def hidden(seed: int) -> tuple[dict[str, Any], Hypothesis, dict[str, float]]:
    """Returns three random errors (flexspline order, ramp, load order) as effects of the plant, as a
    hypothesis with approximate effects, and as expected parameter values.
    """
    rng = np.random.default_rng(seed)
    order, turn, angle = int(rng.integers(2, 6)), *rng.uniform(-180.0, 180.0, 2)
    wave, ramp, run_out = rng.uniform(3.0, 6.0), rng.uniform(0.1, 0.2), rng.uniform(3.0, 6.0)
    effects = {
        "flexspline_order": {"orders": [(order, wave, turn)]},
        "ratio_error": {"ramp": ramp},
        "load_order": {"orders": [(1, run_out, angle)]},
    }
    near = {"amplitude_arcsec": 1.0, "phase_deg": 0.0}
    sought = (
        FlexsplineOrders(ratio=50.0, orders=(MotorOrder(order=order, **near),)),
        RatioError(ramp_arcsec_per_turn=0.0),
        LoadOrders(ratio=50.0, orders=(MotorOrder(order=1, **near),)),
    )
    truth = {
        f"flexspline_order order_{order}_amplitude_arcsec": wave,
        f"flexspline_order order_{order}_phase_deg": turn,
        "ratio_error ramp_arcsec_per_turn": ramp,
        "load_order order_1_amplitude_arcsec": run_out,
        "load_order order_1_phase_deg": angle,
    }
    return effects, Hypothesis(sought, Start.FORWARD), truth


def test_intervals_have_their_nominal_coverage(
    columns: Columns, model: TransmissionModel, plant: ModuleType
) -> None:
    gear = {
        "hysteresis offset_arcsec": 40.0,
        "hysteresis width_deg": 20.0,
        "hysteresis exponent": 1.6,
        **{f"synchronous order_{k}_amplitude_arcsec": size for k, size, _ in plant.ORDERS},
        **{f"synchronous order_{k}_phase_deg": phase for k, _, phase in plant.ORDERS},
    }
    inside: list[bool] = []
    halves: list[float] = []
    for seed in SEEDS:
        effects, sought, truth = hidden(seed)
        estimator = Estimator(gather(Record(columns(effects, seed)), 50.0))
        hypothesis = Hypothesis((*model.effects, *sought.effects), sought.start)
        precise = precisely(estimator, estimator.fit(hypothesis))
        spread = covariance(estimator, precise)
        for place, effect in enumerate(hypothesis.effects):
            for name, parameter in parameters_of(estimator, precise, place, spread).items():
                true = (truth | gear)[f"{effect.name} {name}"]
                inside.append(held(parameter, name, true))
                if not name.endswith("phase_deg"):
                    halves.append(0.5 * (parameter.high - parameter.low) / abs(true))
    assert len(inside) == 20 * len(SEEDS)
    # With a coverage of only LEAST, fewer would be inside in one run of a thousand.
    assert sum(inside) >= least(len(inside), LEAST, 1e-3), f"{sum(inside)} of {len(inside)}"
    assert np.median(halves) < 0.02


def test_poorly_known_shapes_have_log_intervals_within_their_range() -> None:
    drag = VelocityWindup(coulomb_arcsec=1.0, viscous_arcsec_s_per_deg=0.02, shear_deg_s=1000.0)
    (shape,) = drag.shape
    for deviation, factor in ((0.3, math.exp(0.3 * NORMAL_95)), (30.0, math.inf)):
        intervals = named_parameters(drag, [Column(0, shape.name, shape=True)], np.array([[deviation**2]]))
        assert intervals[shape.name].low == pytest.approx(max(1000.0 / factor, shape.lower), rel=1e-3)
        assert intervals[shape.name].high == pytest.approx(min(1000.0 * factor, shape.upper), rel=1e-3)


def test_a_changed_order_is_as_uncertain_as_its_reference(columns: Columns, plant: ModuleType) -> None:
    inside: list[bool] = []
    for seed in range(30, 34):
        rng = np.random.default_rng(seed)
        added = [(order, rng.uniform(3.0, 6.0), rng.uniform(-180.0, 180.0)) for order in (2, 3, 6)]
        record = columns({"motor_order": {"orders": added}}, seed)
        known = TransmissionModel.from_text(plant.model_text(seed))
        found = {each.cause: each for each in diagnose(Record(record), known).findings}["motor_order"]
        for order, size, phase in added:
            truth = {f"order_{order}_amplitude_arcsec": size, f"order_{order}_phase_deg": phase}
            inside += [held(found.parameters[name], name, value) for name, value in truth.items()]
    # Without the variance of the calibration itself, only one interval in ten would contain the truth.
    assert sum(inside) >= least(len(inside), LEAST, 1e-3), f"{sum(inside)} of {len(inside)}"


def swinging(columns: dict[str, Any], orders: Any, frequency_hz: float) -> dict[str, Any]:
    """Returns the columns with the additional load motion due to the gear's compliance at these orders."""
    motor = columns["motor_target_deg"]
    rate = np.radians(np.gradient(motor, columns["time_s"]))
    beyond = sum(
        (k * rate / (2.0 * np.pi * frequency_hz)) ** 2 * size * np.cos(np.radians(k * motor + phase))
        for k, size, phase in orders
    )
    return {**columns, "load_position_deg": columns["load_position_deg"] + beyond / 3600.0}


def test_orders_are_reported_at_rest_despite_load_swing(
    columns: Columns, model: TransmissionModel, plant: ModuleType
) -> None:
    order = (7, 5.0, 40.0)
    record = swinging(columns({"motor_order": {"orders": [order]}}), (*plant.ORDERS, order), 40.0)
    found = diagnose(Record(record), model).findings[0].parameters["order_7_amplitude_arcsec"]
    # At the higher speed, 1.7 motor turns per second, the amplitude of this order at the load is 9 % higher.
    assert found.low < 5.0 < found.high
    assert found.high - found.low < 0.2


def test_shifted_flanks_are_reported_by_their_shift(columns: Columns, model: TransmissionModel) -> None:
    found = diagnose(Record(columns({"direction_phase": {"shift": 7.0}})), model).findings[0]
    assert found.cause == "direction_phase"
    shift = found.parameters["shift_deg"]
    assert shift.low < 7.0 < shift.high
    assert shift.high - shift.low < 0.7


def test_the_time_of_a_count_loss_is_found_within_a_few_samples(
    columns: Columns, model: TransmissionModel
) -> None:
    record = columns({"count_loss": {"size": 5.0, "at": 0.3}})
    true, step_s = 0.3 * record["time_s"][-1], record["time_s"][1] - record["time_s"][0]
    found = diagnose(Record(record), model).findings[0].parameters
    times = [each for name, each in found.items() if name.endswith("time_s")]
    time = min(times, key=lambda each: abs(each.value - true))
    assert time.low <= true <= time.high
    assert 0.5 * step_s < time.high - time.low < 10.0 * step_s
