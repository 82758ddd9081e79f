"""Laws of the slow loop around the load encoder, on a load that follows its motor with one offset."""

import math
from dataclasses import dataclass, field
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis.effects import Hysteresis, HysteresisMemory
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.loadloop import LoadLoop, loop_width_arcsec
from hdbridge.errors import InputError

PERIOD_S = 0.004
MAXIMUM, SLEW = 40.0, 100.0
COUNT = 0.5
numbers = st.floats(-60, 60) | st.floats()
lags = st.floats(-35, 35)
signs = st.sampled_from([-1, 1])


def loop(gain: float = 1.0, counts: float = COUNT, maximum: float = MAXIMUM, slew: float = SLEW) -> LoadLoop:
    return LoadLoop(gain, maximum, slew, PERIOD_S, counts_arcsec=counts)


@dataclass
class Plant:
    """A motor of whole counts, a load that lags it by ``lag``, and an encoder with noise that may jump."""

    its: LoadLoop
    lag: float = 0.0
    noise: float = 0.0
    count: float = 0.0
    target: float = 0.0
    jump: float = 0.0
    frozen: float | None = None
    random: Random = field(default_factory=lambda: Random(1))

    def step(self, moving: bool = False) -> float:
        """One period with a motor that follows at once."""
        motor = self.target + self.its.value_arcsec
        if self.count:
            motor = self.count * round(motor / self.count)
        load = motor - self.lag + self.jump + self.noise * self.random.gauss(0.0, 1.0)
        if self.frozen is not None:
            load = self.frozen
        return self.its.step(self.target, load, motor, moving)

    def rest(self, seconds: float) -> float:
        """Rests; returns the true error at the end."""
        for _ in range(round(seconds / PERIOD_S)):
            self.step()
        return self.lag - self.its.value_arcsec

    def move(self, target: float, seconds: float = 1.0) -> float:
        """Moves to an angle and rests there."""
        self.target = target
        self.step(moving=True)
        return self.rest(seconds)

    def freeze(self) -> None:
        self.frozen = self.target + self.its.value_arcsec - self.lag


# ---------------------------------------------------------------- the correction


@given(
    st.lists(
        st.tuples(numbers, st.none() | numbers, numbers, st.booleans(), st.integers(1, 200)), max_size=20
    )
)
def test_value_is_bounded_and_continuous_for_any_input(inputs):
    its = loop(gain=5.0)
    value = 0.0
    for target, load, motor, moving, periods in inputs:
        if not math.isfinite(target):
            continue
        for _ in range(periods):
            last, value = value, its.step(target, load, motor, moving)
            assert abs(value) <= MAXIMUM
            assert abs(value - last) <= SLEW * PERIOD_S * (1.0 + 1e-9)


@given(lags, st.floats(0.2, 5.0))
def test_mean_error_at_rest_is_removed(lag, gain):
    plant = Plant(loop(gain), lag)
    assert abs(plant.rest(1.0 + 10.0 / gain)) <= 1e-3 * abs(lag) + 1e-9
    assert not plant.its.doubt


def test_value_is_held_in_motion():
    plant = Plant(loop(), 20.0)
    plant.rest(3.0)
    held = plant.its.value_arcsec
    assert {plant.its.step(0.0, load, 0.0, moving=True) for load in (500.0, -20.0)} == {held}


@given(lags)
def test_value_fades_out_without_a_reading_and_returns(lag):
    plant = Plant(loop(), lag)
    plant.rest(3.0)
    for _ in range(round(MAXIMUM / SLEW / PERIOD_S) + 1):
        plant.its.step(0.0, None, 0.0, moving=False)
    assert plant.its.value_arcsec == 0.0
    assert abs(plant.rest(12.0)) <= 1e-3 * abs(lag) + 1e-9


@given(st.floats(41, 79), signs)
def test_no_wind_up_at_the_bound(lag, sign):
    plant = Plant(loop(gain=5.0), sign * lag)
    plant.rest(5.0)
    assert plant.its.value_arcsec == sign * MAXIMUM
    plant.lag = sign * 39.0
    plant.move(100.0)
    assert abs(plant.its.value_arcsec) < MAXIMUM
    assert plant.its.doubt == ""


@pytest.mark.parametrize("value", [-12.0, 0.0, 39.0])
def test_a_reset_continues_from_its_value(value):
    its = loop()
    its.reset(value)
    assert its.step(3.0, 0.0, 0.0, moving=False) == value


# ---------------------------------------------------------------- doubt about the load encoder


@given(
    lag=st.floats(-30, 30),
    noise=st.floats(0, 3),
    count=st.floats(0.01, 10.0),
    moves=st.lists(st.tuples(st.floats(-500, 500), st.floats(-3, 3)), max_size=6),
    seed=st.integers(0, 1000),
)
def test_motor_counts_noise_and_reversals_are_not_faults(lag, noise, count, moves, seed):
    its = loop(gain=0.5, counts=count + 0.1, maximum=20.0, slew=20.0)
    plant = Plant(its, lag, noise, count, random=Random(seed))
    plant.rest(4.0)
    assert its.doubt == ""
    for target, change in moves:
        plant.lag = lag + change  # the model error differs at every angle
        plant.move(target, 2.0)
        assert its.doubt == ""


@given(st.floats(-20, 20), st.floats(2.0, 1000), signs)
def test_an_encoder_moving_at_rest_is_ignored_until_it_returns(lag, size, sign):
    plant = Plant(loop(), lag)
    plant.rest(2.0)
    before = plant.its.value_arcsec
    plant.jump = sign * size * COUNT
    for _ in range(1000):
        value = plant.step()
        assert min(before, 0.0) <= value <= max(before, 0.0)
    assert value == 0.0
    assert "moved by" in plant.its.doubt
    plant.jump = 0.0
    assert abs(plant.rest(12.0)) < 0.1
    assert plant.its.doubt == ""


@given(st.floats(0.1, 3.0), st.integers(0, 1000), signs)
def test_a_jump_is_detected_in_noise_and_the_doubt_ends_with_it(noise, seed, sign):
    plant = Plant(loop(), 10.0, noise, random=Random(seed))
    plant.rest(4.0)
    plant.jump = sign * 30.0 * noise
    plant.rest(2.0)
    assert "moved by" in plant.its.doubt
    plant.jump = 0.0
    plant.rest(2.0)
    assert plant.its.doubt == ""


def test_each_further_doubt_doubles_the_observation_time():
    plant = Plant(loop(), 10.0)
    plant.rest(2.0)
    waits = []
    for _ in range(4):
        plant.jump = 20.0
        plant.rest(0.5)
        plant.jump = 0.0
        periods = 0
        while plant.its.doubt:
            plant.step()
            periods += 1
        waits.append(periods * PERIOD_S)
        plant.rest(1.0)
    assert waits == pytest.approx([1.0, 2.0, 4.0, 8.0], abs=0.02)


SMALL = TransmissionModel(100.0, (Hysteresis(offset_arcsec=1.0, width_deg=3.0, exponent=1.6),))
"""A gear with 2 arcsec of hysteresis."""


@given(st.floats(6, 20), signs)
def test_a_frozen_encoder_is_detected_by_motor_motion(shown, sign):
    its = loop(gain=2.0)
    its.use_models(SMALL, TransmissionModel(100.0))
    plant = Plant(its, sign * shown)
    plant.frozen = -sign * shown
    most = max(abs(plant.step()) for _ in range(3000))
    assert most <= 2.0 * (2.0 + COUNT)
    assert "lags the motor" in its.doubt
    assert its.value_arcsec == 0.0


def test_a_recovered_encoder_is_trusted_after_motion_in_both_directions():
    plant = Plant(loop(gain=2.0, maximum=20.0), 10.0)
    plant.its.use_models(SMALL, SMALL)
    plant.frozen = -10.0
    plant.rest(3.0)
    assert "lags the motor" in plant.its.doubt
    for target in (3000.0, 10.0, 0.0, 7.0, 100.0, 70.0, 0.0, 3000.0, 2990.0):
        plant.move(target)
        assert plant.its.doubt
        assert plant.its.value_arcsec == 0.0
    plant.frozen = None
    plant.move(6000.0)
    assert plant.its.doubt
    assert abs(plant.move(2000.0, 8.0)) < 0.1
    assert plant.its.doubt == ""


def test_an_excessive_error_is_not_corrected_but_reported():
    plant = Plant(loop(), 20.0)
    plant.rest(3.0)
    plant.lag = 85.0
    plant.move(100.0, 2.0)
    assert plant.its.value_arcsec == 0.0
    assert "is 85.0 arcsec without the loop, which adds at most 40" in plant.its.doubt
    plant.lag = 20.0
    assert abs(plant.move(200.0, 12.0)) < 0.01
    assert plant.its.doubt == ""


def test_a_slow_drift_is_followed():
    plant = Plant(loop(gain=1.0), 0.0, noise=0.1)
    plant.its.use_models(SMALL, SMALL)
    for _ in range(30):
        plant.lag += 0.05
        plant.rest(20.0)
        assert plant.its.doubt == ""
    assert abs(plant.lag - plant.its.value_arcsec) < 1.0


def test_switching_on_again_ends_a_doubt():
    plant = Plant(loop(), 10.0)
    plant.rest(2.0)
    plant.jump = 5.0
    plant.rest(1.0)
    assert plant.its.doubt
    plant.its.reset()
    assert plant.its.doubt == ""


# ---------------------------------------------------------------- parameters from the model


@pytest.mark.parametrize("law", [Hysteresis, HysteresisMemory])
def test_the_width_of_a_loop_is_twice_its_offset(law):
    model = TransmissionModel(100.0, (law(offset_arcsec=-12.5, width_deg=20.0, exponent=1.6),))
    assert loop_width_arcsec(model) == pytest.approx(25.0)
    assert loop_width_arcsec(TransmissionModel(100.0)) == 0.0


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0.0, 1.0, 1.0, 1.0, 1.0), "gain_1_s is 0.0"),
        ((1.0, math.nan, 1.0, 1.0, 1.0), "maximum_arcsec"),
        ((1.0, 1.0, math.inf, 1.0, 1.0), "slew_arcsec_s"),
        ((1.0, 1.0, 1.0, -1.0, 1.0), "period_s"),
        ((1.0, 1.0, 1.0, 1.0, 0.0), "counts_arcsec"),
        ((6.0, 1.0, 1.0, 1.0, 1.0), "at most 5"),
    ],
)
def test_invalid_settings_are_refused(numbers, message):
    *first, counts = numbers
    with pytest.raises(InputError, match=message):
        LoadLoop(*first, counts_arcsec=counts)
    with pytest.raises(InputError, match="finite"):
        loop().reset(math.nan)
