"""Pursuit of external positions: exact within the limits, limited otherwise."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.motion import MotionMode, SetPoint
from hdbridge.motion.procedures.moves import MotionLimits

PERIOD_S = 0.004
LIMITS = MotionLimits(
    position_min_deg=-40, position_max_deg=40, velocity_deg_s=20, acceleration_deg_s2=200, jerk_deg_s3=4000
)


def following(at_deg=0.0):
    made = SetPoint(LIMITS, PERIOD_S)
    made.reset(at_deg)
    made.follow()
    return made


@given(
    goals=st.lists(
        st.tuples(st.floats(-1e3, 1e3), st.integers(1, 60), st.sampled_from([0.0, 0.02])), max_size=30
    )
)
def test_limits_hold_for_any_target(goals):
    point = following()
    before = velocity = 0.0
    for goal, turns, spacing_s in [*goals, (5.0, 1500, 0.0)]:
        for _ in range(turns):
            point.aim(goal, spacing_s)
            place = point.step()
            speed = (place - before) / PERIOD_S
            assert -40.0 <= place <= 40.0
            assert abs(speed) <= 20.0 * (1 + 2e-6)
            assert abs(speed - velocity) <= 200.0 * (PERIOD_S + spacing_s) + 1e-6
            before, velocity = place, speed
    assert before == 5.0
    assert point.at_rest


@given(begin=st.floats(30.0, 39.9), goal=st.sampled_from([40.0, 1e3]), way=st.sampled_from([1.0, -1.0]))
def test_it_brakes_before_a_position_limit_without_exceeding_the_acceleration(begin, goal, way):
    point = following(way * begin)
    before, velocity = way * begin, 0.0
    for _ in range(1000):
        point.aim(way * goal)
        place = point.step()
        speed = (place - before) / PERIOD_S
        assert abs(speed - velocity) <= 200.0 * PERIOD_S + 1e-6
        before, velocity = place, speed
    assert before == way * 40.0


@given(goal=st.floats(0.1, 30.0))
def test_a_goal_at_rest_is_reached_without_overshoot(goal):
    point = following()
    while not point.at_rest or point.position_deg == 0.0:
        point.aim(goal)
        assert point.step() <= goal + 1e-12
    assert point.position_deg == goal


@given(
    goals=st.lists(st.tuples(st.floats(-30, 30), st.integers(1, 40)), min_size=1, max_size=8),
    spacing_s=st.sampled_from([0.0, 0.02]),
)
def test_a_stop_does_not_reverse_the_axis(goals, spacing_s):
    point = following()
    for goal, turns in goals:
        for _ in range(turns):
            point.aim(goal, spacing_s)
            point.step()
    before, velocity = point.position_deg, point.velocity_deg_s
    point.stop()
    while not point.at_rest:
        speed = (point.step() - before) / PERIOD_S
        assert speed * velocity >= -1e-6
        assert abs(speed) <= 2.0 * abs(velocity) + 1e-6  # it may still accelerate, with limited jerk
        before = point.position_deg


@pytest.mark.parametrize("spacing_s", [0.001, 0.004, 0.02])
def test_a_path_within_the_limits_is_followed_exactly(spacing_s):
    """A swing whose acceleration is 95 % of the limit, interpolated linearly between set-points."""
    point = following()
    rate = 2.0 * math.pi * 2.0
    amplitude = 0.95 * 200.0 / rate**2

    def path(time_s):
        return amplitude * (1.0 - math.cos(rate * time_s))

    for turn in range(500):
        time_s = turn * PERIOD_S
        begin_s = math.floor(time_s / spacing_s) * spacing_s
        share = (time_s - begin_s) / spacing_s
        goal = path(begin_s) + share * (path(begin_s + spacing_s) - path(begin_s))
        point.aim(goal, spacing_s)
        assert point.step() == pytest.approx(goal, abs=1e-12)


def test_stop_and_another_motion_end_it():
    point = following()
    for _ in range(50):
        point.aim(30.0)
        point.step()
    point.stop()
    assert point.mode is MotionMode.STOP
    while not point.at_rest:
        point.step()
    point.follow()
    point.aim(20.0)
    for _ in range(10):
        point.step()
    point.goto(0.0)
    while not point.at_rest:
        point.step()
    assert point.position_deg == 0.0
