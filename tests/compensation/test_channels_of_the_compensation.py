"""Effects that need more than the motor angle: inverted on line, and faded out without their channel."""

import math

import numpy as np
import pytest

from hdbridge.axis.effects import (
    CATALOGUE,
    Channel,
    Compliance,
    Moment,
    Observer,
    Start,
    compensable,
    extended,
    readings,
)
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.compensation import LOSABLE, Compensation, CompensationLimits, Inverse

PERIOD = 0.004
BASE = extended((CATALOGUE["synchronous"].candidate(50.0),), CATALOGUE["hysteresis"].candidate(50.0))
SOFT = Compliance(
    c1_arcsec_per_nm=16, c2_arcsec_per_nm=16, c3_arcsec_per_nm=16, torque1_nm=50, torque2_nm=100
)
LOADED = TransmissionModel(50.0, extended(BASE, SOFT))


def run_with(effect) -> TransmissionModel:
    return TransmissionModel(50.0, extended(BASE, effect))


def moments(loads):
    """Yields the readings of a control loop in motion, with changing torque and temperature."""
    observer = Observer()
    for index, load in enumerate(loads):
        time_s = index * PERIOD
        yield observer.moment(
            50.0 * load,
            time_s,
            measured=readings(
                {
                    Channel.LOAD_TORQUE: 8.0 * math.sin(3.0 * load),
                    Channel.MOTOR_TORQUE: 0.2 * math.cos(2.0 * load),
                    Channel.TEMPERATURE: 25.0 + 2.0 * time_s,
                }
            ),
            load_deg=load,
        )


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_compensable_effect_is_inverted_with_its_channels(name):
    effect = CATALOGUE[name].candidate(50.0, BASE)
    model = run_with(effect)
    if not compensable((effect,)):
        assert len(compensable(model.effects)) == 2
        return
    inverse = Inverse(model)
    gear = TransmissionModel(50.0, compensable(model.effects)).tracker()
    rng = np.random.default_rng(5)
    steps = rng.choice([0.0, 1e-4, 0.01, 0.05], 600) * rng.choice([-1, 1, 1], 600)
    loads = np.cumsum(steps).tolist()
    for load, moment in zip(loads, moments(loads), strict=True):
        if moment.time_s == 0.0:
            inverse.advance(50.0 * load, moment)
            gear.advance(50.0 * load, moment)
            continue
        motor = inverse.solve(load, moment)
        inverse.advance(motor, moment)
        assert abs(3600 * (motor / 50 - load) + gear.advance(motor, moment)) <= 1e-6


def test_missing_channels_of_an_inverse_are_named():
    assert Inverse(TransmissionModel(50.0, BASE)).needs == frozenset()
    assert Compensation(LOADED, CompensationLimits(), PERIOD).needs == {Channel.LOAD_TORQUE}


def engaged(torque_nm: float) -> tuple[Compensation, Moment]:
    compensation = Compensation(LOADED, CompensationLimits(ramp_s=0.5), PERIOD)
    moment = Moment(measured=readings({Channel.LOAD_TORQUE: torque_nm}))
    compensation.reset(0.0, moment)
    compensation.engage()
    for load in np.arange(0.0, 5.0, 10.0 * PERIOD):
        compensation.command(float(load), moment)
    for _ in range(200):
        compensation.command(5.0, moment)
    return compensation, moment


def test_an_effect_fades_out_without_its_channel_and_in_again_with_it():
    compensation, moment = engaged(5.0)
    gear = LOADED.tracker(Start.FORWARD)  # five degrees forward are many times the loop's width
    gear.advance(compensation.command(5.0, moment), moment)
    with_torque = compensation.correction_arcsec
    compensation.set_known_channels(LOSABLE - {Channel.LOAD_TORQUE})
    steps, last = [], with_torque
    for _ in range(200):
        gear.advance(compensation.command(5.0, moment), moment)
        steps.append(abs(compensation.correction_arcsec - last))
        last = compensation.correction_arcsec
    without_torque = compensation.correction_arcsec
    # 80 arcsec in half a second, plus the loop's change on reversal: never more than 3 per cycle.
    assert 0 < max(steps) < 3.0
    assert max(steps[130:]) == 0.0
    assert abs(with_torque - without_torque) > 30
    compensation.set_known_channels(LOSABLE)
    for _ in range(200):
        motor = compensation.command(5.0, moment)
        error = 3600 * (motor / 50 - 5.0) + gear.advance(motor, moment)
    assert abs(error) < 1e-6


def test_without_a_channel_at_the_start_its_effect_starts_faded_out():
    compensation = Compensation(LOADED, CompensationLimits(ramp_s=0.5), PERIOD)
    compensation.set_known_channels(frozenset())
    compensation.reset(0.0)
    compensation.engage()
    for _ in range(200):
        compensation.command(0.0, Moment(measured=readings({Channel.LOAD_TORQUE: 50.0})))
    assert abs(compensation.correction_arcsec) < 40
