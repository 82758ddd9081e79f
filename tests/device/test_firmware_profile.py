"""Invariants of the drive's own velocity profiles."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.device.profile import move, stop

positions = st.floats(-1e6, 1e6)
speeds = st.floats(-1e5, 1e5)
limits = st.floats(1e2, 1e5)
accelerations = st.floats(1e3, 1e6)


@given(positions, speeds, positions, limits, accelerations, accelerations)
def test_a_move_ends_at_its_target_within_its_limits(start, speed, target, fastest, up, down):
    profile = move(start, speed, target, fastest, up, down)
    assert profile.at(profile.duration_s + 1e-6) == (target, 0.0)
    position, velocity = start, speed
    steps = 200
    dt = profile.duration_s / steps
    for k in range(1, steps):
        next_position, next_velocity = profile.at(k * dt)
        assert abs(next_velocity) <= max(fastest, abs(speed)) * (1 + 1e-9)
        assert abs(next_velocity - velocity) <= max(up, down) * dt * (1 + 1e-6) + 1e-6
        highest = max(abs(velocity), abs(next_velocity)) * dt + max(up, down) * dt**2
        assert abs(next_position - position) <= highest * (1 + 1e-6) + 1e-6
        position, velocity = next_position, next_velocity
    assert abs(target - position) <= abs(velocity) * dt + max(up, down) * dt**2 + 1e-3


@given(positions, positions, limits, accelerations, accelerations)
def test_a_move_from_rest_never_turns_back(start, target, fastest, up, down):
    profile = move(start, 0.0, target, fastest, up, down)
    sense = 1.0 if target >= start else -1.0
    assert all(sense * profile.at(k / 50 * profile.duration_s)[1] >= -1e-6 for k in range(51))


@given(positions, speeds, accelerations)
def test_a_stop_takes_v_squared_over_2a(start, speed, deceleration):
    profile = stop(start, speed, deceleration)
    distance = speed * abs(speed) / (2 * deceleration)
    assert profile.end == pytest.approx(start + distance, rel=1e-9, abs=1e-6)
    assert profile.duration_s == pytest.approx(abs(speed) / deceleration)
