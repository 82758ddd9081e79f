"""A short one-way move yields no confident cause: place, time, speed and torque coincide."""

from typing import Any

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.effects import Hysteresis, HysteresisMemory, Synchronous
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.records.record import Record

ORDERS = ((1, 4.9, -126.8), (2, 9.33, -132.1), (3, 2.09, -96.2), (4, 12.21, 105.7), (6, 3.18, -127.0))
SHAPES = (
    lambda u: u,
    lambda u: u * u * (3.0 - 2.0 * u),
    lambda u: u * u,
    lambda u: 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5,
)


def move(rng: np.random.Generator) -> Record:
    """One smooth move of an axis that has only orders and a hysteresis loop, as any bench may record it."""
    count, rate_hz = int(rng.integers(60, 500)), 10.0 ** rng.uniform(1.0, 2.7)
    time_s = np.arange(count) / rate_hz
    turns = 10.0 ** rng.uniform(-1.0, 1.3) * rng.choice((-1.0, 1.0))
    shape = SHAPES[int(rng.integers(0, len(SHAPES)))]
    motor = rng.uniform(-5000.0, 5000.0) + turns * 360.0 * shape(np.arange(count) / count)
    error = sum(a * np.cos(np.radians(k * motor + phase)) for k, a, phase in ORDERS)
    sign, before = np.sign(turns), rng.choice((-1.0, 0.0, 1.0))
    crossed = np.exp(-4.0 * np.abs(motor - motor[0]) / rng.uniform(5.0, 40.0))
    error = error + 40.0 * sign * (1.0 - (1.0 - sign * before) * crossed) + rng.uniform(-100.0, 100.0)
    load = motor / 50.0 + (error + 10.0 ** rng.uniform(-1.0, 0.5) * rng.standard_normal(count)) / 3600.0
    columns: dict[str, Any] = {"time_s": time_s}
    if rng.random() < 0.3:  # an interpolated encoder with noise
        columns["motor_position_deg"] = motor + 10.0 ** rng.uniform(-2.0, -0.5) * rng.standard_normal(count)
        columns["load_position_deg"] = load
    else:
        columns["motor_position_deg"] = np.round(motor / 0.045) * 0.045
        columns["load_position_deg"] = np.round(load / 1.25e-4) * 1.25e-4
    if rng.random() < 0.5:
        columns["motor_target_deg"] = motor
    return Record(columns)


def baseline(rng: np.random.Generator) -> TransmissionModel:
    """Draws a model of the axis that is wrong by up to a half, or lacks the loop, the orders or both."""
    off, kind = 10.0 ** rng.uniform(-2.0, -0.3), rng.integers(0, 4)

    def wrong(value: float) -> float:
        return value * (1.0 + off * rng.uniform(-1.0, 1.0))

    orders = tuple(
        MotorOrder(order=k, amplitude_arcsec=wrong(a), phase_deg=phase + 60.0 * off * rng.uniform(-1.0, 1.0))
        for k, a, phase in ORDERS
    )
    law = (Hysteresis, HysteresisMemory)[int(rng.integers(0, 2))]
    loop = law(offset_arcsec=wrong(40.0), width_deg=wrong(20.0), exponent=1.6)
    parts = ((Synchronous(orders=orders), loop), (loop,), (Synchronous(orders=orders),), ())
    return TransmissionModel(50.0, parts[kind])


@settings(max_examples=12, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**32 - 1))
@example(133954)  # an earlier version named play with this seed
def test_no_confident_name_and_no_wild_model(seed: int) -> None:
    rng = np.random.default_rng(seed)
    record, model = move(rng), baseline(rng)
    try:
        found = diagnose(record, model)
    except InputError:
        return  # a refusal is correct, too
    named = [each for each in found.findings if each.cause != "unexplained"]
    assert all(each.probability <= 0.6 for each in named), named
    assert not {each.cause for each in named} & {"hysteresis_memory", "hysteresis_parameters", "backlash"}
    assert any("reversal" in each for each in found.remarks)
    for effect in found.model.effects:
        assert all(each.amplitude_arcsec < 300.0 for each in getattr(effect, "orders", ())), effect
