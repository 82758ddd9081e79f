"""Recorded torque of a motor against its acceleration, for tests of the torque's sign and scale."""

import numpy as np
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.records.record import Record
from hdbridge.sim.truth import Truth


def balance(record: Record) -> tuple[float, float]:
    """Returns inertia (kg m2) and friction (Nm) at the motor, fitted to the recorded torque in motion."""
    period_s = float(np.median(np.diff(record.time_s)))
    angle = np.radians(record.motor_position_deg)
    speed = np.gradient(angle, period_s)
    acceleration = np.convolve(np.gradient(speed, period_s), np.ones(5) / 5.0, "same")
    torque = np.convolve(record.columns["motor_torque_nm"], np.ones(5) / 5.0, "same")
    moving = np.abs(speed) > 1.0
    assert np.count_nonzero(moving) > 100
    columns = np.column_stack([acceleration, np.sign(speed)])[moving]
    inertia, friction = np.linalg.lstsq(columns, torque[moving], rcond=None)[0]
    return float(inertia), float(friction)


def directed(axis: AxisConfig, direction: int) -> AxisConfig:
    """Returns an axis whose motor encoder counts in this direction."""
    return axis.model_copy(
        update={"motor_encoder": axis.motor_encoder.model_copy(update={"direction": direction})}
    )


def check_torque(known: Truth, record: Record) -> None:
    """Checks that the recorded torque accelerates motor and load, and overcomes the friction."""
    inertia, friction = balance(record)
    expected = known.motor.inertia_kg_m2 + known.load_.inertia_kg_m2 / known.gear.ratio**2
    assert inertia == pytest.approx(expected, rel=0.3)
    assert friction == pytest.approx(known.motor.coulomb_nm, rel=0.5)
