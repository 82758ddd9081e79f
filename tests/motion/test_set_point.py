"""Invariants of the set-point for any order of requests."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.errors import InputError
from hdbridge.motion import MotionMode, SetPoint
from hdbridge.motion.procedures.moves import MotionLimits

LIMITS = MotionLimits(-90.0, 120.0, 60.0, 200.0, 4000.0)
PERIOD_S = 0.004
_LONGEST = 20_000


def numbers(least: float, most: float) -> st.SearchStrategy[float]:
    """Mostly useful numbers, sometimes any float."""
    return st.floats(least, most) | st.sampled_from([least, most, 0.0]) | st.floats()


LIMIT_SETS = st.builds(
    MotionLimits,
    st.sampled_from([-90.0, -1.0, -1e-3, -36_000.0]),
    st.sampled_from([120.0, 0.5, 1e-3, 36_000.0]),
    st.sampled_from([60.0, 1.0, 0.01, 720.0]),
    st.sampled_from([200.0, 5.0, 20_000.0]),
    st.sampled_from([4000.0, 20.0, 1e7]),
)
COMMANDS = st.one_of(
    st.tuples(
        st.just("goto"),
        numbers(-90.0, 120.0),
        st.none() | numbers(1e-3, 80.0),
        st.none() | numbers(1.0, 300.0),
    ),
    st.tuples(st.just("jog"), numbers(-80.0, 80.0), numbers(0.0, 0.5)),
    st.tuples(st.just("stop")),
    st.tuples(st.just("stream"), numbers(0.0, 0.3)),
    st.tuples(st.just("begin_stream")),
    st.tuples(st.just("knot"), numbers(0.0, 3.0), numbers(-90.0, 120.0), numbers(-60.0, 60.0)),
    st.tuples(st.just("path"), st.floats(-50.0, 50.0), st.integers(2, 40)),
)


def asked(set_point: SetPoint, command: tuple) -> None:
    """Makes a request; a refusal must leave everything unchanged."""
    name, *arguments = command
    if name == "path":
        speed, count = arguments
        _knots(set_point, speed, count)
        return
    before = _seen(set_point)
    try:
        getattr(set_point, name)(*arguments)
    except InputError:
        assert _seen(set_point) == before


def _knots(set_point: SetPoint, speed: float, count: int) -> None:
    """Streams knots of constant acceleration as long as the limits permit, then stops streaming."""
    try:
        set_point.stream(0.1)
        set_point.begin_stream()
        start = set_point.position_deg
        for number in range(count):
            now = number * 10 * PERIOD_S
            set_point.knot(now, start + 0.5 * speed * now * now, speed * now)
    except InputError:
        pass


def _seen(set_point: SetPoint) -> tuple:
    names = ("position_deg", "velocity_deg_s", "acceleration_deg_s2", "mode", "at_rest", "underrun", "room")
    return tuple(getattr(set_point, each) for each in names)


def follow(set_point, limits, period_s, steps, check_jerk=True):
    """Runs steps of the set-point, and checks the invariants after each."""
    for _ in range(steps):
        last, last_acceleration, mode = set_point.position_deg, set_point.acceleration_deg_s2, set_point.mode
        position = set_point.step()
        assert math.isfinite(position)
        assert position == set_point.position_deg
        assert min(limits.position_min_deg, 0.0) <= position <= max(limits.position_max_deg, 0.0)
        grain = 4.0 * math.ulp(max(abs(limits.position_min_deg), limits.position_max_deg))
        assert abs(position - last) <= limits.velocity_deg_s * period_s * (1.0 + 2e-6) + grain
        assert abs(set_point.velocity_deg_s) <= limits.velocity_deg_s * (1.0 + 2e-6)
        assert abs(set_point.acceleration_deg_s2) <= 1.05 * limits.acceleration_deg_s2 * (1.0 + 1e-5)
        # Velocity matches the positions; only rounding is clipped at a limit.
        drift = abs(position - last - set_point.velocity_deg_s * period_s)
        assert drift <= 1.1 * limits.acceleration_deg_s2 * period_s**2 + 1e-8
        if check_jerk and MotionMode.STREAM not in {mode, set_point.mode}:
            change = abs(set_point.acceleration_deg_s2 - last_acceleration)
            assert change <= limits.jerk_deg_s3 * period_s * (1.0 + 1e-6) + 1e-6 * limits.acceleration_deg_s2


@settings(max_examples=300, deadline=None)
@given(
    LIMIT_SETS,
    st.sampled_from([0.001, 0.004, 0.02]),
    st.lists(st.tuples(COMMANDS, st.integers(0, 120)), max_size=12),
)
def test_any_order_of_calls_with_any_numbers_stays_within_the_limits(limits, period_s, calls):
    set_point = SetPoint(limits, period_s)
    streamed = False
    for command, steps in calls:
        asked(set_point, command)
        streamed = streamed or command[0] in {"path", "knot"}
        follow(set_point, limits, period_s, steps, check_jerk=not streamed)
    set_point.stop()
    for _ in range(_LONGEST):
        if set_point.mode is MotionMode.HOLD:
            break
        follow(set_point, limits, period_s, 1, check_jerk=not streamed)
    assert set_point.at_rest
    assert set_point.mode is MotionMode.HOLD
    assert (set_point.velocity_deg_s, set_point.acceleration_deg_s2) == (0.0, 0.0)


@settings(max_examples=60, deadline=None)
@given(LIMIT_SETS, st.lists(st.tuples(COMMANDS, st.integers(0, 120)), max_size=4), st.floats(0.0, 1.0))
def test_an_accepted_move_reaches_its_target_exactly_and_rests(limits, calls, share):
    set_point = SetPoint(limits, PERIOD_S)
    for command, steps in calls:
        asked(set_point, command)
        follow(set_point, limits, PERIOD_S, steps, check_jerk=False)
    target = limits.position_min_deg + share * (limits.position_max_deg - limits.position_min_deg)
    try:
        set_point.goto(target)
    except InputError:
        return
    assert set_point.mode is MotionMode.GOTO
    for _ in range(5000):
        if set_point.mode is MotionMode.HOLD:
            break
        set_point.step()
    else:
        assert set_point.velocity_deg_s != 0.0  # a long move at a low speed
        return
    assert set_point.position_deg == target
    assert set_point.at_rest
    assert set_point.step() == target


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(-90.0, 120.0), st.floats(0.0, 1.0)), min_size=1, max_size=6))
def test_a_move_from_rest_or_in_motion_is_never_refused_within_the_limits(moves):
    set_point = SetPoint(LIMITS, PERIOD_S)
    for target, wait_s in moves:
        set_point.goto(target)
        follow(set_point, LIMITS, PERIOD_S, int(wait_s / PERIOD_S))


def test_a_gentle_move_brakes_harder_to_stay_within_the_limits():
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.goto(LIMITS.position_max_deg)
    while set_point.position_deg < 112.0:
        follow(set_point, LIMITS, PERIOD_S, 1)
    set_point.goto(0.0, acceleration_deg_s2=20.0)
    follow(set_point, LIMITS, PERIOD_S, 3000)
    assert set_point.position_deg == 0.0


def test_a_target_in_motion_is_taken_over_without_a_stop():
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.goto(60.0)
    follow(set_point, LIMITS, PERIOD_S, 100)
    slowest = speed = set_point.velocity_deg_s
    set_point.goto(90.0)
    while set_point.position_deg < 60.0:
        follow(set_point, LIMITS, PERIOD_S, 1)
        slowest = min(slowest, set_point.velocity_deg_s)
    assert slowest >= speed > 50.0


@pytest.mark.parametrize("limit", [LIMITS.position_min_deg, LIMITS.position_max_deg])
def test_a_jog_brakes_before_the_limit_and_waits_there(limit):
    set_point = SetPoint(LIMITS, PERIOD_S)
    for _ in range(60):
        set_point.jog(math.copysign(60.0, limit), 0.2)
        follow(set_point, LIMITS, PERIOD_S, 20)
    assert set_point.position_deg == limit
    assert set_point.mode is MotionMode.JOG
    assert set_point.at_rest
    follow(set_point, LIMITS, PERIOD_S, 51)
    assert set_point.mode is MotionMode.HOLD


@given(st.floats(1.0, 60.0), st.floats(0.05, 1.0))
def test_an_unrenewed_jog_runs_for_its_time_and_stops(velocity, timeout_s):
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.jog(velocity, timeout_s)
    periods = 0
    while set_point.mode is MotionMode.JOG:
        follow(set_point, LIMITS, PERIOD_S, 1)
        periods += 1
    assert periods == round(timeout_s / PERIOD_S) + 1
    assert set_point.mode is MotionMode.STOP
    follow(set_point, LIMITS, PERIOD_S, 200)
    assert set_point.mode is MotionMode.HOLD


def test_a_renewed_jog_continues_at_its_speed():
    set_point = SetPoint(LIMITS, PERIOD_S)
    for _ in range(20):
        set_point.jog(7.0, 0.1)
        follow(set_point, LIMITS, PERIOD_S, 20)
    assert set_point.velocity_deg_s == pytest.approx(7.0, rel=1e-5)
    set_point.jog(3.0, 0.2)
    follow(set_point, LIMITS, PERIOD_S, 40)
    assert set_point.velocity_deg_s == pytest.approx(3.0, rel=1e-5)
    set_point.jog(0.0, 0.2)
    assert set_point.mode is MotionMode.STOP


def test_an_axis_outside_its_limits_moves_inwards_only():
    set_point = SetPoint(LIMITS, PERIOD_S)
    set_point.reset(125.0)
    assert set_point.step() == 125.0
    set_point.jog(20.0, 0.2)
    for _ in range(60):
        assert set_point.step() == 125.0
    set_point.jog(-20.0, 0.2)
    places = [set_point.step() for _ in range(150)]
    assert places == sorted(places, reverse=True)
    with pytest.raises(InputError, match="position limits"):
        set_point.goto(124.0)
    set_point.goto(110.0)
    for _ in range(500):
        set_point.step()
    assert set_point.position_deg == 110.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((math.nan,), "finite"),
        ((120.1,), "position limits are -90 and 120 deg"),
        ((10.0, 0.0), "velocity of this move is 0.0"),
        ((10.0, None, math.inf), "acceleration of this move is inf"),
    ],
)
def test_a_refused_move_gives_the_reason(arguments, message):
    with pytest.raises(InputError, match=message):
        SetPoint(LIMITS, PERIOD_S).goto(*arguments)


def test_limits_without_room_are_refused():
    with pytest.raises(InputError, match=r"position limits of 1\.0 to 0\.0"):
        SetPoint(LIMITS.__class__(1.0, 0.0, 60.0, 200.0, 4000.0), PERIOD_S)
    with pytest.raises(InputError, match="above 0"):
        SetPoint(LIMITS.__class__(0.0, 1.0, 60.0, 0.0, 4000.0), PERIOD_S)


def test_no_knot_is_accepted_outside_a_stream():
    assert SetPoint(LIMITS, PERIOD_S).room == 0
