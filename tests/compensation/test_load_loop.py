"""Laws of the slow loop over the load encoder, on a load that is one number."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.control.loadloop import LoadLoop
from hdbridge.errors import InputError

PERIOD_S = 0.004
MAXIMUM, SLEW = 40.0, 100.0
errors = st.none() | st.floats(-60, 60) | st.floats()


def loop(gain: float = 1.0) -> LoadLoop:
    return LoadLoop(gain, MAXIMUM, SLEW, PERIOD_S)


def at_rest(its: LoadLoop, offset: float, seconds: float) -> float:
    """A load that is off by this much and follows what is added; what is left of the error."""
    for _ in range(round(seconds / PERIOD_S)):
        its.step(offset - its.value_arcsec, moving=False)
    return offset - its.value_arcsec


@given(st.lists(st.tuples(errors, st.booleans(), st.integers(1, 200)), max_size=20))
def test_it_is_bounded_and_never_steps_whatever_it_is_told(told):
    its = loop(gain=5.0)
    value = 0.0
    for error, moving, periods in told:
        for _ in range(periods):
            last, value = value, its.step(error, moving)
            assert abs(value) <= MAXIMUM
            assert abs(value - last) <= SLEW * PERIOD_S * (1.0 + 1e-9)


@given(st.floats(-35, 35), st.floats(0.2, 5.0))
def test_at_rest_it_takes_the_mean_error_away(offset, gain):
    its = loop(gain)
    left = at_rest(its, offset, 1.0 + 10.0 / gain)
    assert abs(left) <= 1e-3 * abs(offset) + 1e-9
    assert not its.doubted


def test_in_motion_it_holds():
    its = loop()
    at_rest(its, 20.0, 3.0)
    held = its.value_arcsec
    assert {its.step(error, moving=True) for error in (500.0, -20.0, math.inf)} == {held}


@given(st.floats(-35, 35))
def test_it_fades_out_where_the_encoder_is_not_believed_and_comes_back(offset):
    its = loop()
    at_rest(its, offset, 3.0)
    for _ in range(round(MAXIMUM / SLEW / PERIOD_S)):
        its.step(None, moving=False)
    assert its.value_arcsec == 0.0
    assert abs(at_rest(its, offset, 12.0)) <= 1e-3 * abs(offset) + 1e-9


def test_at_its_bound_it_does_not_wind_up():
    its = loop(gain=5.0)
    its.reset(32.0)
    at_rest(its, 60.0, 20.0)
    assert its.value_arcsec == MAXIMUM
    its.step(59.0 - MAXIMUM, moving=False)
    assert its.value_arcsec == MAXIMUM
    its.step(-1.0, moving=True)
    for _ in range(200):
        its.step(-1.0, moving=False)
    assert its.value_arcsec < MAXIMUM


@given(st.floats(-35, 35))
def test_a_frozen_encoder_gets_no_more_than_a_quarter_and_then_nothing(shown):
    its = loop(gain=5.0)
    values = [abs(its.step(shown, moving=False)) for _ in range(5000)]
    assert max(values) <= 0.25 * MAXIMUM + SLEW * PERIOD_S
    assert values[-1] == 0.0 or max(values) <= 0.25 * MAXIMUM
    if abs(shown) > 0.1:
        assert its.doubted


@given(st.floats(-20, 20), st.floats(14, 1000), st.sampled_from([-1, 1]))
def test_an_encoder_that_jumps_at_rest_is_not_followed(offset, size, sign):
    its = loop()
    at_rest(its, offset, 2.0)
    before = its.value_arcsec
    for _ in range(1000):
        value = its.step(offset + sign * size - its.value_arcsec, moving=False)
        assert min(before, 0.0) <= value <= max(before, 0.0)
    assert value == 0.0


def test_an_encoder_once_doubted_is_believed_again_only_after_a_reset():
    its = loop(gain=5.0)
    for _ in range(5000):
        its.step(15.0, moving=False)
    assert its.doubted
    its.step(5.0, moving=True)
    assert at_rest(its, 5.0, 6.0) == 5.0
    its.reset()
    assert not its.doubted
    assert abs(at_rest(its, 5.0, 6.0)) < 0.01


def test_an_error_beyond_its_bound_is_none_of_its_own():
    its = loop()
    at_rest(its, 20.0, 3.0)
    its.step(0.0, moving=True)
    for _ in range(1000):
        its.step(61.0 - its.value_arcsec, moving=False)
    assert (its.value_arcsec, its.doubted) == (0.0, False)
    its.step(0.0, moving=True)
    assert abs(at_rest(its, 20.0, 10.0)) < 0.01


@pytest.mark.parametrize("value", [-12.0, 0.0, 39.0])
def test_a_reset_goes_on_from_where_it_was(value):
    its = loop()
    its.reset(value)
    assert its.step(3.0, moving=False) == value


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0.0, 1.0, 1.0, 1.0), "gain_1_s is 0.0"),
        ((1.0, math.nan, 1.0, 1.0), "maximum_arcsec"),
        ((1.0, 1.0, math.inf, 1.0), "slew_arcsec_s"),
        ((1.0, 1.0, 1.0, -1.0), "period_s"),
        ((6.0, 1.0, 1.0, 1.0), "at most 5"),
    ],
)
def test_numbers_that_make_no_loop_are_refused(numbers, message):
    with pytest.raises(InputError, match=message):
        LoadLoop(*numbers)
    with pytest.raises(InputError, match="finite"):
        loop().reset(math.nan)
