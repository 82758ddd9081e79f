"""Model changes in motion: no step, within the limits, ending at the new model."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import (
    Backlash,
    Channel,
    Creep,
    Hysteresis,
    HysteresisMemory,
    Moment,
    MotorOrder,
    Observer,
    Relaxation,
    Synchronous,
)
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import compensation_for
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.switchover import Correction
from hdbridge.enums import Scheme
from hdbridge.errors import InputError

PROFILES = Path(__file__).parents[2] / "profiles"
PERIOD = 0.004
RATIO = 50.0
LIMITS = CompensationLimits(maximum_arcsec=60.0, slew_arcsec_s=2000.0, ramp_s=0.1)
STEP = LIMITS.slew_arcsec_s * PERIOD


def model(amplitude=10.0, offset=30.0, width=15.0, law=Hysteresis, exponent=1.6) -> TransmissionModel:
    orders = tuple(MotorOrder(order=k, amplitude_arcsec=amplitude / k, phase_deg=40.0 * k) for k in (1, 2, 4))
    loop = law(offset_arcsec=offset, width_deg=width, exponent=exponent)
    return TransmissionModel(RATIO, (Synchronous(orders=orders), loop))


models = st.builds(
    model,
    amplitude=st.floats(0, 15),
    offset=st.floats(-10, 50),
    width=st.floats(5, 30),
    law=st.sampled_from([Hysteresis, HysteresisMemory]),
    exponent=st.floats(1.2, 2.8),
)
speeds = st.lists(st.tuples(st.floats(-3, 3), st.integers(1, 60)), min_size=1, max_size=8)
"""Stretches of motion: load degrees per second, and for how many periods."""


def made(its: TransmissionModel, limits: CompensationLimits = LIMITS) -> Compensation:
    compensation = Compensation(its, limits, PERIOD)
    compensation.reset(0.0)
    compensation.engage()
    return compensation


def places(stretches, start: float = 0.0) -> list[float]:
    return (start + PERIOD * np.cumsum([speed for speed, count in stretches for _ in range(count)])).tolist()


@given(models, models, speeds, speeds, st.integers(0, 40))
def test_a_change_is_continuous_and_ends_at_the_new_model(old, new, before, after, held):
    correction, alone = Correction(made(old)), made(new)
    way = places(before)
    for load in way:
        correction.command(load)
        alone.command(load)
    correction.change(Compensation(new, LIMITS, PERIOD))
    assert correction.changing
    last = correction.correction_arcsec
    way = places([*after, (2.0, 120)], way[-1])
    for number, load in enumerate(way):
        missing = held <= number < held + 5
        motor = (correction.hold if missing else correction.command)(load)
        alone.command(load)
        now = correction.correction_arcsec
        assert abs(now - last) <= (0.0 if missing else STEP * (1.0 + 1e-9))
        assert abs(now) <= LIMITS.maximum_arcsec
        assert motor == pytest.approx(RATIO * (load - now / 3600.0), abs=1e-9)
        last = now
    assert not correction.changing
    assert correction.memory_known
    assert correction.model is new
    # Both have travelled beyond their memory, so they are the same model in the same state.
    assert correction.correction_arcsec == pytest.approx(alone.correction_arcsec, abs=2e-6)
    assert correction.predicted_arcsec == pytest.approx(alone.predicted_arcsec, abs=2e-6)


@given(models, speeds)
def test_the_new_model_starts_in_the_state_given_by_the_path(its, way):
    """At rest from the beginning of the change, only the earlier path determines the state."""
    correction, alone = Correction(made(its)), made(its)
    load = 0.0
    for load in places([(2.0, 100), *way]):
        correction.command(load)
        alone.command(load)
    correction.change(Compensation(its, LIMITS, PERIOD))
    for _ in range(40):
        correction.command(load)
        alone.command(load)
    assert not correction.changing
    assert correction.correction_arcsec == pytest.approx(alone.correction_arcsec, abs=2e-6)
    assert correction.memory_known


def test_a_change_takes_the_ramps_time():
    correction = Correction(made(model(offset=10.0)))
    correction.change(Compensation(model(), LIMITS, PERIOD))
    periods = 0
    while correction.changing:
        correction.command(0.0)
        periods += 1
    assert periods == pytest.approx(LIMITS.ramp_s / PERIOD, abs=1)


def test_a_change_during_a_change_and_another_gear_are_refused():
    correction = Correction(made(model()))
    with pytest.raises(InputError, match="ratio 80"):
        correction.change(Compensation(TransmissionModel(80.0), LIMITS, PERIOD))
    correction.change(Compensation(model(), LIMITS, PERIOD))
    with pytest.raises(InputError, match="under way"):
        correction.change(Compensation(model(), LIMITS, PERIOD))


def test_a_smaller_cap_is_reached_within_the_slew():
    tight = CompensationLimits(maximum_arcsec=5.0, slew_arcsec_s=50.0, ramp_s=0.02)
    correction = Correction(made(model(amplitude=0.0)))
    for load in places([(2.0, 100)]):
        correction.command(load)
    last = correction.correction_arcsec
    assert last == pytest.approx(30.0)
    correction.change(Compensation(model(amplitude=0.0), tight, PERIOD))
    while correction.changing:
        correction.command(load)
        assert abs(correction.correction_arcsec - last) <= 50.0 * PERIOD * (1.0 + 1e-9)
        last = correction.correction_arcsec
    assert last == pytest.approx(5.0)


def test_weight_fades_during_a_change():
    correction = Correction(made(model()))
    way = places([(2.0, 200)])
    for load in way[:100]:
        correction.command(load)
    correction.change(Compensation(model(offset=10.0), LIMITS, PERIOD))
    correction.command(way[100])
    correction.disengage()
    for load in way[101:150]:
        correction.command(load)
    assert (correction.weight, correction.correction_arcsec) == (0.0, pytest.approx(0.0, abs=1e-9))
    correction.engage()
    for load in way[150:]:
        correction.command(load)
    assert correction.weight == 1.0


def test_a_reset_ends_a_change_and_forgets_the_path():
    correction = Correction(made(model()))
    for load in places([(2.0, 100)]):
        correction.command(load)
    assert correction.memory_known
    other = Compensation(model(offset=10.0), LIMITS, PERIOD)
    correction.change(other)
    correction.reset(RATIO * load)
    assert not correction.changing
    assert not correction.memory_known
    assert correction.model is other.model
    assert correction.correction_arcsec == 0.0
    correction.command(load)
    assert correction.weight > 0.0


def test_a_model_without_memory_is_known_at_once():
    its = Compensation(Scheme.SYNCHRONOUS.of(model()), LIMITS, PERIOD)
    its.reset(0.0)
    assert its.memory_known
    assert not made(model()).memory_known


def test_a_new_model_with_memory_of_time_starts_now():
    """Creep counts from its first moment; the replayed path must not make it older."""
    creep = Creep(parts=(Relaxation(amplitude_arcsec=20.0, tau_s=1.0),))
    observer = Observer()
    old = Compensation(Scheme.NONE.of(model()), LIMITS, PERIOD)
    correction = Correction(old)

    def moment(load: float, number: int) -> Moment:
        return observer.moment(RATIO * load, 1000.0 + number * PERIOD, load_deg=load)

    correction.reset(0.0, moment(0.0, 0))
    correction.engage()
    way = places([(2.0, 60), (-2.0, 60)])
    for number, load in enumerate(way, 1):
        correction.command(load, moment(load, number))
    correction.change(Compensation(TransmissionModel(RATIO, (creep,)), LIMITS, PERIOD))
    assert Channel.TIME in correction.needs
    load = way[-1]
    for number in range(40):
        load -= 2.0 * PERIOD
        correction.command(load, moment(load, len(way) + 1 + number))
    assert -20.0 * 0.2 < correction.correction_arcsec < -20.0 * 0.1


def test_gently_crossed_backlash_keeps_its_memory():
    gap = Backlash(gap_arcsec=20.0, crossing_deg=0.01)
    its = Compensation(TransmissionModel(RATIO, (gap,)), LIMITS, PERIOD)
    its.reset(0.0)
    its.command(0.1 / RATIO)
    assert not its.memory_known
    its.command(1.0 / RATIO)
    assert its.memory_known


def bundled() -> list[Path]:
    return sorted(
        path.parent for path in PROFILES.rglob("axis.yaml") if path.with_name("model.yaml").exists()
    )


@pytest.mark.parametrize("folder", bundled(), ids=lambda each: each.name)
def test_compensation_can_be_pickled(folder):
    """The service creates the compensation, and the control loop receives it."""
    axis = AxisConfig.load(folder / "axis.yaml")
    whole = TransmissionModel.load(folder / "model.yaml")
    for scheme in Scheme.offered_by(whole):
        compensation = compensation_for(axis, scheme.of(whole))
        sent = pickle.loads(pickle.dumps(compensation, protocol=pickle.HIGHEST_PROTOCOL))
        for each in (compensation, sent):
            each.reset(0.0)
            each.engage()
        for load in places([(3.0, 50), (-2.0, 80)]):
            assert sent.command(load) == compensation.command(load)
        assert (sent.needs, sent.model.ratio) == (compensation.needs, compensation.model.ratio)
