"""The compensation inverts the model, and never jumps the axis."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.axis.effects import (
    Backlash,
    Hysteresis,
    HysteresisMemory,
    Moment,
    MotorOrder,
    Start,
    Synchronous,
    Wear,
)
from hdbridge.axis.effects.elastic_loop import rise_at
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.compensation import Compensation, CompensationLimits, Inverse
from hdbridge.errors import InputError

NOW = Moment()
PERIOD = 0.004


def model(ratio=50.0, amplitude=12.0, offset=40.0, width=20.0, exponent=1.6) -> TransmissionModel:
    orders = tuple(
        MotorOrder(order=k, amplitude_arcsec=amplitude / k, phase_deg=40.0 * k) for k in (1, 2, 4, 8)
    )
    loop = Hysteresis(offset_arcsec=offset, width_deg=width, exponent=exponent)
    return TransmissionModel(ratio, (Synchronous(orders=orders), loop))


def models() -> st.SearchStrategy[TransmissionModel]:
    return st.builds(
        model,
        ratio=st.floats(30, 160),
        amplitude=st.floats(0, 15),
        offset=st.floats(0, 80),
        width=st.floats(5, 40),
        exponent=st.floats(1.2, 2.8),
    )


# Reversals of every size: from far below an encoder count to several times the width.
load_paths = st.lists(
    st.tuples(st.sampled_from([-1, 1]), st.floats(-6, 0.3)).map(lambda each: each[0] * 10 ** each[1]),
    min_size=1,
    max_size=80,
).map(lambda steps: np.cumsum(steps).tolist())


@settings(deadline=None)
@given(model=models(), path=load_paths, start=st.sampled_from(list(Start)))
def test_inverse_is_exact(model, path, start):
    inverse, gear = Inverse(model, start), model.tracker(start)
    inverse.advance(0.0)
    gear.advance(0.0, NOW)
    for load_deg in path:
        motor_deg = inverse.solve(load_deg)
        inverse.advance(motor_deg)
        reached = motor_deg / model.ratio + gear.advance(motor_deg, NOW) / 3600
        # 1e-6 arcsec, or two bits of the motor angle if the law is so steep that two bits are coarser.
        loop = model.effects[1]
        bits = 2 * loop.offset_arcsec * rise_at(2 * math.ulp(motor_deg) / loop.width_deg, loop.exponent)
        assert abs(reached - load_deg) * 3600 <= max(1e-6, 2 * bits)


def test_solving_has_no_side_effects():
    inverse = Inverse(model())
    inverse.advance(0.0)
    motor = inverse.solve(0.3)
    assert inverse.solve(-5.0) != motor
    assert inverse.solve(0.3) == motor
    inverse.advance(motor)
    assert [inverse.solve(0.3) for _ in range(5)] == [motor] * 5


def test_a_model_too_steep_to_invert_is_refused():
    steep = TransmissionModel(
        50.0, (Synchronous(orders=(MotorOrder(order=100, amplitude_arcsec=60, phase_deg=0),)),)
    )
    with pytest.raises(InputError, match=r"fall by 105 arcsec per motor degree.*check the amplitudes"):
        Inverse(steep)


PLAY = {
    "narrower than it can be": (Backlash(gap_arcsec=20, crossing_deg=0.02),),
    "growing": (Wear(growth_arcsec_per_kiloturn=-100, width_deg=0.05, exponent=0.7, turns_before=40),),
    "both": (
        Backlash(gap_arcsec=6, crossing_deg=0.02),
        Wear(growth_arcsec_per_kiloturn=-100, width_deg=0.05, turns_before=40),
    ),
}


@pytest.mark.parametrize("play", PLAY.values(), ids=PLAY)
def test_backlash_is_compensated_past_the_crossing(play):
    bare = model()
    worn = TransmissionModel(bare.ratio, (*bare.effects, *play))
    inverse, gear = Inverse(worn, Start.FORWARD), worn.tracker(Start.FORWARD)
    inverse.advance(0.0)
    gear.advance(0.0, NOW)
    for load_deg in (1.0, 8.0, 7.0, 7.5, -3.0, -2.9, 4.0):
        motor_deg = inverse.solve(load_deg)
        inverse.advance(motor_deg)
        assert motor_deg / 50.0 + gear.advance(motor_deg, NOW) / 3600 == pytest.approx(load_deg, abs=1e-8)


lagging = st.builds(
    lambda law, **shape: TransmissionModel(50.0, (law(**shape),)),
    law=st.sampled_from([Hysteresis, HysteresisMemory]),
    offset_arcsec=st.floats(-80, -1),
    width_deg=st.floats(0.2, 40),
    exponent=st.floats(1.1, 3.0),
)


@settings(deadline=None)
@given(model=lagging, path=load_paths, start=st.sampled_from(list(Start)))
def test_inverse_of_a_lagging_load_never_reverses(model, path, start):
    """The inverse limits a law that is steeper than the gear to the steepest possible slope."""
    (loop,) = model.effects
    steepest = 0.9 * 3600.0 / model.ratio
    steep = loop.slope_bound_arcsec_per_deg() > steepest
    inverse = Inverse(model, start)
    gear = loop.gentle_tracker(start, 0.9 * steepest) if steep else model.tracker(start)
    inverse.advance(0.0)
    last_deg, last_load_deg = 0.0, gear.advance(0.0, NOW) / 3600
    for load_deg in path:
        motor_deg = inverse.solve(load_deg)
        inverse.advance(motor_deg)
        reached = motor_deg / model.ratio + gear.advance(motor_deg, NOW) / 3600
        assert abs(reached - load_deg) * 3600 <= 1e-6
        if abs(load_deg - last_load_deg) > 1e-6:
            # Against friction the motor travels further than the load, and never reverses.
            ahead = (motor_deg - last_deg) / (load_deg - last_load_deg)
            assert ahead >= 0.99 * model.ratio
        last_deg, last_load_deg = motor_deg, load_deg


def test_within_the_backlash_the_motor_never_reverses():
    inverse = Inverse(TransmissionModel(50.0, PLAY["growing"]), Start.FORWARD)
    inverse.advance(0.0)
    path = [inverse.solve(0.1)]
    inverse.advance(path[0])
    for back in range(1, 40):
        path.append(inverse.solve(0.1 - 1e-4 * back))
        inverse.advance(path[-1])
    steps = -np.diff(path)
    assert np.all(steps > 0.0)
    # The motor takes up the lost motion on either side, then continues at the commanded rate.
    assert steps[0] > 3 * 50e-4
    assert steps[-1] == pytest.approx(50e-4, rel=1e-3)


def travel(seconds: float, speed_deg_s: float = 10.0) -> list[float]:
    return [speed_deg_s * PERIOD * i for i in range(round(seconds / PERIOD))]


def test_disengaged_compensation_gives_the_plain_gear():
    compensation = Compensation(model(), CompensationLimits(), PERIOD)
    compensation.reset(0.0)
    for load in travel(1.0):
        assert compensation.command(load) == pytest.approx(50 * load, abs=1e-9)


def test_engaged_compensation_puts_the_load_on_target():
    gear_model = model()
    compensation = Compensation(gear_model, CompensationLimits(), PERIOD)
    gear = gear_model.tracker()
    compensation.reset(0.0)
    gear.advance(0.0, NOW)
    compensation.engage()
    for index, load in enumerate(travel(2.0)):
        motor = compensation.command(load)
        error = 3600 * (motor / 50 - load) + gear.advance(motor, NOW)
        if index * PERIOD > 0.6:
            assert abs(error) < 1e-6
    assert compensation.weight == 1.0


@pytest.mark.parametrize("on", [True, False])
def test_switching_at_rest_moves_the_axis_only_along_the_ramp(on):
    limits = CompensationLimits(ramp_s=0.5)
    compensation = Compensation(model(), limits, PERIOD)
    compensation.reset(0.0)
    if not on:
        compensation.engage()
    for load in travel(2.0):
        last = compensation.command(load)
    (compensation.engage if on else compensation.disengage)()
    moved = []
    for _ in range(200):
        motor = compensation.command(load)
        moved.append(abs(motor - last) / 50 * 3600)
        last = motor
    assert max(moved) < 3.0, "arcsec in one cycle"
    assert compensation.weight == (1.0 if on else 0.0)
    assert (
        abs(compensation.correction_arcsec) > 10 if on else compensation.correction_arcsec == pytest.approx(0)
    )


def there_and_back(limits):
    """Yields compensation, load target and motor target of each cycle of a motion there and back."""
    compensation = Compensation(model(), limits, PERIOD)
    compensation.reset(0.0)
    compensation.engage()
    there = travel(2.0)
    for load in there + there[::-1]:
        yield compensation, load, compensation.command(load)


@pytest.mark.parametrize(
    "limits", [CompensationLimits(slew_arcsec_s=500.0), CompensationLimits(maximum_arcsec=8.0, ramp_s=0.0)]
)
def test_the_motor_target_contains_the_limited_correction(limits):
    before = 0.0
    for compensation, load, motor in there_and_back(limits):
        correction = 3600.0 * (load - motor / 50.0)
        assert correction == pytest.approx(compensation.correction_arcsec, abs=1e-6)
        assert abs(correction) <= limits.maximum_arcsec + 1e-6
        assert abs(correction - before) <= limits.slew_arcsec_s * PERIOD + 1e-6
        before = correction
    assert compensation.limited > 0


def test_reset_begins_without_a_correction_wherever_the_motor_stands():
    compensation = Compensation(model(), CompensationLimits(), PERIOD)
    compensation.reset(1234.5)
    compensation.engage()
    first = compensation.command(1234.5 / 50)
    assert abs(first - 1234.5) < 0.05
