"""A third-party drive has a measured response in addition to its loops."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.demo import AXIS, TRUTH
from support.exercised import moved, record_of

from hdbridge.records.recording import Recording
from hdbridge.sim.machine import Machine
from hdbridge.sim.response import Response
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.motor import TrueResponse
from hdbridge.twin.fit import Fitted, solve
from hdbridge.twin.misfit import Data, Replays, misfit, prepare
from hdbridge.twin.parameters import BY_NAME
from hdbridge.twin.response import with_response

FOREIGN = TrueResponse(
    cycle_ms=4.0,
    demand_ms=(0.0, -0.6, -0.4, 0.2),
    torque_nm_s_per_rad=(0.0, 2e-4, -1e-4),
    torque_nm=(0.0, 0.004, 0.002),
)


def with_own(response: TrueResponse) -> Truth:
    return TRUTH.model_copy(update={"servo": TRUTH.servo.model_copy(update={"response": response})})


TRAVELS = (200.0, -150.0, 90.0, -140.0, 120.0, -60.0, 75.0, -130.0)
moves = moved(*((each, 900.0, 9000.0, 0.2) for each in TRAVELS))


@cache
def foreign() -> Data:
    recording = Recording(record_of(with_own(FOREIGN), moves), axis="demo", ratio=50.0)
    return prepare(recording, AXIS, TRUTH)


def test_cycles_one_by_one_and_all_at_once_give_the_same_numbers() -> None:
    counts = np.cumsum(np.concatenate([[0.0], np.arange(30.0), np.zeros(10), -np.arange(30.0)])).tolist()
    together = Machine(with_own(FOREIGN), 0).follow_all(counts, [8] * (len(counts) - 1))
    alone = Machine(with_own(FOREIGN), 0)
    for cycle in range(len(counts) - 1):
        alone.follow(counts[cycle], counts[cycle + 1], 8)
        assert alone.torque_nm == together.torque_nm[cycle]
        assert alone.motor_reading == together.motor_reading[cycle]


@settings(max_examples=25)
@given(
    cycle_ms=st.sampled_from([1.0, 2.0, 4.0, 5.0, 10.0]),
    demand=st.lists(st.floats(-5.0, 5.0), max_size=6),
    torque=st.lists(st.floats(-1e-3, 1e-3), max_size=6),
)
def test_a_steady_speed_has_the_same_response_in_any_cycle(
    cycle_ms: float, demand: list[float], torque: list[float]
) -> None:
    response = Response(
        TrueResponse(cycle_ms=4.0, demand_ms=tuple(demand), torque_nm_s_per_rad=tuple(torque)), 100.0
    )
    cycle_s = 1e-3 * cycle_ms
    for cycle in range(40):
        response.advance(500.0 * cycle * cycle_s, 500.0 * (cycle + 1) * cycle_s, cycle_s)
    assert response.demand_counts == pytest.approx(500.0 * 1e-3 * sum(demand), abs=1e-9)
    assert response.torque_nm == pytest.approx(5.0 * sum(torque), abs=1e-12)


def test_a_command_at_rest_is_followed_without_any_response() -> None:
    response = Response(FOREIGN, 100.0)
    response.advance(0.0, 50.0, 0.004)
    assert response.demand_counts == response.torque_nm == 0.0  # the latest cycle contributes nothing
    response.advance(50.0, 50.0, 0.004)
    assert response.demand_counts
    assert response.torque_nm
    for _ in range(4):
        response.advance(50.0, 50.0, 0.004)
    assert response.demand_counts == response.torque_nm == 0.0


def test_a_response_confirmed_by_held_out_legs_is_adopted() -> None:
    with Replays(foreign(), 1) as replays:
        fitted = found_at(replays, TRUTH)
        better = with_response(replays, fitted)
        assert misfit(foreign(), better.residuals) < 0.35 * misfit(foreign(), fitted.residuals)
        own = better.truth.servo.response
        assert own is not None
        assert sum(own.demand_ms) == pytest.approx(sum(FOREIGN.demand_ms), abs=0.1)


def found_at(replays: Replays, truth: Truth) -> Fitted:
    friction = (BY_NAME["Coulomb friction"],)
    return solve(replays, truth, friction, 0)
