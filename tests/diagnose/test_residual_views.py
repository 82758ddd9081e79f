"""Tests of the views of the residual: its dependence on each coordinate."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.analysis.views import ResidualViews, folds, predicted
from hdbridge.axis.effects import Motion
from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.coordinate import SMALLEST_TIME_S, SMALLEST_WAY_DEG, Coordinate, Spacing
from hdbridge.report.residuals import binned

COUNT = 8000
TIME_S = np.arange(COUNT) * 0.1
LOAD_DEG = np.abs(np.mod(TIME_S, 80.0) - 40.0) * 9.0
DIRECTION = np.where(np.mod(TIME_S, 80.0) >= 40.0, 1.0, -1.0)
RNG = np.random.default_rng(3)


def seen(given_arcsec):
    found = (
        Coordinate("load angle", "deg", LOAD_DEG, both_ways=True),
        Coordinate("direction", "", DIRECTION, bins=2),
        Coordinate("speed", "deg/s", RNG.normal(size=COUNT), spacing=Spacing.FILLED, bins=40),
        Coordinate("time", "s", TIME_S, bins=100),
    )
    noise = RNG.normal(size=COUNT)
    return ResidualViews(given_arcsec, noise, DIRECTION, TIME_S, {each.name: each for each in found})


def test_noise_correlates_with_nothing():
    shares = seen(np.zeros(COUNT)).shares()
    assert max(left for _, left in shares.values()) < 0.01


@pytest.mark.parametrize(
    ("error", "home"),
    [
        (5.0 * np.cos(np.radians(LOAD_DEG)), "load angle"),
        (4.0 * DIRECTION, "direction"),
        (4.0 * (TIME_S > 500.0) - 1.5, "time"),
    ],
    ids=["wave", "sides", "step"],
)
def test_a_residual_correlates_with_its_coordinate(error, home):
    before = {name: each[0] for name, each in seen(error + RNG.normal(size=COUNT)).shares().items()}
    variance = float(np.mean(error**2))
    assert before[home] == pytest.approx(variance / (variance + 1.0), abs=0.06)
    others = {"speed", "time" if home != "time" else "load angle"}
    assert all(before[each] < 0.1 for each in others)


def test_direction_dependent_residuals_are_seen_over_the_angle():
    error = 5.0 * DIRECTION * np.cos(np.radians(LOAD_DEG))
    both = seen(error)
    blind = replace(both.coordinates["load angle"], both_ways=False)
    assert both.shares()["load angle"][0] > 0.9
    assert replace(both, coordinates={"load angle": blind}).shares()["load angle"][0] < 0.05


@given(
    st.lists(st.tuples(st.floats(-1e4, 1e4), st.floats(-1e3, 1e3)), min_size=3, max_size=200),
    st.sampled_from(Spacing),
)
def test_bins_lose_no_point_and_keep_the_mean(points, spacing):
    x, y = (np.array(each) for each in zip(*points, strict=True))
    found = binned(Coordinate("c", "", x, spacing=spacing, bins=1), y)
    assert np.sum(found.count) == len(x)
    assert np.average(found.mean, weights=found.count) == pytest.approx(np.mean(y), abs=1e-6)
    total = np.average(found.spread**2 + found.mean**2, weights=found.count)
    assert total == pytest.approx(np.mean(y**2), rel=1e-6, abs=1e-6)


def test_travel_and_time_restart_at_each_reversal():
    motor = np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0, 3.0])
    motion = Motion(motor_deg=motor, time_s=np.arange(7.0))
    # A rest belongs to the motion before it, because the axis has not yet reversed.
    assert over.since_reversal(motion).values.tolist() == [SMALLEST_WAY_DEG, 1.0, 2.0, 2.0, 1.0, 2.0, 3.0]
    assert over.time_since_reversal(motion).values.tolist() == [SMALLEST_TIME_S, 1.0, 2.0, 3.0, 1.0, 2.0, 1.0]


def test_without_reversals_travel_counts_from_the_start():
    motion = Motion(motor_deg=np.zeros(4), time_s=np.arange(4.0))
    assert np.all(over.since_reversal(motion).values == SMALLEST_WAY_DEG)
    assert over.time_since_reversal(motion).values.tolist() == [SMALLEST_TIME_S, 1.0, 2.0, 3.0]


def test_time_since_a_stop_or_start():
    speed = np.array([0.0, 0.0, 5.0, 5.0, 0.0, -5.0])
    motion = Motion(motor_deg=np.cumsum(speed), time_s=np.arange(6.0), motor_speed_deg_s=speed)
    least = SMALLEST_TIME_S
    assert over.since_change(motion).values.tolist() == [least, 1.0, least, 1.0, least, least]


def test_a_stretch_does_not_predict_itself():
    values = np.where((TIME_S > 400.0) & (TIME_S < 405.0), 5.0, 0.0)  # within one stretch
    prediction = predicted(Coordinate("time", "s", TIME_S, bins=25), values, DIRECTION, folds(TIME_S))
    assert np.all(prediction[values > 0.0] == 0.0)
    assert np.max(prediction) > 0.0  # but the stretch predicts its neighbours
