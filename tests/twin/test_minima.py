"""A fit that has come to one minimum looks for others."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import (
    as_late,
    better_places,
    delays,
    exchanged,
    feedforwards,
    fit,
    inertias,
    lags,
    neighbours,
    solve,
    springs,
)
from hdbridge.twin.misfit import Data, Replays, misfit, prepare
from hdbridge.twin.parameters import BY_NAME, FOLLOWING, coordinates, free_value, with_values

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS = AxisConfig.load(DEMO)
TRUTH = with_values(Truth.load(DEMO), {"load feed-forward frequency": 75.0})


@cache
def data() -> Data:
    """Two quick steps, the load left to ring after each."""

    def lead(bench: Exercise) -> None:
        for distance in (60.0, -60.0):
            bench.move(distance, 1500.0, 60_000.0)
            bench.hold(0.25)

    record = record_of(TRUTH, lead)
    legs = (Segment(kind="step", start_s=0.0, end_s=float(record.time_s[-1])),)
    return prepare(Recording(record, legs, axis="demo", ratio=50.0), AXIS, TRUTH)


def test_a_load_feed_forward_that_was_fitted_at_a_wrong_frequency_is_found_at_the_true_one() -> None:
    names = ("inertia feed-forward", "load feed-forward", "load feed-forward frequency")
    parameters = tuple(BY_NAME[name] for name in names)
    begun = with_values(TRUTH, {"load feed-forward frequency": 20.0})
    prior = np.array(coordinates(begun, parameters))
    with Replays(data(), 1) as replays:
        there = solve(replays, begun, parameters, prior, 3)
        assert free_value(there.truth, parameters[2]) < 40.0, "a minimum of its own"
        place, *_ = better_places(replays, there, [feedforwards(there.truth, begun)], begun, prior)
        found, true = (solve(replays, each, parameters, prior, 3) for each in (place, TRUTH))
    assert found.loss < there.loss
    assert free_value(found.truth, parameters[2]) == pytest.approx(
        free_value(true.truth, parameters[2]), rel=0.1
    )


def test_a_place_that_leads_back_to_the_same_minimum_is_no_other() -> None:
    late = (BY_NAME["servo dead time"],)
    prior = np.array(coordinates(TRUTH, late))
    begun = with_values(TRUTH, {"servo dead time": 1.0})
    with Replays(data(), 1) as replays:
        best = solve(replays, TRUTH, late, prior, 3)
        assert better_places(replays, best, [[begun]], begun, prior) == []


def test_springs_ring_elsewhere_and_as_long() -> None:
    for truth in springs(TRUTH):
        gear, was = truth.gear, TRUTH.gear
        assert gear.damping_nm_s_per_rad / math.sqrt(gear.stiffness_nm_per_rad) == pytest.approx(
            was.damping_nm_s_per_rad / math.sqrt(was.stiffness_nm_per_rad)
        )
        assert gear.stiffness_nm_per_rad < truth.highest_stiffness_nm_per_rad


def test_a_lag_stays_as_long_whosever_it_is() -> None:
    late = with_values(TRUTH, {"servo dead time": 1.5})
    wanted = 2.0 * late.servo.command_filter_ms + 1.5
    for truth in lags(late):
        assert 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms == pytest.approx(wanted)
    assert len({each.servo.dead_time_ms for each in lags(late)}) > 1


@pytest.mark.parametrize(("filter_ms", "dead_time_ms"), [(0.05, 0.0), (0.3, 1.4), (1.0, 0.0), (2.0, 19.9)])
def test_a_dead_time_is_tried_in_each_other_substep_that_the_lag_has_room_for(
    filter_ms: float, dead_time_ms: float
) -> None:
    late = with_values(TRUTH, {"command filter": filter_ms, "servo dead time": dead_time_ms})
    lag_ms, step_ms = 2.0 * filter_ms + dead_time_ms, late.substep_ms
    found = {each.servo.dead_time_ms for each in delays(late)}
    for truth in delays(late):
        assert 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms == pytest.approx(lag_ms)
        assert truth.servo.command_filter_ms >= BY_NAME["command filter"].least
    middles = {(each + 0.5) * step_ms for each in range(39) if each != int(dead_time_ms / step_ms)}
    assert found == {each for each in middles if each <= lag_ms - 0.1 + 1e-9}
    own = (int(dead_time_ms / step_ms) + 0.5) * step_ms
    near = {each.servo.dead_time_ms for each in neighbours(late)}
    assert near == {each for each in found if abs(each - own) < 1.1 * step_ms}


def test_a_lighter_motor_has_a_spring_that_its_time_step_resolves() -> None:
    stiff = with_values(TRUTH, {"gear stiffness": 0.99 * TRUTH.highest_stiffness_nm_per_rad})
    factors = [each.motor.inertia_kg_m2 / stiff.motor.inertia_kg_m2 for each in inertias(stiff)]
    assert min(factors) < 0.5
    assert max(factors) > 2.0
    for truth in inertias(stiff):
        assert truth.gear.stiffness_nm_per_rad <= stiff.gear.stiffness_nm_per_rad


def test_as_much_is_fed_forward_whosever_inertia_it_is() -> None:
    small = with_values(TRUTH, {"load feed-forward": 1e-6})
    both = small.servo.inertia_feedforward_kg_m2 + 1e-6
    places = feedforwards(small, TRUTH)
    assert places
    for truth in places:
        load = truth.servo.load_feedforward
        assert load is not None
        assert truth.servo.inertia_feedforward_kg_m2 + load.inertia_kg_m2 == pytest.approx(both)
    without = TRUTH.model_copy(update={"servo": TRUTH.servo.model_copy(update={"load_feedforward": None})})
    assert feedforwards(without, TRUTH) == []


def test_position_gain_and_integral_rate_exchanged_are_the_same_loop_while_the_axis_moves() -> None:
    other = exchanged(TRUTH)
    softer = with_values(TRUTH, {"position gain": other.servo.position_gain_per_s})
    with Replays(data(), 1) as replays:
        own, same, wrong = (each[FOLLOWING] for each in replays([TRUTH, other, softer]))
    moving = np.concatenate([each.rest for each in data().pieces]) == 0.0
    assert np.std((same - own)[moving]) < 0.1 * np.std((wrong - own)[moving])
    assert other.servo.position_gain_per_s < 0.5 * TRUTH.servo.position_gain_per_s
    assert exchanged(other).servo.position_gain_per_s == pytest.approx(TRUTH.servo.position_gain_per_s)


def test_a_rival_is_as_late_by_filter_or_dead_time_whichever_is_free() -> None:
    late = with_values(TRUTH, {"command filter": 0.6, "servo dead time": 0.8})
    dead_time, command_filter = BY_NAME["servo dead time"], BY_NAME["command filter"]
    without_dead_time = as_late(with_values(late, {"servo dead time": 0.0}), late, [command_filter])
    assert without_dead_time.servo.dead_time_ms == 0.0
    assert without_dead_time.servo.command_filter_ms == pytest.approx(1.0)
    quick = as_late(with_values(late, {"command filter": 0.2}), late, [dead_time])
    assert quick.servo.command_filter_ms == pytest.approx(0.2)
    assert quick.servo.dead_time_ms == pytest.approx(1.6)
    slow = as_late(with_values(late, {"command filter": 1.5}), late, [dead_time])
    assert slow.servo.dead_time_ms == 0.0
    assert as_late(TRUTH, late, []) == TRUTH


def interrupted_at(least: float) -> Callable[[float], None]:
    def progress(share: float) -> None:
        if share >= least:
            raise KeyboardInterrupt

    return progress


def test_a_fit_that_is_interrupted_keeps_the_best_place_so_far() -> None:
    wrong = with_values(TRUTH, {"Coulomb friction": 2.0 * TRUTH.motor.coulomb_nm})
    with Replays(replace(data(), base=wrong), 1) as replays:
        found = fit(replays, interrupted_at(0.2))
        (before,) = replays([wrong])
    assert found.interrupted
    assert misfit(data(), found.residuals) < 0.5 * misfit(data(), before)


def test_a_fit_that_is_interrupted_before_it_has_reached_anything_leaves_nothing() -> None:
    with Replays(data(), 1) as replays, pytest.raises(KeyboardInterrupt):
        fit(replays, interrupted_at(0.0))
