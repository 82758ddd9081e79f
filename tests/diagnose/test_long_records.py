"""Tests that averaging the samples of a long record does not change its figures."""

from __future__ import annotations

import numpy as np
import pytest

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.effects import Synchronous
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

ORDERS = ((2, 9.0, -132.0), (8, 2.0, 124.0), (24, 2.0, 30.0))


def test_averaging_keeps_the_amplitude_of_fast_orders() -> None:
    """With 150,000 samples at two motor turns per second, means of three reduce order 24 by an eighth."""
    count, turns = 150_000, 60.0
    time_s = np.arange(count) / 200.0
    motor = 360.0 * turns * np.abs(np.mod(time_s / (0.5 * turns) + 1.0, 2.0) - 1.0)
    error = sum(size * np.cos(np.radians(order * motor + phase)) for order, size, phase in ORDERS)
    noise = 0.3 * np.random.default_rng(0).standard_normal(count)
    columns = {
        "time_s": time_s,
        "motor_position_deg": motor,
        "motor_target_deg": motor,
        "load_position_deg": motor / 50.0 + (error + noise) / 3600.0,
    }
    known = tuple(MotorOrder(order=k, amplitude_arcsec=1.05 * a, phase_deg=p) for k, a, p in ORDERS)
    found = diagnose(Record(columns), TransmissionModel(50.0, (Synchronous(orders=known),)))
    assert found.findings == ()
    fitted = next(each for each in found.model.effects if isinstance(each, Synchronous))
    for (order, size, _), now in zip(ORDERS, fitted.orders, strict=True):
        assert now.amplitude_arcsec == pytest.approx(size, rel=0.01), order
    assert found.extended.rms_arcsec < 1.1 * found.noise_floor_arcsec
