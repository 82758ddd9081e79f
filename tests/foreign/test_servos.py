"""The foreign servos: response in closed form, settling, limits, orders in motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from foreign.draw import REST_DEG, Truth, draw
from foreign.machine import Encoders, ForeignMachine
from foreign.mechanics import ARCSEC, DT_S, MaxwellSlip, static_error_arcsec
from foreign.response import motor_response
from foreign.servos import INTERPOLATIONS, STRUCTURES, Piv, StateFeedback

FINE = Encoders(1 << 20, 64, 0.0, 1 << 23, 0.0)
AXES = [(1, structure) for structure in STRUCTURES]


@pytest.fixture(params=AXES, ids=[f"{structure}-{seed}" for seed, structure in AXES])
def axis(request) -> Truth:
    return draw(*request.param)


def linear(truth: Truth):
    """Mechanics without friction and transmission error."""
    return replace(truth.mechanics, coulomb_nm=0.0, motor_orders=(), hysteresis=MaxwellSlip(()))


def run(machine: ForeignMachine, targets: np.ndarray, cycle_s: float) -> np.ndarray:
    """Motor and load angle (rad) and torque (Nm) after each substep; one set-point in counts per cycle."""
    substeps = round(cycle_s / DT_S)
    trace = np.zeros((targets.size, substeps, 3))
    before = machine.motor_counts
    for target, rows in zip(targets.tolist(), trace, strict=True):
        machine.follow(before, target, substeps, rows)
        before = target
    return trace.reshape(-1, 3)


def counts(truth: Truth, motor_deg):
    return np.round(np.asarray(motor_deg) / 360.0 * truth.encoders.motor_counts_per_turn)


def cruise(truth: Truth, speed_deg_s: float, duration_s: float) -> tuple[ForeignMachine, np.ndarray]:
    """The axis at even speed of the load: `run` after the first one and a half seconds."""
    cycle_s, machine = truth.cycle_ms / 1000.0, truth.machine()
    time_s = np.arange(1, round((duration_s + 1.5) / cycle_s)) * cycle_s
    path_deg = np.where(time_s < 0.5, time_s**2, time_s - 0.25) * speed_deg_s * truth.mechanics.ratio
    return machine, run(machine, counts(truth, path_deg), cycle_s)[round(1.5 / DT_S) :]


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_a_chirp_finds_the_response_in_closed_form(axis, interpolation):
    servo = replace(axis.servo, interpolation=interpolation, torque_limit_percent=1e6, speed_limit_rad_s=1e6)
    mechanics, cycle_s = linear(axis), 0.004
    time_s = np.arange(3000) * cycle_s
    octaves = np.log(240.0) / 9.0  # from 0.5 to 120 Hz in 9 s, then rest
    chirp = 2e4 * np.sin(math.pi / octaves * np.expm1(octaves * time_s))
    chirp *= np.clip(np.minimum(time_s, 9.0 - time_s), 0.0, 0.5) / 0.5
    motor = run(ForeignMachine(mechanics, servo, FINE, 0), chirp[1:], cycle_s)[:, 0] / math.tau * (1 << 20)
    frequency_hz = np.array([1.0, 2.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 60.0, 80.0, 100.0])
    turning = -1j * math.tau * frequency_hz[:, None]
    motor_time_s = (np.arange(motor.size) + 1) * DT_S
    spectrum = np.array([np.exp(row * motor_time_s) @ motor for row in turning]) * DT_S
    measured = spectrum / (np.exp(turning * time_s) @ chirp * cycle_s)
    expected = motor_response(mechanics, servo, frequency_hz, cycle_s)
    assert measured[0] == pytest.approx(expected[0], rel=1e-3)
    assert np.abs(measured - expected) == pytest.approx(0.0, abs=5e-3 * np.abs(expected).max())


def step_deg(mechanics, servo, duration_s: float) -> np.ndarray:
    """Motor angle over the substeps after a step of one degree."""
    target = FINE.motor_counts_per_turn / 360.0
    servo = replace(servo, interpolation="hold", dead_time_ms=0.0, rest_window_deg=0.0)
    machine = ForeignMachine(mechanics, servo, FINE, 0)
    return np.degrees(run(machine, np.full(round(duration_s / 0.004), target), 0.004)[:, 0])


def stiff(truth: Truth):
    """Linear mechanics whose load follows at once, without any friction."""
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

    # With the right inertia fed forward the motor is the critically damped reference model.
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
        assert np.ptp(path[-round(0.2 / DT_S) :]) <= 0.05  # does not hunt


@pytest.mark.parametrize("share", [0.01, 0.2, 1.0])
def test_at_even_speed_each_order_shows_at_its_frequency_with_the_amplitude_in_closed_form(axis, share):
    speed = share * axis.velocity_deg_s
    _, rows = cruise(axis, speed, max(2.0, 360.0 * 2.0 / axis.mechanics.ratio / speed))
    orders = axis.mechanics.motor_orders
    time_s = np.arange(len(rows)) * DT_S
    columns = [np.ones_like(time_s), time_s]
    for each in orders:
        columns += [np.cos(each.order * rows[:, 0]), -np.sin(each.order * rows[:, 0])]
    fitted = np.linalg.lstsq(np.array(columns).T, rows[:, 1], rcond=None)[0][2:] / ARCSEC
    measured = fitted[0::2] + 1j * fitted[1::2]
    frequency_hz = np.array([each.order for each in orders]) * speed * axis.mechanics.ratio / 360.0
    true = [each.amplitude_arcsec * np.exp(1j * math.radians(each.phase_deg)) for each in orders]
    expected = np.array(true) * axis.ripple(frequency_hz)
    # The tooth error shakes the motor through its slope as well: mixed orders, second order in the error.
    assert np.abs(measured - expected) == pytest.approx(0.0, abs=0.06 * np.abs(expected).max())


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
