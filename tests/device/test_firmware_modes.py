"""Operating modes CSP, IP, PP and HM as a master sees them."""

import pytest

from hdbridge.device.behaviour import Behaviour, Controlword
from hdbridge.sim.lockstep import lockstep_bench

from .conftest import EDS, RawMaster

REACHED, LIMIT, BIT_12, BIT_13, REFERENCED = 0x0400, 0x0800, 0x1000, 0x2000, 0x4000


def set_point(master, target: int, bits: int = 0) -> None:
    """Performs the handshake of profile position mode, up to the withdrawn request."""
    master.put(0x607A, 0, target, 4)
    master.control(0x1F | bits)
    assert master.statusword & BIT_12
    master.control(0x0F | bits)


# interpolated position


@pytest.fixture
def ip(master):
    """Provides ``ip(word, target)``: one cycle in interpolated position mode (RPDO1: 6040h, 60C1h:01)."""
    master.map(0x1400, 1, 0x201, 0x60400010, 0x60C10120)
    master.put(0x6060, 0, 7, 1)
    master.nmt(1)
    for word in (0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F):
        master.cycle(word)
    return master.cycle


def test_ip_holds_its_position_until_interpolation_is_enabled(ip, master, motor):
    for _ in range(3):
        feedback = ip(0x0F, 500)
    assert (master.state, motor.motor_counts, feedback[0] & 0x1000) == ("enabled", 0, 0)
    for _ in range(3):
        feedback = ip(0x1F, 500)
    assert (motor.motor_counts, feedback[0] & 0x1000) == (500, 0x1000)
    for _ in range(3):
        feedback = ip(0x0F, 900)
    assert (motor.motor_counts, feedback[0] & 0x1000) == (500, 0)


def test_ip_starts_at_the_actual_position(ip, master, motor):
    for word in (0x07, 0x07, 0x0F, 0x0F):
        ip(word, 12_345)
    assert motor.motor_counts == 0
    assert master.read(0x60C1, 1) == 12_345  # of the RPDO; interpolation is not enabled


def test_a_lost_master_stops_an_axis_in_ip(ip, master):
    master.put(0x6007, 0, 3, 2)
    ip(0x1F, 10)
    ip(0x1F, 20)
    master.nmt(0x80)
    assert master.state in ("quick stop", "disabled")


# cyclic synchronous position


def test_csp_interpolates_evenly_over_the_period(master, motor):
    seen = []
    follow = motor.follow
    motor.follow = lambda start, end, substeps: (
        seen.append((start, end, substeps)),
        follow(start, end, substeps),
    )
    master.enable_csp()
    seen.clear()
    for target in (10, 30, 60, 60):
        status = master.cycle(0x0F, target)[0]
    master.cycle(0x0F, 60)
    assert seen == [(0.0, 0.0, 8), (0.0, 10.0, 8), (10.0, 30.0, 8), (30.0, 60.0, 8), (60.0, 60.0, 8)]
    assert status & BIT_12


def test_csp_never_exceeds_the_motors_speed(master, motor):
    master.put(0x6080, 0, 60, 4)  # 8000 counts/s, 32 per period
    master.put(0x6065, 0, 0xFFFFFFFF, 4)
    master.enable_csp()
    master.cycle(0x0F, 100)
    rows = [master.cycle(0x0F, 100) for _ in range(6)]
    assert [row[1] for row in rows] == [0, 32, 64, 96, 100, 100]
    assert [bool(row[0] & LIMIT) for row in rows] == [False, True, True, True, False, False]


def test_csp_adds_the_position_offset(master):
    master.enable_csp()
    master.put(0x60B0, 0, 7, 4)
    for _ in range(3):
        row = master.cycle(0x0F, 100)
    assert row[1] == 107


@pytest.mark.parametrize("target", [150, -150, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("start", [90, -90])
def test_targets_stay_within_the_software_limits(master, start, target):
    master.put(0x607D, 1, -100, 4)
    master.put(0x607D, 2, 100, 4)
    master.enable_csp()
    for _ in range(4):
        master.cycle(0x0F, start)
    for _ in range(4):
        row = master.cycle(0x0F, target)
    assert row[1] == (100 if target > 0 else -100)  # on that side, however far away the target is
    assert row[0] & LIMIT
    for _ in range(3):
        row = master.cycle(0x0F, 0)
    assert row[1] == 0
    assert not row[0] & LIMIT


def test_an_axis_beyond_a_limit_may_only_return(master, motor):
    motor.position = 500.0
    master.put(0x607D, 1, -100, 4)
    master.put(0x607D, 2, 100, 4)
    master.enable_csp()
    assert motor.position == 500.0
    for target, reached in ((600, 500), (450, 450), (480, 450), (50, 50), (200, 100)):
        for _ in range(4):
            row = master.cycle(0x0F, target)
        assert row[1] == reached


def test_positions_wrap_around_int32(master, motor):
    motor.position = float(2**31 - 10)
    master.wait(0.01)
    master.enable_csp()
    position = 2**31 - 10
    for _ in range(5):
        position += 5
        row = master.cycle(0x0F, (position + 2**31) % 2**32 - 2**31)
    for _ in range(2):
        row = master.cycle(0x0F, (position + 2**31) % 2**32 - 2**31)
    assert motor.position == position == 2**31 + 15
    assert row[1] == row[4] == -(2**31) + 15
    assert row[3] == (round(position * 7.2) + 2**31) % 2**32 - 2**31


@pytest.mark.parametrize("home", [0, 1000])
def test_polarity_reverses_position_and_velocity(master, motor, home):
    master.put(0x607E, 0, 0xC0, 1)
    master.put(0x607C, 0, home, 4)
    master.enable(6)
    master.control(0x1F)
    master.control(0x00)
    master.enable_csp()
    target = master.cruise(40, 10, home)
    assert motor.velocity_counts_s == -10_000.0
    assert master.read(0x606C) == master.read(0x606B) == 10_000
    for _ in range(2):
        row = master.cycle(0x0F, target)
    assert row[1] == row[4] == target == home + 400
    assert motor.position == -400.0
    assert master.read(0x6063) == -400


def test_a_mode_change_in_motion_brakes_first(master, motor):
    master.put(0x6084, 0, 50_000, 4)
    master.enable_csp()
    master.cruise(40, 10)
    start = motor.position
    master.put(0x6060, 0, 1, 1)
    master.wait(0.3)
    assert motor.velocity_counts_s == 0.0
    assert motor.position - start == pytest.approx(1000.0, abs=1.0)
    assert master.state == "enabled"


def test_the_torque_limit_reaches_the_loops(master, motor):
    master.put(0x6072, 0, 500, 2)
    assert motor.torque_limit_permille == 500
    master.enable()
    motor.torque_permille = -500
    assert master.statusword & LIMIT
    assert master.read(0x6077) == -500
    motor.torque_permille = -499
    assert not master.statusword & LIMIT
    master.nmt(129)
    assert motor.torque_limit_permille == 1000


# profile position


def test_pp_target_reached_needs_the_window_for_its_time(master, motor):
    master.put(0x6068, 0, 100, 2)
    master.enable(1)
    set_point(master, 100)
    master.wait(0.12)
    assert motor.position == 100
    assert not master.statusword & REACHED
    master.wait(0.15)
    assert master.statusword & REACHED
    motor.position = 120.0
    motor.stuck = True
    master.wait(0.01)
    assert not master.statusword & REACHED


@pytest.mark.parametrize("behaviour", [Behaviour(), Behaviour(controlword=Controlword.LEVEL)])
def test_a_halt_in_the_word_that_enables_holds_the_axis(motor, behaviour):
    """ros2_canopen enables with halt set, and clears it afterwards."""
    with lockstep_bench(motor, EDS, behaviour=behaviour) as (bus, clock, node):
        master = RawMaster(bus, clock, node, motor)
        master.put(0x6060, 0, 8, 1)
        master.nmt(1)
        for word in (0x0106, 0x0107, 0x010F):
            master.cycle(word)
        for _ in range(5):
            status, position, *_ = master.cycle(0x010F, 2000)
            assert position == 0
        assert status & 0x046F == 0x0427
        for _ in range(5):
            master.cycle(0x000F, 2000)
        assert master.read(0x6064) == 2000


# homing


def test_homing_in_motion_is_an_error(master, motor):
    master.put(0x6098, 0, 37, 1)
    master.enable(6)
    motor.velocity_counts_s = 5000.0
    master.control(0x1F)
    status = master.statusword
    assert status & BIT_13
    assert not status & (BIT_12 | REFERENCED)
    assert master.read(0x6064) == 0


def test_feedback_objects(master, motor):
    motor.position = 100.0
    motor.torque_permille = -12
    master.wait(0.01)
    assert master.read(0x60E4, 1) == 720
    assert master.read(0x6063) == 100
    assert master.read(0x6077) == -12
    assert master.read(0x2100) == 234
    assert master.read(0x2101) == -1250
    master.enable_csp()
    target = master.cruise(10, 20)
    assert master.read(0x60E5, 1) == pytest.approx(7.2 * 2500, rel=0.02)
    assert master.read(0x60FC) == pytest.approx(target, abs=10)


@pytest.mark.parametrize("way", [2**31 - 1, -(2**31)])
@pytest.mark.parametrize("start", [90, -90])
def test_a_relative_move_ends_at_the_limit_on_its_side(master, start, way):
    master.put(0x607D, 1, -100, 4)
    master.put(0x607D, 2, 100, 4)
    master.enable(1)
    set_point(master, start)
    master.wait(2.0)
    set_point(master, way, 0x40)
    master.wait(2.0)
    assert master.read(0x6064) == (100 if way > 0 else -100)
