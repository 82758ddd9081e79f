"""Return-point memory: its figures, and the equivalent sum of stop operators."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.axis.effects import Hysteresis, HysteresisMemory, Moment, Motion, Start
from hdbridge.axis.effects.elastic_loop import rise

GEAR = {"offset_arcsec": 40.0, "width_deg": 20.0, "exponent": 1.6}
PLAIN, MEMORY = Hysteresis(**GEAR), HysteresisMemory(**GEAR)


def finely(*turns):
    """Returns a path through these angles in steps of 1/500 of each leg."""
    legs = [np.linspace(a, b, 500, endpoint=False) for a, b in pairwise(turns)]
    return Motion(np.concatenate([*legs, turns[-1:]]))


def test_one_small_back_step_sets_the_laws_ten_arcsec_apart():
    path = finely(0.0, -50.0, -45.0, -47.0, -30.0)
    apart = np.abs(MEMORY.predict(path) - PLAIN.predict(path))
    assert apart.max() == pytest.approx(10.1, abs=0.05)


@given(
    shares=st.lists(st.floats(0.01, 0.99), min_size=1, max_size=6),
    first=st.floats(0.5, 15.0),
    beyond=st.floats(0.0, 10.0),
)
@settings(deadline=None)
def test_excursions_that_are_undone_are_forgotten(shares, first, beyond):
    excursions = [angle for share in shares for angle in (first * (1 - share), first)]
    tail = [first + beyond, first + beyond + 1.0]
    with_them = MEMORY.predict(
        Motion(np.array([0.0, -50.0, -50.0 + first, *[-50.0 + a for a in excursions + tail]]))
    )
    without = MEMORY.predict(Motion(np.array([0.0, -50.0, -50.0 + first, *[-50.0 + a for a in tail]])))
    np.testing.assert_allclose(with_them[-2:], without[-2:], atol=1e-6)


# Small steps stay within the width and fill the memory; large ones erase it.
grid_steps = st.one_of(st.integers(-4, 4), st.integers(-4, 4), st.integers(-30, 30))


@given(path=st.lists(grid_steps, min_size=1, max_size=40), start=st.sampled_from(list(Start)))
@settings(deadline=None)
def test_the_law_is_a_sum_of_stop_operators(path, start):
    """With stops at multiples of a grid the sum is exact for paths on (twice) that grid, whatever the law."""
    grid = GEAR["width_deg"] / 40
    thresholds = grid * np.arange(1, 21)
    virgin = rise(2.0 * np.arange(22) * grid / GEAR["width_deg"], GEAR["exponent"])
    weights = -np.diff(virgin, 2) / grid
    stops = start.value * thresholds
    angle, expected = 0.0, []
    for step in path:
        moved = 2 * grid * step
        stops = np.clip(stops + moved, -thresholds, thresholds)
        angle += moved
        expected.append(GEAR["offset_arcsec"] * float(weights @ stops))
    angles = 2 * grid * np.cumsum([0, *path])
    np.testing.assert_allclose(MEMORY.predict(Motion(angles), start)[1:], expected, atol=1e-8)


def test_hundreds_of_nested_loops_are_followed_without_a_jump():
    """Beyond the capacity for loops, the innermost ones are merged, with an error below their own height."""
    tracker = MEMORY.tracker(Start.FORWARD)
    turns = [(-1) ** i * 9.0 * (1 - i / 700) for i in range(600)]
    for angle in turns:
        tracker.advance(angle, Moment())
    out = np.linspace(turns[-1], turns[-1] + 12.0, 4000)
    errors = [tracker.advance(float(angle), Moment()) for angle in out]
    rises = np.diff(errors)
    assert rises.min() > -0.5
    assert errors[-1] == pytest.approx(40.0, abs=1e-9)
