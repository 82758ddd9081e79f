"""The foreign servos: steps as in the textbook, settling, limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from foreign.draw import REST_DEG, Truth, draw
from foreign.machine import Encoders, ForeignMachine
from foreign.mechanics import DT_S, MaxwellSlip, static_error_arcsec
from foreign.servos import STRUCTURES, Piv, StateFeedback

FINE = Encoders(1 << 20, 64, 0.0, 1 << 23, 0.0)
AXES = [(1, structure) for structure in STRUCTURES]


@pytest.fixture(params=AXES, ids=[f"{structure}-{seed}" for seed, structure in AXES])
def axis(request) -> Truth:
    return draw(*request.param)


def linear(truth: Truth):
    """Returns the mechanics without friction and transmission error."""
    return replace(truth.mechanics, coulomb_nm=0.0, motor_orders=(), hysteresis=MaxwellSlip(()))


def run(machine: ForeignMachine, targets: np.ndarray, cycle_s: float) -> np.ndarray:
    """Sends one set-point in counts per cycle; returns motor and load angle (rad) and torque (Nm) after each
    substep.
    """
    substeps = round(cycle_s / DT_S)
    trace = np.zeros((targets.size, substeps, 3))
    before = machine.motor_counts
    for target, rows in zip(targets.tolist(), trace, strict=True):
        machine.follow(before, target, substeps, rows)
        before = target
    return trace.reshape(-1, 3)


def counts(truth: Truth, motor_deg):
    return np.round(np.asarray(motor_deg) / 360.0 * truth.encoders.motor_counts_per_turn)


def step_deg(mechanics, servo, duration_s: float) -> np.ndarray:
    """Returns the motor angle over the substeps after a step of one degree."""
    target = FINE.motor_counts_per_turn / 360.0
    servo = replace(servo, interpolation="hold", dead_time_ms=0.0, rest_window_deg=0.0)
    machine = ForeignMachine(mechanics, servo, FINE, 0)
    return np.degrees(run(machine, np.full(round(duration_s / 0.004), target), 0.004)[:, 0])


def stiff(truth: Truth):
    """Returns linear mechanics with a rigid spring and without any friction."""
    mechanics = replace(linear(truth), viscous_nm_s_per_rad=0.0, load_viscous_nm_s_per_rad=0.0)
    stiffness = mechanics.load_inertia_kg_m2 * (math.tau * 600.0) ** 2
    damping = 0.4 * math.sqrt(stiffness * mechanics.load_inertia_kg_m2)
    return replace(mechanics, stiffness_nm_per_rad=stiffness, damping_nm_s_per_rad=damping)


def test_on_a_stiff_axis_the_steps_are_those_of_the_textbook():
    truth = draw(1, "piv")
    mechanics = stiff(truth)
    inertia = mechanics.inertia_kg_m2
    time_s = (np.arange(round(0.4 / DT_S)) + 1) * DT_S
    frame = replace(truth.servo, current_lag_ms=0.02, period_ms=0.1)

    # Position and speed feedback alone: second order, w^2 = Kv Kp / J, 2 d w = Kv / J.
    rate, damping = 60.0, 0.6
    law = Piv(rate / (2.0 * damping), 2.0 * damping * rate * inertia, 0.0, 0.0, 0.0, 0.0)
    turning = rate * math.sqrt(1.0 - damping**2)
    ringing = np.cos(turning * time_s) + damping * rate / turning * np.sin(turning * time_s)
    expected = 1.0 - np.exp(-damping * rate * time_s) * ringing
    got = step_deg(mechanics, replace(frame, law=law), 0.4)
    assert got == pytest.approx(expected, abs=0.01)
    overshoot = math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    assert got.max() - 1.0 == pytest.approx(overshoot, abs=0.01)

    # If the correct inertia is fed forward, the motor follows the critically damped reference model exactly.
    law = StateFeedback(10.0, 1.0, 1.0, 8.0, 1.0, 40.0, inertia)
    rate = math.tau * law.reference_hz
    expected = 1.0 - (1.0 + rate * time_s) * np.exp(-rate * time_s)
    got = step_deg(mechanics, replace(frame, law=law), 0.4)
    assert got == pytest.approx(expected, abs=0.02)
    settled_s = time_s[np.flatnonzero(np.abs(got - 1.0) > 0.02)[-1]]
    assert settled_s == pytest.approx(5.83 / rate, rel=0.05)  # (1 + x) exp(-x) = 0.02 at x = 5.83


def test_the_load_at_rest_follows_the_static_law(axis):
    machine, cycle_s = axis.machine(), axis.cycle_ms / 1000.0
    motor_deg, ratio = [], axis.mechanics.ratio
    for target_deg in (43.56, 87.12, 80.0, 83.0, 20.0, 300.0, 297.0):
        rows = run(machine, np.full(round(2.0 / cycle_s), counts(axis, target_deg)), cycle_s)
        path = np.degrees(rows[:, 0])
        turns = np.flatnonzero(np.diff(np.sign(np.diff(path))) != 0) + 1
        motor_deg += [*path[turns], path[-1]]
        expected = static_error_arcsec(axis.mechanics, np.array(motor_deg))[-1]
        assert (machine.true_load_deg - machine.true_motor_deg / ratio) * 3600.0 == pytest.approx(
            expected, abs=0.05
        )
        count_deg = 360.0 / axis.encoders.motor_counts_per_turn
        assert machine.true_motor_deg == pytest.approx(
            target_deg, abs=max(REST_DEG, count_deg) + 0.5 * count_deg
        )
        assert np.ptp(path[-round(0.2 / DT_S) :]) <= 0.05  # the axis does not hunt


def test_limits_hold_and_integrators_recover(axis):
    machine, cycle_s = axis.machine(), axis.cycle_ms / 1000.0
    machine.torque_limit_permille = 800.0
    far_deg = 3000.0
    rows = run(machine, np.full(round(4.0 / cycle_s), counts(axis, far_deg)), cycle_s)
    limit_nm = 0.8 * axis.servo.rated_torque_nm
    assert np.abs(rows[:, 2]).max() <= limit_nm * (1.0 + 1e-9)
    assert np.abs(np.diff(rows[:, 0])).max() / DT_S < 1.3 * axis.servo.speed_limit_rad_s
    assert machine.true_motor_deg == pytest.approx(far_deg, abs=0.1)
    machine.torque_limit_permille = 1e9
    assert machine.torque_limit_permille == 10.0 * axis.servo.torque_limit_percent
