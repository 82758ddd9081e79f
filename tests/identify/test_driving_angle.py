"""Tests that the driving angle of the hysteresis has no chatter and reverses only with the motor."""

from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.driving import kinematics
from hdbridge.analysis.readings import quantum_deg, reading_of


def turns(path):
    steps = np.sign(np.diff(path))
    steps = steps[steps != 0]
    return np.count_nonzero(np.diff(steps))


@given(
    st.sampled_from([1000, 4096, 8000, 65536, 2**20]),
    st.sampled_from([1.0, 20.0, 300.0]),
    st.sampled_from([150, 3000]),
    st.integers(0, 100),
)
def test_the_count_is_found_at_any_speed(counts, fastest_deg, samples, seed):
    count = 360.0 / counts
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.uniform(0.0, max(fastest_deg, 40.0 * count), samples))
    assert quantum_deg(np.round(path / count) * count) == pytest.approx(count, rel=1e-6)
    even = np.arange(3000) * 2.37 * count
    assert quantum_deg(np.round(even / count) * count) == pytest.approx(count, rel=1e-6)


@pytest.mark.parametrize("noise_deg", [1e-5, 1e-3, 0.02])
@pytest.mark.parametrize("commanded", [True, False])
def test_fast_moves_between_rare_samples_are_not_noise(noise_deg, commanded):
    """At 13 Hz, a move takes only a few samples, and counts smaller than the noise are invisible."""
    rng = np.random.default_rng(6)
    goals = np.repeat(np.cumsum(rng.choice([-700.0, 700.0], 60)), 12)
    motor = np.convolve(goals, np.array([1.0, 3.0, 5.0, 3.0, 1.0]) / 13.0, "same")[6:-6]
    command = np.convolve(goals, np.array([3.0, 5.0, 3.0, 1.0, 1.0]) / 13.0, "same")[6:-6]
    measured = motor + noise_deg * rng.normal(size=len(motor))
    time = np.arange(len(motor)) / 13.0
    path = kinematics(measured, command if commanded else None, time, reading_of(measured)).motor_deg
    assert np.max(np.abs(path - motor)) < 1.0


def test_a_signal_without_counts_has_no_count():
    assert quantum_deg(np.cumsum(np.random.default_rng(1).uniform(0.0, 1.0, 3000))) == 0.0
    assert quantum_deg(np.zeros(100)) == 0.0


def driving_angle(command, measured, every_s=0.004):
    time = np.arange(len(measured)) * every_s
    return kinematics(measured, command, time, reading_of(measured))[0]


def test_chatter_of_a_count_makes_no_reversals():
    rng = np.random.default_rng(2)
    count = 0.045
    true = np.concatenate([np.linspace(0.0, 20.0, 2000), np.full(500, 20.0), np.linspace(20.0, 5.0, 2000)])
    measured = np.round((true + rng.normal(size=len(true)) * 0.3 * count) / count) * count
    assert turns(measured) > 100
    path = driving_angle(None, measured)
    assert turns(path) == 1
    assert np.max(np.abs(path - true)) < 2.5 * count


def test_reversals_of_a_lagging_motor_use_the_actual_angle():
    time = 0.5 + np.arange(3000) / 250.0
    command = 30.0 * np.cos(2 * np.pi * time / 4.0)
    motor = 29.0 * np.cos(2 * np.pi * time / 4.0 - 0.05)
    count = 0.045
    path = driving_angle(command, np.round(motor / count) * count)
    assert turns(path) == turns(motor)
    assert np.max(np.abs(path - motor)) < 1.5 * count


@pytest.mark.parametrize("every_s", [0.08, 0.004])
def test_a_lag_of_unexpected_shape_does_not_lead_the_angle_in_its_counts(every_s):
    """Friction holds the motor back by two counts in either direction."""
    time, count = np.arange(0.0, 60.0, every_s), 0.045
    command = 200.0 * np.sin(2 * np.pi * time / 8.0) + 20.0 * np.sin(2 * np.pi * time / 3.1)
    forward = np.sign(np.gradient(command))
    motor = command - 2.0 * count * forward
    path = driving_angle(command, np.round(motor / count) * count, every_s)
    assert abs(np.mean((path - motor) * forward)) < 0.1 * count


def test_a_constant_fraction_of_a_count_in_a_sweep_is_little_bias():
    """In the sweeps every reading is rounded by 0.4 counts; the sine shows the true lag at other speeds."""
    count, sweep = 360.0 / 32_768, 364.0 * np.arange(1000.0)
    sine = 18_000.0 * np.sin(np.arange(2000.0) / 57.3)
    counts = np.concatenate([sine - sine[-1], sweep, sweep[::-1]])
    command = np.round(counts)
    motor = command - 0.1 * np.gradient(counts)
    path = driving_angle(count * command, count * np.round(motor), 0.02)
    forward, back = slice(2010, 2990), slice(3010, 3990)
    lead = np.mean((path / count - motor)[forward]) - np.mean((path / count - motor)[back])
    assert abs(lead) / 2.0 < 0.1


@given(
    counts=st.sampled_from([8000, 20_000, 65_536, 2**18, 2**20]),
    flicker=st.sampled_from([0.0, 0.1, 0.2, 0.5]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_motor_that_rests_and_continues_in_the_same_direction_does_not_turn(counts, flicker, seed):
    rng = np.random.default_rng(seed)
    rate_hz, count = 250.0, 360.0 / counts
    parts = [np.zeros(50)]
    for _ in range(12):
        way = 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, int(rate_hz * rng.uniform(0.1, 0.6)))))
        parts.append(parts[-1][-1] + rng.uniform(2.0, 60.0) * way)
        parts.append(np.full(int(rate_hz * rng.uniform(0.1, 0.5)), parts[-1][-1]))
    command = np.round(np.concatenate(parts) / count) * count
    follows = 1.0 - np.exp(-1.0 / (rate_hz * rng.uniform(0.003, 0.02)))
    motor = np.array(list(accumulate(command, lambda at, target: at + follows * (target - at))))
    measured = np.round(motor / count + flicker * rng.standard_normal(len(motor))) * count
    assert turns(driving_angle(command, measured)) == 0


@given(
    flicker=st.floats(0.1, 0.5),
    rate_hz=st.sampled_from([62.5, 100.0, 250.0, 500.0]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_flickering_reading_at_rest_is_averaged(flicker, rate_hz, seed):
    """The axis moves to and fro; friction stops the motor up to two counts before the command."""
    rng = np.random.default_rng(seed)
    count = 0.045
    command, motor = [np.zeros(100)], [np.zeros(100)]
    for sign in (1.0, -1.0) * 6:
        way = 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, int(0.4 * rate_hz))))
        for path, short in ((command, 0.0), (motor, rng.uniform(0.0, 2.0) * count)):
            far = np.round(sign * 30.0 / count) * count - sign * short
            path += [path[-1][-1] + (far - path[-1][-1]) * way, np.full(int(0.8 * rate_hz), far)]
    command, motor = np.concatenate(command), np.concatenate(motor)
    measured = np.round(motor / count + flicker * rng.standard_normal(len(motor))) * count
    path = driving_angle(command, measured, 1.0 / rate_hz)
    rests = np.flatnonzero(np.diff(motor) == 0.0)
    _, *between = np.split(rests, np.flatnonzero(np.diff(rests) > 1) + 1)
    assert len(between) == 12
    for rest in between:
        settled = path[rest[len(rest) // 4] : rest[-len(rest) // 8]]
        assert np.ptp(settled) < 0.1 * count
        assert abs(settled[0] - motor[rest[-1]]) < 1.1 * count


@pytest.mark.parametrize("rate_hz", [25.0, 50.0, 100.0, 250.0])
def test_acceleration_effects_are_independent_of_the_sampling_rate(rate_hz: float) -> None:
    """The moves have smooth acceleration, last 0.5 s each, and are recorded in whole counts."""
    time = np.arange(0.0, 60.0, 1.0 / rate_hz)
    turn, amplitude = 2.0 * np.pi / 0.5, 45.0
    since = np.mod(time, 0.8137)
    number = np.floor(time / 0.8137)
    moving = since < 0.5
    way = np.where(moving, since / 0.5 - np.sin(turn * since) / (2.0 * np.pi), 1.0)
    command = amplitude * (number + way)
    true = np.where(moving, 2.0 * amplitude / 0.5 * np.pi / 0.5 * np.sin(turn * since), 0.0)
    count = 360.0 / 65536
    rounded = np.round(command / count) * count
    acceleration = kinematics(rounded, rounded, time, reading_of(rounded))[2]
    assert true @ acceleration / (acceleration @ acceleration) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("rate_hz", [50.0, 100.0])
def test_a_record_that_begins_and_ends_in_motion_has_its_visible_acceleration(rate_hz):
    """The acceleration is proportional to time, and needs no correction, neither inside nor at the ends."""
    time = np.arange(0.0, 1.0, 1.0 / rate_hz)
    command = 200.0 * time + 300.0 * time**3
    acceleration = kinematics(command, command, time, reading_of(command))[2]
    assert acceleration[2:-2] == pytest.approx(1800.0 * time[2:-2], rel=1e-3)
