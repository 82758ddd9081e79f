"""Streams of knots: followed exactly, checked before they are taken, braked when they run out."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.errors import InputError
from hdbridge.motion import MotionMode, SetPoint, coordinated
from hdbridge.motion.procedures.moves import MotionLimits
from hdbridge.motion.stream import MOST_KNOTS, Cubic

LIMITS = MotionLimits(-90.0, 120.0, 60.0, 200.0, 4000.0)
PERIOD_S = 0.004


def streaming(timeout_s: float = 0.2, begin: float = 0.0) -> SetPoint:
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.reset(begin)
    set_point.stream(timeout_s)
    set_point.begin_stream()
    return set_point


def sine(time_s: float, size: float = 5.0, omega: float = 4.0) -> tuple[float, float]:
    return size * (1.0 - math.cos(omega * time_s)), size * omega * math.sin(omega * time_s)


@given(st.integers(1, 25))
def test_knots_are_met_exactly_and_the_path_closely(every):
    set_point = streaming()
    periods = 10 * every
    for number in range(0, periods + 1, every):
        set_point.knot(number * PERIOD_S, *sine(number * PERIOD_S))
    for number in range(periods + 1):
        position = set_point.step()
        wanted = sine(number * PERIOD_S)[0]
        if number % every == 0:
            assert position == wanted
        assert position == pytest.approx(wanted, abs=5.0 * (4.0 * every * PERIOD_S) ** 4 / 384.0 + 1e-12)


def test_running_out_of_knots_in_motion_brakes_with_limited_jerk():
    set_point = streaming()
    for number in range(51):
        set_point.knot(number * PERIOD_S, *sine(number * PERIOD_S))
    for _ in range(51):
        last = set_point.acceleration_deg_s2
        set_point.step()
    assert not set_point.underrun
    last = set_point.acceleration_deg_s2
    speed = set_point.velocity_deg_s
    assert speed > 10.0
    before = set_point.position_deg
    while set_point.mode is not MotionMode.HOLD:
        set_point.step()
        assert set_point.underrun
        assert abs(set_point.acceleration_deg_s2 - last) <= LIMITS.jerk_deg_s3 * PERIOD_S * (1.0 + 1e-6)
        last = set_point.acceleration_deg_s2
    assert 0.0 < set_point.position_deg - before < speed * speed / 200.0 + 5.0
    set_point.goto(0.0)
    assert not set_point.underrun


def test_running_out_of_knots_at_rest_waits_and_continues():
    set_point = streaming(timeout_s=0.1)
    set_point.knot(0.0, 0.0, 0.0)
    set_point.knot(0.4, 1.0, 0.0)
    for _ in range(110):
        set_point.step()
    assert set_point.position_deg == 1.0
    assert set_point.at_rest
    assert set_point.mode is MotionMode.STREAM
    set_point.knot(0.8, 0.0, 0.0)
    places = [set_point.step() for _ in range(100)]
    assert places[0] == pytest.approx(1.0, abs=1e-3)
    assert places[-1] == 0.0
    for _ in range(26):
        set_point.step()
    assert set_point.mode is MotionMode.HOLD
    assert not set_point.underrun
    with pytest.raises(InputError, match="no stream"):
        set_point.knot(2.0, 0.0, 0.0)


def test_a_rest_between_two_periods_costs_no_time_of_the_knots_behind_it():
    set_point = streaming()
    set_point.knot(0.0, 0.0, 0.0)
    set_point.knot(0.4019, 1.0, 0.0)
    for _ in range(110):
        set_point.step()
    set_point.knot(0.8019, 0.0, 0.0)
    for _ in range(50):
        set_point.step()
    assert set_point.position_deg == pytest.approx(0.5, abs=1e-9)


def test_a_late_knot_between_periods_keeps_the_speed():
    set_point = streaming()
    end_s = 0.2021
    set_point.knot(0.0, 0.0, 0.0)
    set_point.knot(end_s, 1.0, 10.0)
    position = before = 0.0
    while not set_point.underrun:
        before, position = position, set_point.step()
    assert position - before == pytest.approx(10.0 * PERIOD_S, abs=200.0 * PERIOD_S**2)


def test_time_starts_on_request():
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.stream(1.0)
    set_point.knot(0.0, 0.0, 0.0)
    set_point.knot(0.4, 1.0, 0.0)
    assert [set_point.step() for _ in range(5)] == [0.0] * 5
    set_point.begin_stream()
    assert set_point.step() == 0.0
    assert set_point.step() > 0.0


def test_a_later_first_knot_delays_the_start():
    set_point = streaming()
    set_point.knot(0.04, 0.0, 0.0)
    set_point.knot(0.44, 1.0, 0.0)
    assert [set_point.step() for _ in range(11)] == [0.0] * 11
    assert set_point.step() > 0.0


@pytest.mark.parametrize(
    ("knot", "message"),
    [
        ((0.1, math.nan, 0.0), "finite"),
        ((0.0, 0.0, 0.0), "expected increasing times"),
        ((-1.0, 0.0, 0.0), "expected increasing times"),
        ((0.1, 20.0, 0.0), r"deg/s; the axis file allows 60 \(limits.velocity_deg_s\)"),
        ((0.1, 1.0, 0.0), r"600 deg/s2; the axis file allows 200 \(limits.acceleration_deg_s2\)"),
        ((100.0, 121.0, 0.0), "position limits are -90 and 120 deg"),
        ((20.0, 119.0, 30.0), "could not brake"),
        ((20.0, 119.0, 25.0), "could not brake"),
        ((100.0, 120.0, 5.0), "could not brake"),
        ((100.0, 120.0, -5.0), "covers"),
    ],
)
def test_a_knot_beyond_the_limits_is_refused_and_the_stream_continues(knot, message):
    set_point = streaming()
    set_point.knot(0.0, 0.0, 0.0)
    with pytest.raises(InputError, match=message):
        set_point.knot(*knot)
    set_point.knot(0.4, 1.0, 0.0)
    for _ in range(102):
        set_point.step()
    assert set_point.position_deg == 1.0


@given(
    begin=st.floats(-50.0, 50.0),
    end=st.floats(-50.0, 50.0),
    speeds=st.tuples(st.floats(-80.0, 80.0), st.floats(-80.0, 80.0)),
    duration_s=st.floats(0.05, 5.0),
)
def test_extremes_of_a_cubic_are_those_of_its_path(begin, end, speeds, duration_s):
    cubic = Cubic.between(1.0, begin, speeds[0], 1.0 + duration_s, end, speeds[1])
    states = [cubic.state(1.0 + duration_s * number / 4000) for number in range(4001)]
    places, velocities, accelerations = np.array(states).T
    lowest, highest = cubic.extremes_deg()
    fastest, hardest = cubic.fastest_deg_s(), cubic.hardest_deg_s2()
    near = hardest * (duration_s / 400) ** 2
    assert places.min() - near - 1e-9 <= lowest <= places.min() + 1e-9
    assert places.max() - 1e-9 <= highest <= places.max() + near + 1e-9
    assert hardest == pytest.approx(np.abs(accelerations).max(), abs=1e-6)
    assert fastest == pytest.approx(np.abs(velocities).max(), rel=1e-6, abs=hardest * duration_s / 400)


def accelerating(acceleration: float, speed: float) -> SetPoint:
    """Streams a constant acceleration, and stops at a speed close to the axis's limit."""
    set_point = streaming(begin=0.0)
    end_s = 60.0 / abs(acceleration)
    for number in range(int(end_s / PERIOD_S) + 1):
        time_s = number * PERIOD_S
        set_point.knot(time_s, 0.5 * acceleration * time_s**2, acceleration * time_s)
    while abs(set_point.velocity_deg_s) < speed:
        set_point.step()
    return set_point


def test_a_move_requested_in_hard_acceleration_does_not_exceed_the_speed_limit():
    """The acceleration decreases at the jerk limit, during which the axis gains another 5 deg/s."""
    set_point = accelerating(200.0, 58.0)
    with pytest.raises(InputError, match="no trajectory"):
        set_point.goto(110.0)
    set_point.stop()
    while not set_point.at_rest:
        set_point.step()
        assert abs(set_point.velocity_deg_s) <= LIMITS.velocity_deg_s * (1.0 + 2e-6)


def test_a_stream_starts_at_rest_at_the_present_position():
    for knot in ((0.0, 1e-5, 0.0), (0.0, 0.0, 1.0), (-0.1, 0.0, 0.0)):
        with pytest.raises(InputError, match="begins at"):
            streaming().knot(*knot)
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.jog(10.0, 1.0)
    for _ in range(10):
        set_point.step()
    with pytest.raises(InputError, match="must begin at rest"):
        set_point.stream(1.0)


def test_the_buffer_is_bounded():
    set_point = streaming()
    for number in range(MOST_KNOTS + 1):
        set_point.knot(number * PERIOD_S, 0.0, 0.0)
    assert set_point.room == 0
    with pytest.raises(InputError, match="are in the buffer"):
        set_point.knot(1e3, 0.0, 0.0)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(
        [LIMITS, MotionLimits(-90.0, 120.0, 1.0, 500.0, 1e6), MotionLimits(-90.0, 120.0, 60.0, 20.0, 50.0)]
    ),
    st.lists(st.floats(-8.0, 4.0), min_size=1, max_size=3),
    st.lists(st.floats(-8.0, 4.0), min_size=1, max_size=3),
    st.floats(0.3, 1.0),
)
def test_a_coordinated_plan_is_accepted_and_arrives_simultaneously(limits, first, second, share):
    starts = {"a": 3.0, "b": -7.0}
    points = [{"a": x, "b": y} for x, y in zip(first, second, strict=False)]
    plan = coordinated(starts, points, {"a": limits, "b": LIMITS}, PERIOD_S, share)
    for name, its in (("a", limits), ("b", LIMITS)):
        knots = plan.knots[name]
        assert knots[-1].tolist() == [plan.duration_s, points[-1][name], 0.0]
        assert np.abs(np.diff(knots[:, 1])).max() <= share * its.velocity_deg_s * PERIOD_S * (1.0 + 1e-6)
        set_point = SetPoint(its, PERIOD_S)
        set_point.reset(starts[name])
        set_point.stream(0.1)
        set_point.begin_stream()
        for knot in knots[:4000].tolist():
            set_point.knot(*knot)
        for knot in knots[:4000].tolist():
            assert set_point.step() == knot[1]


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([0.5, 5.0, 60.0]),
    st.sampled_from([50.0, 200.0, 5000.0]),
    st.sampled_from([1e4, 1e5, 1e7]),
    st.floats(0.01, 20.0),
)
def test_cubics_through_the_knots_of_a_plan_keep_to_the_limits_however_much_jerk(
    speed, acceleration, jerk, way
):
    limits = MotionLimits(-90.0, 120.0, speed, acceleration, jerk)
    knots = coordinated({"a": 0.0}, [{"a": way}], {"a": limits}, PERIOD_S).knots["a"]
    set_point = SetPoint(limits, PERIOD_S)
    set_point.stream(0.1)
    for knot in knots[:4000].tolist():
        set_point.knot(*knot)


def test_axes_of_a_coordinated_plan_go_straight_and_arrive_together():
    plan = coordinated(
        {"a": 0.0, "b": 10.0, "c": 0.0}, [{"a": 40.0, "b": 0.0}], dict.fromkeys("abc", LIMITS), PERIOD_S
    )
    assert set(plan.knots) == {"a", "b"}
    a, b = plan.knots["a"], plan.knots["b"]
    assert b[:, 1] == pytest.approx(10.0 - a[:, 1] / 4.0, abs=1e-9)
    assert (a[-2, 2] > 0.0, b[-2, 2] < 0.0) == (True, True)


def test_points_on_a_straight_line_are_passed_in_motion_and_corners_at_rest():
    both = dict.fromkeys("ab", LIMITS)
    through = coordinated(
        {"a": 0.0, "b": 0.0}, [{"a": 20.0, "b": 10.0}, {"a": 40.0, "b": 20.0}], both, PERIOD_S
    )
    straight = coordinated({"a": 0.0, "b": 0.0}, [{"a": 40.0, "b": 20.0}], both, PERIOD_S)
    assert np.array_equal(through.knots["a"], straight.knots["a"])
    corner = coordinated(
        {"a": 0.0, "b": 0.0}, [{"a": 20.0, "b": 10.0}, {"a": 40.0, "b": 0.0}], both, PERIOD_S
    )
    at_corner = corner.knots["a"][corner.knots["a"][:, 1] == 20.0]
    assert at_corner[0, 2] == 0.0


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], "at least one"),
        ([{}], "has no axis"),
        ([{"x": 1.0}], "no axis 'x'"),
        ([{"a": 121.0}], "axis 'a': a target of 121.0 deg"),
        ([{"a": math.nan}], "axis 'a'"),
    ],
)
def test_an_impossible_coordinated_move_is_refused(points, message):
    with pytest.raises(InputError, match=message):
        coordinated({"a": 0.0}, points, {"a": LIMITS}, PERIOD_S)
