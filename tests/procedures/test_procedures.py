"""Procedures on an ideal axis, without bus or clock."""

import math
from dataclasses import fields, replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.errors import InputError
from hdbridge.motion.procedures.chain import Chain
from hdbridge.motion.procedures.even_speed import EvenSpeed
from hdbridge.motion.procedures.moves import AxisView, Dwell, MotionLimits, MoveTo, Sample, Settle, Sine
from hdbridge.motion.procedures.positioning import Positioning
from hdbridge.motion.procedures.rehearsal import rehearse
from hdbridge.motion.procedures.reversals import Reversals
from hdbridge.motion.procedures.sine import Sines
from hdbridge.motion.procedures.small_steps import SmallSteps
from hdbridge.motion.procedures.standstill import Precondition, Standstill
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.motion.procedures.sweep import Sweep
from hdbridge.motion.procedures.waypoints import Hold, WayPoints

LIMITS = MotionLimits(-400.0, 400.0, 20.0, 200.0, 4000.0)
AXIS = AxisView(50.0, LIMITS)
PERIOD = 0.004


def walk(procedure, error_arcsec=lambda load_deg, direction: 0.0, axis=AXIS):
    """Runs a procedure on an axis whose load is off by a known error; returns legs and outcome."""
    legs, place, clock, direction = [], 0.0, 0.0, 1
    steps = procedure.moves(axis)
    reply = None
    while True:
        try:
            move = steps.send(reply)
        except StopIteration as end:
            return legs, end.value
        path = move.path(place, axis.limits)
        reply, began = [], clock
        while True:
            target = path.at(clock - began)
            if target != place:
                direction = 1 if target > place else -1
            place = target
            load = target + error_arcsec(target, direction) / 3600
            reply.append(Sample(clock, target, target * 50, target * 50, load, 0.0))
            over = clock - began >= path.duration_s and move.ended(reply, axis)
            clock += PERIOD
            if over:
                break
        legs.append((move, reply))


@given(start=st.floats(-300, 300), goal=st.floats(-300, 300), speed=st.none() | st.floats(0.1, 50))
def test_a_move_arrives_and_keeps_the_limits(start, goal, speed):
    path = MoveTo(goal, speed).path(start, LIMITS)
    assert path.at(0.0) == pytest.approx(start, abs=1e-9)
    assert path.at(path.duration_s) == pytest.approx(goal, abs=1e-9)
    assert path.at(path.duration_s + 1.0) == goal
    places = [path.at(i * path.duration_s / 200) for i in range(201)]
    dt = path.duration_s / 200
    top = min(speed or math.inf, LIMITS.velocity_deg_s)
    if dt > 0:
        assert max(abs(b - a) / dt for a, b in pairwise(places)) <= top * (1 + 1e-6) + 1e-9
    assert path.lowest_deg - 1e-9 <= min(places) <= max(places) <= path.highest_deg + 1e-9


def test_stepping_visits_every_target_both_ways_and_measures_the_error_at_rest():
    def error(load_deg, direction):
        return 40.0 * direction + 3.0 * load_deg

    legs, outcome = walk(Stepping(count=5), error)
    step = 43.56 / 50
    assert [each.target_deg for each in outcome.cw] == pytest.approx([i * step for i in range(1, 6)])
    assert [each.target_deg for each in outcome.ccw] == pytest.approx([i * step for i in range(4, -1, -1)])
    for stands, direction in ((outcome.cw, 1), (outcome.ccw, -1)):
        for stand in stands:
            assert stand.error_arcsec == pytest.approx(40 * direction + 3 * stand.target_deg, abs=1e-6)
    assert [move.kind for move, _ in legs[:3]] == ["precondition", "precondition", "step"]


def test_settle_waits_for_the_load_and_gives_up_at_its_timeout():
    settle = Settle(window_s=0.06, drift_arcsec=0.3, timeout_s=1.0)

    def creeping(rate_arcsec_s, until_s):
        return [
            Sample(i * PERIOD, 0, 0, 0, min(i * PERIOD, until_s) * rate_arcsec_s / 3600, 0)
            for i in range(400)
        ]

    def end(samples):
        return next(s[-1].time_s for i in range(20, 400) if settle.ended(s := samples[:i], AXIS))

    assert end(creeping(50, 0.4)) == pytest.approx(0.45, abs=0.03)
    assert end(creeping(50, 9.0)) == pytest.approx(1.0, abs=0.01)
    stuck = [each._replace(motor_position_deg=0.05 * (each.time_s < 0.6)) for each in creeping(0, 0)]
    assert end(stuck) == pytest.approx(0.66, abs=0.01)
    assert len(settle.window(creeping(0, 0)[:100])) == pytest.approx(0.06 / PERIOD, abs=1)


def test_a_sine_starts_and_ends_at_rest_at_its_upper_extreme():
    path = Sine(10.0, 2.0, 0.5, 3).path(12.0, LIMITS)
    assert path.at(0.0) == path.highest_deg == 12.0
    assert path.at(path.duration_s) == pytest.approx(12.0)
    assert abs(path.at(0.001) - 12.0) < 1e-4
    assert path.at(1.0) == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("sine", "start", "text"),
    [
        (Sine(10.0, 2.0, 0.5, 3), 0.0, r"starts at 12 deg: move there first"),
        (Sine(10.0, 2.0, 5.0, 3), 12.0, r"needs 62.8 deg/s; the axis file allows 20"),
    ],
)
def test_a_sine_that_would_jump_or_race_is_refused(sine, start, text):
    with pytest.raises(InputError, match=text):
        sine.path(start, LIMITS)


PROCEDURES = [
    Precondition(),
    Standstill(5.0, 2.0),
    Sweep(-10, 10, 5.0, laps=2),
    Sines(),
    Reversals(),
    Reversals(beyond=True),
    SmallSteps(),
    Stepping(count=20),
]


@pytest.mark.parametrize("procedure", PROCEDURES, ids=lambda each: type(each).__name__)
def test_the_rehearsal_predicts_the_bench_run(procedure):
    rehearsal = rehearse(procedure, AXIS)
    legs, _ = walk(procedure)
    targets = [sample.load_target_deg for _, samples in legs for sample in samples]
    assert rehearsal.legs == len(legs)
    assert rehearsal.lowest_deg == pytest.approx(min(targets), abs=1e-3)
    assert rehearsal.highest_deg == pytest.approx(max(targets), abs=1e-3)
    cycles = sum(len(samples) for _, samples in legs)
    assert rehearsal.duration_s == pytest.approx(cycles * PERIOD, rel=0.1, abs=3 * PERIOD * len(legs))


@pytest.mark.parametrize(
    "procedure",
    [Stepping(count=500), Sweep(-10, 500, 5.0), Standstill(-401.0)],
    ids=["stepping", "sweep", "standstill"],
)
def test_leaving_the_limits_is_refused_before_anything_moves(procedure):
    with pytest.raises(InputError, match=r"the axis file allows -400 to 400|no trajectory"):
        rehearse(procedure, AXIS)


GOOD = [
    *PROCEDURES,
    Positioning((0.0, 9.0)),
    EvenSpeed((5.0,)),
    WayPoints((1.0,), velocity_deg_s=5.0),
    MoveTo(1.0),
]
GOOD += [Chain((Sines(),), 5.0), Dwell(1.0), Settle(), Sine(0.0, 1.0, 1.0, 1.0)]
NUMBERS = [
    (each, field.name)
    for each in GOOD
    for field in fields(each)
    if isinstance(getattr(each, field.name), (int, float)) and field.type is not bool
]
SERIES = [
    (each, field.name)
    for each in GOOD
    for field in fields(each)
    if str(field.type).startswith(("tuple[float", "tuple[typing.Annotated"))
]


@pytest.mark.parametrize("wrong", [math.nan, math.inf, "1", True, [1.0]], ids=repr)
@pytest.mark.parametrize(("good", "name"), NUMBERS)
def test_a_parameter_that_is_not_a_finite_number_is_refused_at_construction(good, name, wrong):
    with pytest.raises(InputError, match=rf"^\w+: {name}: found .*; expected a"):
        replace(good, **{name: wrong})


@pytest.mark.parametrize("wrong", [(), (math.nan,), ("1",), 1.0, "1"], ids=repr)
@pytest.mark.parametrize(("good", "name"), SERIES)
def test_a_parameter_without_finite_numbers_is_refused_at_construction(good, name, wrong):
    with pytest.raises(InputError, match=rf"^\w+: {name}: found .*; expected at least one"):
        replace(good, **{name: wrong})


@pytest.mark.parametrize("wrong", [0, -1])
@pytest.mark.parametrize(
    ("good", "name"),
    [
        (each, name)
        for each, name in NUMBERS
        if name in {"velocity_deg_s", "acceleration_deg_s2", "frequency_hz", "periods"}
        or name in {"laps", "count", "cycles", "window_s", "timeout_s"}
    ],
)
def test_a_parameter_that_allows_no_motion_is_refused_at_construction(good, name, wrong):
    with pytest.raises(InputError, match=rf"^\w+: {name}: found {wrong}; expected an? \w+ above 0"):
        replace(good, **{name: wrong})


def test_a_hold_without_an_end_is_not_a_number():
    for wrong in (math.nan, -1.0, "1"):
        with pytest.raises(InputError, match="duration_s"):
            Hold(wrong)
