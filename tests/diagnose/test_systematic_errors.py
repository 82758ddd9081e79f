"""Tests that intervals include systematic errors, due to a different law or to a hidden similar effect."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.filters import filtered, least

from hdbridge.analysis.acceptance import gate
from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis, Parameter
from hdbridge.analysis.hypothesis import Estimator, Hypothesis
from hdbridge.analysis.parameters import covariance, parameters_of, precisely
from hdbridge.analysis.prepared import gather
from hdbridge.axis.effects import (
    ChannelSkew,
    Creep,
    Effect,
    InertialWindup,
    LoadOrders,
    LocalDefect,
    Start,
    VelocityWindup,
)
from hdbridge.axis.effects.creep import Relaxation
from hdbridge.axis.effects.orders import orders_from
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

Columns = Callable[..., dict[str, Any]]
HELD = 0.95
"""Nominal fraction of true values within the intervals."""


def parameters(record: dict[str, Any], model: TransmissionModel, effect: Effect) -> dict[str, Parameter]:
    """Returns the parameters of an effect that is fitted to a record in addition to the model."""
    estimator = Estimator(gather(Record(record), 50.0))
    hypothesis = Hypothesis((*model.effects, effect), Start.FORWARD)
    precise = precisely(estimator, estimator.fit(hypothesis))
    return parameters_of(estimator, precise, len(model.effects), covariance(estimator, precise))


def holds(parameter: Parameter, truth: float) -> bool:
    if parameter.unit == "deg":
        truth = parameter.value + math.remainder(truth - parameter.value, 360.0)
    return parameter.low <= truth <= parameter.high


def enough(inside: list[bool]) -> bool:
    """Returns True if the coverage does not contradict the nominal one."""
    return sum(inside) >= least(len(inside), HELD)


def test_drag_with_another_exponent_is_within_its_intervals(
    columns: Columns, model: TransmissionModel
) -> None:
    """The shear thinning of the drag has an exponent of 0.8 in the plant and of 1 in the law."""
    inside: list[bool] = []
    for seed in range(41, 46):
        rng = np.random.default_rng(seed)
        coulomb, viscous, shear = rng.uniform(1.0, 2.5), rng.uniform(0.02, 0.05), rng.uniform(300.0, 600.0)
        record = columns({"velocity_windup": {"coulomb": coulomb, "viscous": viscous, "shear": shear}}, seed)
        fitted = parameters(record, model, VelocityWindup.candidate(50.0))
        inside += [
            holds(fitted["coulomb_arcsec"], coulomb),
            holds(fitted["viscous_arcsec_s_per_deg"], viscous),
            holds(fitted["shear_deg_s"], shear),
        ]
    assert enough(inside), inside


@pytest.mark.parametrize(
    ("effects", "beside"),
    [
        ({"velocity_windup": {"coulomb": 1.0, "viscous": 0.05, "shear": 100.0}}, [VelocityWindup]),
        ({"inertial_windup": {"s2": 2e-5}}, []),
    ],
    ids=["beside a drag that falls off by another power of the speed", "beside a load's own wind-up"],
)
def test_effects_present_without_delay_are_not_evidence_of_delay(
    columns: Columns, model: TransmissionModel, effects: Any, beside: list[type[Effect]]
) -> None:
    estimator = Estimator(gather(Record(columns(effects)), 50.0))
    others = (*model.effects, *(each.candidate(50.0) for each in beside))
    fitted = estimator.fit(Hypothesis((*others, ChannelSkew.candidate(50.0)), Start.FORWARD))
    found = gate(estimator, fitted, len(others))
    assert found.robust < found.needed


def test_motor_motion_within_a_count_at_rest_is_not_creep(
    plant: ModuleType, columns: Columns, model: TransmissionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motor is 0.8 counts ahead of its command until 0.3 s after each stop, and then returns."""
    path, motor_angles = plant.path, []

    def ahead(plan: Any, rng: np.random.Generator) -> Any:
        time_s, motor, legs = path(plan, rng)
        motor_angles.append(motor)
        steps = np.sign(np.diff(motor, prepend=motor[:1]))
        last = np.maximum.accumulate(np.where(steps != 0.0, np.arange(len(steps)), 0))
        still_s = time_s - time_s[last]
        return time_s, motor + 0.8 * 360.0 / 8000.0 * steps[last] * (still_s < 0.3), legs

    monkeypatch.setattr(plant, "path", ahead)
    record = columns(slow_noise=0.0)
    estimator = Estimator(gather(Record({**record, "motor_target_deg": motor_angles[0][::10]}), 50.0))
    base = estimator.fit(Hypothesis(model.effects, Start.FORWARD)).hypothesis
    creep = Creep(parts=(Relaxation(amplitude_arcsec=1.0, tau_s=0.3),), build_up=0.1)
    found = gate(estimator, estimator.fit(base.plus(creep)), len(model.effects))
    assert found.reason


def test_turning_short_by_a_count_is_not_a_changed_loop(
    plant: ModuleType, columns: Columns, model: TransmissionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Friction holds the motor 0.4 counts short of its command at every reversal."""
    path, commands = plant.path, []

    def short(plan: Any, rng: np.random.Generator) -> Any:
        time_s, motor, legs = path(plan, rng)
        commands.append(motor)
        slack = 0.4 * 360.0 / 8000.0
        followed = accumulate(motor, lambda at, to: min(max(at, to - slack), to + slack))
        return time_s, np.array(list(followed)), legs

    monkeypatch.setattr(plant, "path", short)
    record = columns(slow_noise=0.0)
    found = diagnose(Record({**record, "motor_target_deg": commands[0][::10]}), model)
    loops = {"backlash", "hysteresis_memory", "hysteresis_parameters"}
    assert not loops & {each.cause for each in found.findings}


def test_wind_up_of_a_swinging_load_is_within_its_interval(
    plant: ModuleType, model: TransmissionModel
) -> None:
    """The law is valid only far below the resonance, but these moves accelerate within 0.15 s."""
    plan = plant.Plan(rate_hz=50.0, scale=0.05, load_turns=0.1, steps=16)
    inside: list[bool] = []
    for seed in range(81, 87):
        rng = np.random.default_rng(seed)
        turn = 2.0 * np.pi * rng.uniform(18.0, 30.0)
        time_s, motor, _ = plant.path(plan, np.random.default_rng(seed))
        acceleration = np.gradient(np.gradient(motor, time_s), time_s)
        # Bilinear transform of 1 / (s^2 + 0.3 turn s + turn^2) by s = fast (z - 1) / (z + 1).
        fast = 2.0 / (time_s[1] - time_s[0])
        first, last = (fast**2 + sign * 0.3 * turn * fast + turn**2 for sign in (1.0, -1.0))
        back = [1.0, 2.0 * (turn**2 - fast**2) / first, last / first]
        swung = filtered([1.0, 2.0, 1.0], back, acceleration) / first
        record = plant.record(plant.Truth(), plan, seed)
        record["load_position_deg"] -= swung[::10] / 50.0
        fitted = parameters(record, model, InertialWindup.candidate(50.0))
        inside.append(holds(fitted["inertia_over_stiffness_s2"], turn**-2.0))
    assert enough(inside), inside


def test_the_height_of_a_bump_of_another_form_is_within_its_interval(
    columns: Columns, model: TransmissionModel
) -> None:
    """The bump is a Gaussian in the plant and a raised cosine in the law."""
    inside: list[bool] = []
    for seed in range(61, 69):
        rng = np.random.default_rng(seed)
        height, centre, sigma = rng.uniform(4.0, 9.0), rng.uniform(30.0, 330.0), rng.uniform(1.0, 3.0)
        record = columns({"local_defect": {"size": height, "at": centre, "width": sigma}}, seed)
        near = LocalDefect(ratio=50.0, height_arcsec=1.0, centre_deg=centre, half_width_deg=2.5 * sigma)
        inside.append(holds(parameters(record, model, near)["height_arcsec"], height))
    assert enough(inside), inside


def test_eccentricity_next_to_an_unknown_spring_is_as_uncertain_as_it_should_be(
    columns: Columns, model: TransmissionModel
) -> None:
    """Wind-up under an eccentric mass and run-out both repeat once per load turn; only the sum is visible."""
    inside: list[bool] = []
    for seed in range(51, 55):
        rng = np.random.default_rng(seed)
        size, phase, compliance = rng.uniform(5.0, 12.0), rng.uniform(-180.0, 180.0), rng.uniform(0.5, 1.5)
        effects = {
            "load_order": {"orders": [(1, size, phase), (2, 4.0, 10.0)]},
            "compliance": {"c1": compliance, "c2": compliance, "t1": 1e3},
        }
        record = columns(effects, seed, torque_nm=9.0)
        fitted = parameters(record, model, LoadOrders(ratio=50.0, orders=orders_from([1, 2])))
        inside += [holds(fitted["order_1_amplitude_arcsec"], size), holds(fitted["order_1_phase_deg"], phase)]
        twice = fitted["order_2_amplitude_arcsec"]
        assert twice.low < 4.0 < twice.high < 4.5  # a linear compliance causes no second order
    assert enough(inside), inside


def test_eccentricity_has_the_spring_as_an_alias(diagnosed: Callable[..., Diagnosis]) -> None:
    run_out = {"load_order": {"orders": [(1, 8.0, 60.0), (2, 4.0, 10.0)]}}
    (found,) = diagnosed(run_out, torque_nm=9.0).findings
    assert found.cause == LoadOrders.name
    assert "compliance" in found.aliases
