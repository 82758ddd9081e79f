"""Tests that noisy samples, large changes and cancelling errors do not mislead a diagnosis."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.ideal_record import ideal_record

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.gain import held_out
from hdbridge.analysis.hypothesis import Estimator, Hypothesis
from hdbridge.analysis.prepared import gather
from hdbridge.axis.effects import Motion, RatioError, Start
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.effects.synchronous import Synchronous
from hdbridge.axis.model import TransmissionModel

RATIO = 50.0
MODEL = TransmissionModel(
    RATIO,
    (
        Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=8.0, phase_deg=30.0),)),
        Hysteresis(offset_arcsec=30.0, width_deg=15.0, exponent=1.6),
    ),
)


def sweeps(number: int, turns: float = 2.0, begin_turns: float = 0.0) -> Any:
    """Returns motor angles of slow sweeps there and back, degrees, in counts of 2^16 per turn."""
    part = np.arange(number * round(400 * turns)) / (400 * turns)
    angle = 360.0 * (begin_turns + turns * 0.5 * (1.0 - np.cos(2.0 * np.pi * part)))
    return np.round(angle * 65536 / 360.0) * 360.0 / 65536


@pytest.mark.parametrize("seed", range(6))
def test_noisy_samples_do_not_decide_about_a_gain(seed: int) -> None:
    """A twentieth of the samples has 40 times the noise."""
    motor = sweeps(8, turns=6.0)
    rng = np.random.default_rng(seed)
    noisy = rng.random(len(motor)) < 0.05
    wild = 20.0 * rng.standard_normal(len(motor)) * noisy
    data = gather(ideal_record(MODEL, motor, 0.05 * motor / 360.0 + wild), RATIO)
    full = replace(data.full, sigma_arcsec=np.where(noisy, 20.0, 0.5))
    estimator = Estimator(data.having(full))
    effects = (*MODEL.effects, RatioError(ramp_arcsec_per_turn=0.1))
    before, after = (estimator.fit(Hypothesis(each, Start.FORWARD)) for each in (MODEL.effects, effects))
    gain = held_out(estimator, before, after)
    assert gain is not None
    assert gain.sure
    assert gain.predicts


def test_a_ripple_that_falls_to_a_fifth_is_a_drift() -> None:
    """Relative to the mean ripple of the record, its change per kelvin is beyond what the effect permits."""
    motor = sweeps(12)
    warmer = np.linspace(4.0, 10.0, len(motor))
    ripple = MODEL.effects[0].predict(Motion(motor), Start.FORWARD)
    made = ideal_record(MODEL, motor, -0.08 * warmer * ripple, temperature_c=20.0 + warmer)
    found = diagnose(made, MODEL)
    assert [each.cause for each in found.findings] == ["amplitude_drift"]
    assert abs(found.findings[0].parameters["ripple_percent_per_k"].value + 8.0) < 1.0


@pytest.mark.parametrize("size_arcsec", [0.6, 1.0])
def test_a_wave_over_the_load_angle_and_a_change_of_the_model_do_not_cancel(size_arcsec: float) -> None:
    """In two poses 18 degrees of the load apart, order 2 differs a little.

    A wave of the flexspline beats with the model's order only over a load turn. Both would have to be several
    times as large to produce this difference.
    """
    near, far = sweeps(4, 1.0), sweeps(4, 1.0, begin_turns=2.5)
    motor = np.concatenate([near, np.linspace(near[-1], far[0], 80), far])
    pose = np.clip(motor / 360.0 - 1.75, -1.0, 1.0)
    found = diagnose(ideal_record(MODEL, motor, size_arcsec * pose * np.cos(np.radians(2.0 * motor))), MODEL)
    assert all(each.peak_arcsec < 1.5 * size_arcsec for each in found.findings), found.verdict()


def test_noise_is_at_most_what_the_model_leaves() -> None:
    """The error alternates from sample to sample, so differences of samples are larger than the error."""
    rng = np.random.default_rng(3)
    motor = np.cumsum(rng.uniform(100.0, 900.0, 400) * np.repeat(rng.choice([-1.0, 1.0], 40), 10))
    found = diagnose(ideal_record(MODEL, motor, (-1.0) ** np.arange(400)), MODEL)
    assert found.noise_floor_arcsec < 1.2 * found.baseline.rms_arcsec


def test_a_changed_order_states_the_order_of_the_flexspline_that_explains_as_much() -> None:
    """Order 2 of the flexspline is order 2.04 of the motor, and the record covers 7 degrees of the load."""
    motor = sweeps(2, 1.0)
    ripple = MODEL.effects[0].predict(Motion(motor), Start.FORWARD)
    (found,) = diagnose(ideal_record(MODEL, motor, 0.4 * ripple), MODEL).findings
    assert found.within, "the model's own order has changed"
    assert {"motor_order", "flexspline_order"} <= {found.cause, *found.aliases}
