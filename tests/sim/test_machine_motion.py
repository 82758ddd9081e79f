"""The simulated axis in motion and at rest: loops, friction, encoders, heat."""

import math
import statistics
from itertools import pairwise
from typing import Any

import pytest
from support.bare_axis import CYCLE_S, DEG_PER_COUNT, STEP_COUNTS, Axis, static_arcsec, trajectory, truth

from hdbridge.sim.machine import Machine
from hdbridge.sim.servo import Notch, Servo
from hdbridge.sim.truth.motor import TrueNotch


@pytest.mark.parametrize("profile", ["article", "demo"])
def test_a_settled_step_stands_at_the_static_law(profile: str) -> None:
    known = truth(profile)
    axis = Axis(known)
    for direction in (1, -1):
        for step in range(15):
            axis.move(direction * STEP_COUNTS)
            assert axis.overshoot_deg < 0.002
            if step == 0:
                continue  # this move brings the hysteresis to its own branch
            expected = static_arcsec(known, axis.target * DEG_PER_COUNT, direction)
            assert axis.error_arcsec == pytest.approx(expected, abs=0.25)
            assert axis.machine.motor_counts == axis.target


def test_the_time_step_does_not_matter_once_settled() -> None:
    errors = []
    for substep_ms in (1.0, 0.5, 0.25):
        axis = Axis(truth(substep_ms=substep_ms))
        axis.move(STEP_COUNTS)
        axis.move(-STEP_COUNTS // 4)
        axis.move(STEP_COUNTS)
        errors.append(axis.error_arcsec)
    assert max(errors) - min(errors) < 0.15


@pytest.mark.parametrize("profile", ["article", "demo"])
def test_a_stopped_axis_sticks(profile: str) -> None:
    axis = Axis(truth(profile))
    axis.move(STEP_COUNTS)
    axis.move(-STEP_COUNTS // 2, settle_s=1.0)
    stood_deg, load_deg = axis.machine.true_motor_deg, axis.machine.true_load_deg
    for _ in range(10):
        axis.hold(1.0)
        assert axis.machine.true_motor_deg == stood_deg
        assert axis.machine.velocity_counts_s == 0.0
    assert axis.machine.true_load_deg == pytest.approx(load_deg, abs=1e-9)


def test_the_motor_follows_well_within_the_drive_s_following_error_window() -> None:
    axis = Axis(truth())
    worst_deg = 0.0
    for position in trajectory(20 * STEP_COUNTS):
        axis.to(position)
        worst_deg = max(worst_deg, abs(position - axis.machine.motor_counts) * DEG_PER_COUNT)
    # At 1,000 motor degrees per second the filter on the demand, two lags of 1 ms, is 2 degrees.
    assert 1.5 < worst_deg < 2.5


def test_a_demand_between_counts_is_followed_between_counts() -> None:
    machine = Machine(truth(), 1)
    for cycle in range(50):
        machine.follow(10.0 * cycle, 10.0 * (cycle + 1), 8)
    machine.follow(500.0, 500.4, 8)
    for _ in range(100):
        machine.follow(500.4, 500.4, 8)
    # Within the hunting band, 16 of 64 interpolated steps, the integral rests.
    assert machine.true_motor_deg / DEG_PER_COUNT == pytest.approx(500.4, abs=0.26)


def test_loops_without_friction_feedforward_keep_their_integral_at_a_reversal() -> None:
    plain = {"friction_feedforward_nm": 0.0, "inertia_feedforward_kg_m2": 0.0, "load_feedforward": None}
    loops = Servo(truth(**{f"servo__{name}": value for name, value in plain.items()}))
    places = [0.02 * step for step in range(40)]
    forth = [loops.answer_nm(place, 40.0, 0.0) for place in places]
    back = [loops.answer_nm(place, -40.0, 0.0) for place in reversed(places)]  # still ahead of the motor
    steps = [abs(later - earlier) for earlier, later in pairwise([*forth, *back])]
    # The demanded speed changes by twice the initial one.
    assert max(steps) < 2.2 * max(steps[:39])


def test_switching_on_does_not_move_an_axis_that_stands_between_counts() -> None:
    axis = Axis(truth())
    for position in trajectory(STEP_COUNTS)[:20]:
        axis.to(position)
    machine = axis.machine
    machine.coast(1000, braked=False)
    stood_deg = machine.true_motor_deg
    assert abs(stood_deg / DEG_PER_COUNT - machine.motor_counts) > 0.05, (
        "the test needs a motor off its count"
    )
    for _ in range(250):
        machine.follow(machine.motor_counts, machine.motor_counts, 8)
    assert machine.true_motor_deg == stood_deg


def test_the_brake_stops_sooner_than_friction() -> None:
    ways = []
    for braked in (False, True):
        axis = Axis(truth())
        for position in trajectory(4 * STEP_COUNTS)[:40]:
            axis.to(position)
        before_deg = axis.machine.true_motor_deg
        axis.machine.coast(2000, braked)
        ways.append(axis.machine.true_motor_deg - before_deg)
        assert axis.machine.velocity_counts_s == 0.0
        assert axis.machine.torque_permille == 0
    assert 0.0 < ways[1] < 0.2 * ways[0]


def test_the_torque_stays_within_its_limit() -> None:
    axis = Axis(truth())
    machine = axis.machine
    machine.torque_limit_permille = 120.0
    peak = 0
    for _ in range(3):
        machine.follow(axis.target, axis.target + 4000, 8)  # 45 turns per second at once
        axis.target += 4000
        peak = max(peak, abs(machine.torque_permille))
    for _ in range(500):
        axis.to(axis.target)
        peak = max(peak, abs(machine.torque_permille))
    assert peak == 120
    assert abs(machine.motor_counts - axis.target) <= 1, "it reaches its target nevertheless"


def test_the_torque_limit_cannot_be_set_beyond_the_drive_s_own() -> None:
    machine = Machine(truth(), 1)
    machine.torque_limit_permille = 99_999.0
    assert machine.torque_limit_permille == pytest.approx(3000.0)


def test_less_torque_than_friction_does_not_move_the_motor() -> None:
    machine = Machine(truth(), 1)
    machine.torque_limit_permille = 50.0
    for _ in range(100):
        machine.follow(5000.0, 5000.0, 8)
    assert machine.true_motor_deg == 0.0
    assert machine.torque_permille == 50


@pytest.mark.parametrize("direction", [1, -1])
def test_the_encoders_count_whole_counts_in_their_direction_from_their_zero(direction: int) -> None:
    known = truth(
        motor__encoder__direction=direction,
        motor__encoder__zero_counts=1234,
        load__encoder__direction=direction,
        load__encoder__zero_counts=-77,
    )
    machine = Machine(known, 1)
    rest_deg = machine.true_load_deg
    assert machine.motor_counts == 1234
    assert machine.load_counts == math.floor(direction * rest_deg * 8000 - 77 + 0.5)
    for cycle in range(100):
        machine.follow(1234 + 20 * cycle, 1234 + 20 * (cycle + 1), 8)
    for _ in range(100):
        machine.follow(3234, 3234, 8)
    assert machine.true_motor_deg == pytest.approx(direction * 90.0, abs=0.02)
    assert machine.motor_counts == 3234
    assert machine.load_counts == math.floor(direction * machine.true_load_deg * 8000 - 77 + 0.5)


def record(seed: int) -> list[tuple[int, int, int, float, float]]:
    axis = Axis(truth("demo"), seed)
    rows = []
    for distance in (STEP_COUNTS, -300, 17):
        for position in trajectory(distance):
            axis.to(position)
            m = axis.machine
            rows.append(
                (m.motor_counts, m.load_counts, m.torque_permille, m.true_load_deg, m.velocity_counts_s)
            )
        axis.target = 0
    return rows


def test_the_seed_affects_only_load_encoder_noise() -> None:
    one, other = record(3), record(4)
    assert [row[1] for row in one] != [row[1] for row in other]
    assert [row[:1] + row[2:] for row in one] == [row[:1] + row[2:] for row in other]


def test_the_noise_of_the_load_encoder_is_as_stated() -> None:
    axis = Axis(truth("demo", load__encoder__noise_arcsec=2.0))
    axis.move(STEP_COUNTS, settle_s=0.5)
    readings = []
    for _ in range(1000):
        axis.hold(CYCLE_S)
        assert axis.machine.load_counts == axis.machine.load_counts
        readings.append(axis.machine.load_counts * 0.45)
    assert statistics.pstdev(readings) == pytest.approx(2.0, rel=0.1)


def test_friction_warms_the_axis_and_rest_lets_it_cool() -> None:
    known = truth(
        temperature={"ambient_c": 20.0, "resistance_k_per_w": 10.0, "time_constant_s": 0.5},
    )
    machine = Machine(known, 1)
    for cycle in range(750):
        machine.follow(40.0 * cycle, 40.0 * (cycle + 1), 8)  # 10,000 counts/s: 7.85 rad/s
    loss_w = (0.03 + 2e-4 * 7.854) * 7.854
    assert machine.temperature_c == pytest.approx(20.0 + 10.0 * loss_w, rel=0.01)
    machine.coast(10_000, braked=False)
    assert machine.temperature_c == pytest.approx(20.0, abs=0.01)


def test_load_and_flexspline_orders_are_seen_at_their_own_angles() -> None:
    one = [{"order": 1, "amplitude_arcsec": 30.0, "phase_deg": 0.0}]
    for key, angle in (("load_orders", 1 / 50), ("flexspline_orders", 1 + 1 / 50)):
        known = truth(gear__motor_orders=[], gear__hysteresis=None, **{f"gear__{key}": one})
        axis = Axis(known)
        axis.move(50 * 8000 // 3, settle_s=0.3)
        expected = 30.0 * math.cos(math.radians(axis.target * DEG_PER_COUNT * angle))
        assert axis.error_arcsec == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize(
    "law",
    [
        {"law": "maxwell_slip", "elements": [{"limit_arcsec": 25, "yield_deg": 2}]},
        {"law": "bouc_wen", "offset_arcsec": 25, "yield_deg": 3},
        None,
    ],
)
def test_the_gear_has_the_hysteresis_law_of_the_truth_file(law: dict[str, Any] | None) -> None:
    axis = Axis(truth(gear__motor_orders=[], gear__hysteresis=law))
    offset = 25.0 if law else 0.0
    axis.move(STEP_COUNTS)
    assert axis.error_arcsec == pytest.approx(offset, abs=0.2)
    axis.move(-STEP_COUNTS)
    assert axis.error_arcsec == pytest.approx(-offset, abs=0.2)


# ---------------------------------------------------------------- blocks of the servo


def following_error_ms(**changes: Any) -> float:
    """Returns following error over speed at a constant speed; the axis has no friction by default."""
    smooth: dict[str, Any] = {
        "motor__coulomb_nm": 0.0, "motor__viscous_nm_s_per_rad": 0.0, "gear__motor_orders": (),
        "gear__hysteresis": None, "load__coulomb_nm": 0.0, "load__viscous_nm_s_per_rad": 0.0,
    }  # fmt: skip
    known = truth(**(smooth | changes))
    machine, errors = Machine(known, 1), []
    for cycle in range(500):
        machine.follow(100.0 * cycle, 100.0 * (cycle + 1), round(CYCLE_S / machine.dt_s))
        errors.append(100.0 * (cycle + 1) - machine.motor_reading)
    return 1e3 * statistics.mean(errors[-100:]) / (100.0 / CYCLE_S)


def test_a_moving_average_delays_the_demand_by_half_its_length() -> None:
    without, averaged = following_error_ms(), following_error_ms(servo__moving_average_ms=3.3)
    assert averaged - without == pytest.approx(1.65, abs=0.02)


def test_filters_on_speed_and_torque_make_no_following_error_at_a_constant_speed() -> None:
    notch = {"frequency_hz": 300.0, "depth": 0.3, "width": 0.5}
    filtered = following_error_ms(servo__speed_filter_ms=0.3, servo__torque_filter_ms=0.2, servo__notch=notch)
    assert filtered == pytest.approx(following_error_ms(), abs=0.02)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_disturbance_observer_supplies_its_share_of_the_friction(share: float) -> None:
    """If the integral is slow, the position error supplies the rest of the torque."""
    slow = {"servo__integral_time_ms": 1e4}
    rubs, slides = (
        following_error_ms(
            **slow,
            motor__coulomb_nm=friction_nm,
            servo__observer={"frequency_hz": 40.0, "share": share, "inertia_kg_m2": 3e-5},
        )
        for friction_nm in (0.03, 0.0)
    )
    without = following_error_ms(**slow, motor__coulomb_nm=0.03)
    without -= following_error_ms(**slow, motor__coulomb_nm=0.0)
    assert without > 0.1
    assert rubs - slides == pytest.approx((1.0 - share) * without, abs=0.05 * without)


def test_an_integral_of_the_position_error_needs_no_feed_forward_at_a_constant_speed() -> None:
    """PI control of the speed leaves an error of the speed over the position gain."""
    filtered_ms = following_error_ms()
    gain = truth().servo.position_gain_per_s
    forward = {"servo__velocity_feedforward": 0.0, "servo__integral_time_ms": 60.0}
    of_speed = following_error_ms(**forward)
    of_position = following_error_ms(**forward, servo__integral_of="position")
    assert of_speed - filtered_ms == pytest.approx(1e3 / gain, rel=0.02)
    assert of_position == pytest.approx(filtered_ms, abs=0.05)


@pytest.mark.parametrize(("frequency_hz", "gain"), [(0.0, 1.0), (120.0, 0.25), (900.0, 1.0)])
def test_a_notch_has_its_depth_at_its_frequency_and_nothing_far_off(frequency_hz: float, gain: float) -> None:
    step_s = 0.0005
    notch = Notch(TrueNotch(frequency_hz=120.0, depth=0.25, width=0.4), step_s)
    shown = [notch.notched_nm(math.cos(math.tau * frequency_hz * number * step_s)) for number in range(4000)]
    assert max(shown[2000:]) == pytest.approx(gain, rel=0.03)


@pytest.mark.parametrize("frequency_hz", [30.0, 480.0, 900.0])
def test_a_notch_is_stable_at_any_frequency(frequency_hz: float) -> None:
    """At a substep of 1 ms the last frequency is beyond half the rate."""
    notch = Notch(TrueNotch(frequency_hz=frequency_hz, depth=0.0, width=5.0), 0.001)
    assert max(abs(notch.notched_nm(1.0 if number % 2 else -1.0)) for number in range(2000)) < 3.0
    assert [notch.notched_nm(1.0) for _ in range(2000)][-1] == pytest.approx(1.0)
