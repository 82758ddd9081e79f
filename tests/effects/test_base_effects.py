"""The synchronous part and the plain elastic loop: the two parts of the article's model."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.axis.effects import (
    Hysteresis,
    HysteresisMemory,
    Moment,
    Motion,
    Start,
)
from hdbridge.axis.effects.orders import waves

loops = st.builds(
    Hysteresis,
    offset_arcsec=st.floats(0, 80),
    width_deg=st.floats(1, 60),
    exponent=st.one_of(st.floats(1.05, 3.0), st.just(2.0), st.just(2.0 + 1e-9)),
)
steps = st.lists(
    st.one_of(st.sampled_from([0.0, 1e-6, -1e-6]), st.floats(-30, 30, allow_subnormal=False)),
    min_size=1,
    max_size=60,
)
paths = st.builds(lambda first, rest: np.cumsum(np.array([first, *rest])), st.floats(-2000, 2000), steps)
starts = st.sampled_from(list(Start))


@given(st.lists(st.one_of(st.integers(0, 200), st.floats(0.01, 10.0)), max_size=8), st.floats(-1e4, 1e4))
def test_waves_of_any_order_are_its_cosine_and_sine(numbers, first_rad):
    angle_rad = first_rad + np.linspace(0.0, 10.0, 50)
    for number, wave in zip(numbers, waves(angle_rad, numbers), strict=True):
        # An angle of 2e6 rad has 2e6 * 1e-16 rad of rounding.
        assert wave == pytest.approx(np.exp(1j * number * angle_rad), abs=1e-8)


ARTICLE = Hysteresis(offset_arcsec=40, width_deg=20, exponent=1.6)


def test_loops_wider_than_the_width_reach_the_offset_and_narrow_ones_have_the_height_of_the_law():
    time = np.linspace(0, 2, 4001)
    for amplitude, height in [(180, 80.0), (45, 80.0), (5, 80 * (0.5**0.6 - 0.6 * 0.5) / 0.4)]:
        error = ARTICLE.predict(Motion(amplitude * np.cos(2 * np.pi * time)), Start.FORWARD)
        assert np.ptp(error[2000:]) == pytest.approx(height, abs=1e-6)


@given(effect=loops, path=paths, start=starts)
def test_error_is_continuous_also_at_reversals(effect, path, start):
    """A step of 1e-9 deg anywhere, in either direction, changes the error as predicted by the law."""
    tracker = effect.tracker(start)
    for angle in path:
        before = tracker.advance(float(angle), Moment())
        for nudge in (1e-9, -1e-9):
            after = tracker.peek(float(angle) + nudge, Moment())
            most = 4 * effect.offset_arcsec * rise_of(4e-9 / effect.width_deg, effect.exponent)
            assert abs(after - before) <= most + 1e-9


def rise_of(xi: float, n: float) -> float:
    """g as the literature writes it, for comparison."""
    return xi * (1 - math.log(xi)) if abs(n - 2) < 1e-6 else (xi ** (n - 1) - (n - 1) * xi) / (2 - n)


def test_exponent_two_is_the_limit_of_its_neighbours():
    path = np.array([0.0, 30.0, 27.0, 20.0, 28.0, 35.0])
    at_two = Hysteresis(offset_arcsec=40, width_deg=20, exponent=2.0).predict(Motion(path))
    for exponent in (2 - 1e-7, 2 + 1e-7, 2 - 1e-12, 2 + 1e-15):
        near = Hysteresis(offset_arcsec=40, width_deg=20, exponent=exponent).predict(Motion(path))
        np.testing.assert_allclose(near, at_two, atol=1e-4)
    assert at_two[2] == pytest.approx(40 - 80 * 0.15 * (1 - math.log(0.15)))


def test_law_follows_the_formula_between_reversals():
    path = np.array([0.0, 50.0, 48.0, 45.0, 40.0, 29.0])
    error = ARTICLE.predict(Motion(path))
    expected = [0.0, 40.0, *[40 - 80 * rise_of(min(d / 20, 1.0), 1.6) for d in (2, 5, 10, 21)]]
    np.testing.assert_allclose(error, expected, atol=1e-9)


def test_direction_holds_at_rest():
    moving = np.array([0.0, 10.0, 12.0, 9.0, 8.0, 5.0])
    with_rests = np.repeat(moving, 3)
    np.testing.assert_array_equal(
        ARTICLE.predict(Motion(with_rests)), np.repeat(ARTICLE.predict(Motion(moving)), 3)
    )


def test_the_start_value_is_used():
    ahead = np.array([0.0, 1.0, 9.9, 10.0, 15.0])
    virgin = ARTICLE.predict(Motion(ahead))
    assert virgin[0] == 0
    assert virgin[2] < 40
    assert virgin[3] == pytest.approx(40)
    np.testing.assert_allclose(ARTICLE.predict(Motion(ahead), Start.FORWARD), 40.0)
    backward = ARTICLE.predict(Motion(ahead), Start.BACKWARD)
    assert backward[0] == -40
    assert all(b > a for a, b in pairwise(backward))


@pytest.mark.parametrize("law", [Hysteresis, HysteresisMemory])
@given(
    size=st.floats(1, 80),
    width=st.floats(2, 40),
    n=st.floats(1.1, 3.0),
    reach=st.floats(1.05, 4.0),
    start=st.sampled_from(list(Start)),
)
def test_a_lagging_load_mirrors_a_leading_one(law, size, width, n, reach, start):
    once = reach * width * np.sin(np.linspace(0.0, 2.0 * np.pi, 401))
    motion = Motion(np.tile(once[:-1], 3))
    leads, lags = (law(offset_arcsec=sign * size, width_deg=width, exponent=n) for sign in (1, -1))
    error = lags.predict(motion, start)
    np.testing.assert_array_equal(error, -leads.predict(motion, start))
    np.testing.assert_allclose(error[400:800], error[800:], atol=1e-9)
    forward = np.diff(motion.motor_deg[400:]) > 0
    assert np.all(np.diff(error[400:])[forward] <= 1e-9)  # the error decreases along the path
