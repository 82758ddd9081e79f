"""Enabling, moving, homing and faults; a drive is never left enabled."""

import errno
import math
import struct
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from hdbridge.axis import AxisConfig
from hdbridge.drive import Drive, Mode, State
from hdbridge.errors import BusError, DriveError, InputError, TransitionError

from .conftest import Later, holding


@pytest.fixture
def drive(bus: Any, clock: Any, slave: Any, axis: AxisConfig) -> Iterator[Drive]:
    with Drive(bus, axis, clock, slave.od, sdo_timeout_s=0.1) as drive:
        drive.boot()
        slave.controlwords.clear()
        yield drive
        bus.down = None
        slave.node.faults.silent = False


def test_enabling_walks_every_state_and_moves_nothing(drive: Drive, slave: Any) -> None:
    slave.values[0x607A, 0] = 99_999
    drive.enable(Mode.PP)
    assert slave.state is State.OPERATION_ENABLED
    assert slave.controlwords == [0x06, 0x07, 0x0F]
    assert slave.values[0x607A, 0] == 1000 == slave.position
    assert slave.values[0x6060, 0] == Mode.PP
    drive.disable()
    assert slave.controlwords[3:] == [0x07, 0x00]
    assert slave.state is State.SWITCH_ON_DISABLED


def test_in_csp_power_is_left_to_the_cycle(drive: Drive, slave: Any) -> None:
    drive.enable()
    assert slave.state is State.SWITCH_ON_DISABLED
    assert slave.values[0x6060, 0] == Mode.CSP
    image = drive.image
    assert (image.motor_counts, image.load_counts) == (1000, 7200)
    assert image.power.state is State.SWITCH_ON_DISABLED
    ((can_id, data),) = image.pack_rpdo_idle(image.motor_counts)
    assert (can_id, struct.unpack("<Hi", data)) == (0x201, (0x06, 1000))


def test_before_the_boot_nothing_is_enabled(bus, clock, slave, axis, sent):
    with Drive(bus, axis, clock, slave.od) as drive, pytest.raises(TransitionError, match="boot"):
        drive.enable()
    assert sent == []


def test_an_unsupported_or_refused_mode(bus: Any, clock: Any, slave: Any, axis: AxisConfig) -> None:
    slave.values[0x6502, 0] = 0x80
    with Drive(bus, axis, clock, slave.od) as drive:
        drive.boot()
        with pytest.raises(DriveError, match="no mode PP"):
            drive.enable(Mode.PP)
        slave.scripts[0x6060, 0] = holding(0)
        with pytest.raises(DriveError, match=r"6061h:00.*shows 0 after mode 8"):
            drive.enable()
    assert slave.state is State.SWITCH_ON_DISABLED


def test_a_target_that_cannot_be_preloaded_prevents_enabling(drive: Drive, slave: Any) -> None:
    slave.scripts[0x607A, 0] = holding(0)
    with pytest.raises(DriveError, match="reads back 0; the drive was not enabled"):
        drive.enable(Mode.PP)
    assert slave.state is State.SWITCH_ON_DISABLED


def test_an_axis_outside_its_limits_is_not_enabled(drive: Drive, slave: Any) -> None:
    slave.motor.position = 500_000.0
    drive.wait(0.01)
    with pytest.raises(DriveError, match="stands at 450 deg"):
        drive.enable(Mode.PP)
    drive.enable(Mode.HM)


def test_a_drive_ignoring_a_transition(drive: Drive, slave: Any) -> None:
    ignored = holding(0)
    slave.scripts[0x6040, 0] = lambda request: ignored(request) if request[4] & 0x0F == 0x07 else None
    with pytest.raises(
        TransitionError, match=r"'switched on' did not occur within 1 s.*'ready to switch on'"
    ):
        drive.enable(Mode.PP)


@pytest.mark.parametrize("stale", [0x0000, 0x0033, 0xFFFF])
def test_a_stale_or_invalid_statusword_never_counts_as_enabled(drive: Drive, slave: Any, stale: int) -> None:
    slave.scripts[0x6041, 0] = holding(stale)
    with pytest.raises(DriveError):
        drive.enable(Mode.PP)
    assert drive.image.power.state is not State.OPERATION_ENABLED
    slave.scripts.clear()


def test_a_profile_move_arrives(drive: Drive, slave: Any, clock: Any, sent: Any) -> None:
    start_s = clock.now()
    positions = drive.move_to(2.0)
    assert positions.motor_counts == round(2.0 * 50 * 8000 / 360)
    assert positions.motor_deg == pytest.approx(100.0, abs=0.03)
    assert clock.now() - start_s > 0.05
    assert sent.count((0x77F, b"\x05")) >= 3
    drive.move_to(-1.0, velocity_deg_s=10.0)
    assert slave.values[0x6081, 0] == round(10 * 50 * 8000 / 360)


@pytest.mark.parametrize("target", [math.nan, math.inf, -math.inf, 400.01, -1e9])
def test_impossible_targets_are_refused_before_anything_is_sent(drive, slave, target):
    drive.enable(Mode.PP)
    before = list(slave.sdo_order)
    with pytest.raises(InputError, match="nothing was sent"):
        drive.move_to(target)
    assert slave.sdo_order == before
    assert slave.position == 1000


@pytest.mark.parametrize("velocity", [0.0, -1.0, 20.1, math.nan, math.inf])
def test_speeds_beyond_the_limit_are_refused(drive: Drive, slave: Any, velocity: float) -> None:
    drive.enable(Mode.PP)
    with pytest.raises(InputError, match=r"limits\.velocity_deg_s"):
        drive.move_to(1.0, velocity_deg_s=velocity)
    assert slave.position == 1000


def test_a_blocked_axis_is_stopped_after_a_bounded_time(drive: Drive, slave: Any) -> None:
    slave.node.firmware._modes[1].step = lambda period_s: (1000.0, 0.0)
    with pytest.raises(TransitionError, match="arrival at 2 deg did not occur"):
        drive.move_to(2.0)
    assert slave.controlwords[-1] == 0x02


def test_a_fault_during_a_move_is_reported_with_its_code(drive: Drive, slave: Any, clock: Any) -> None:
    drive.enable(Mode.PP)
    Later(clock, clock.now() + 0.08, lambda: slave.fail(0x8611))
    with pytest.raises(DriveError, match=r"fault while waiting for arrival.*error code 8611h.*EMCY 8611h"):
        drive.move_to(2.0)
    drive.wait(0.2)
    with pytest.raises(DriveError, match="fault before it was enabled"):
        drive.enable(Mode.PP)
    drive.fault_reset()
    assert slave.state is State.SWITCH_ON_DISABLED
    drive.enable(Mode.PP)


def test_a_fault_reset_is_an_edge(drive: Drive, slave: Any) -> None:
    with pytest.raises(TransitionError, match="fault reset"):
        drive.fault_reset()
    slave.fail()
    drive.fault_reset()
    assert slave.controlwords == [0x00, 0x80, 0x00]


def test_a_fault_that_stays(drive: Drive, slave: Any) -> None:
    slave.fail(0x3210)
    slave.scripts[0x6040, 0] = holding(0)
    with pytest.raises(DriveError, match=r"that a reset does not clear.*3210h"):
        drive.fault_reset()
    assert slave.controlwords[-1] == 0x00


def test_homing(drive: Drive, slave: Any) -> None:
    positions = drive.home(35, 2.0, 1.0, offset_deg=1.0)
    assert slave.values[0x6098, 0] == 35
    assert slave.values[0x6099, 2] == round(1.0 * 50 * 8000 / 360)
    assert positions.motor_counts == round(50 * 8000 / 360)
    assert slave.controlwords[-1] == 0x0F
    assert slave.values[0x6060, 0] == Mode.HM
    drive.move_to(2.0)
    assert slave.values[0x6060, 0] == Mode.PP


def test_homing_that_fails(drive: Drive, slave: Any) -> None:
    slave.motor.velocity_counts_s = 5000.0  # homing in motion is an error
    with pytest.raises(DriveError, match="homing by method 35 failed"):
        drive.home(35, 2.0, 1.0)
    assert slave.controlwords[-1] == 0x02
    with pytest.raises(InputError, match="607Ch can hold"):
        drive.home(17, 2.0, 1.0, offset_deg=math.nan)


def test_halt_stops_and_stays_enabled(drive: Drive, slave: Any) -> None:
    drive.enable(Mode.PP)
    slave.values[0x607A, 0] = 100_000
    slave.node.firmware.control(0x1F)
    drive.wait(0.1)
    assert slave.motor.velocity_counts_s > 0.0
    assert drive.halt()
    drive.wait(1.0)
    assert slave.motor.velocity_counts_s == 0.0
    assert slave.controlwords[-1] == 0x010F
    assert slave.state is State.OPERATION_ENABLED


def test_quick_stop_and_recovery(drive: Drive, slave: Any) -> None:
    slave.values[0x605A, 0] = 6
    drive.enable(Mode.PP)
    assert drive.quick_stop() is State.QUICK_STOP_ACTIVE
    with pytest.raises(TransitionError, match="disable it first"):
        drive.enable(Mode.PP)
    drive.disable()
    assert slave.state is State.SWITCH_ON_DISABLED


def test_leaving_disables_and_ends_operation(bus: Any, clock: Any, slave: Any, axis: AxisConfig) -> None:
    with Drive(bus, axis, clock, slave.od) as drive:
        drive.boot()
        slave.values[0x605A, 0] = 6
        drive.enable(Mode.PP)
        slave.controlwords.clear()
    assert slave.controlwords == [0x02, 0x00]
    assert slave.state is State.SWITCH_ON_DISABLED
    assert slave.nmt_state == 127
    assert slave.values[0x1016, 1] == 0


@pytest.fixture
def session(bus, clock, slave, axis):
    """Opens and enables a drive, acts on it, and leaves."""

    def run(do: Callable[[Drive], object]) -> None:
        with Drive(bus, axis, clock, slave.od) as drive:
            drive.boot()
            drive.enable(Mode.PP)
            do(drive)

    return run


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_leaving_by_an_error_disables_too(session: Any, slave: Any, error: type[BaseException]) -> None:
    def fail(drive: Drive) -> None:
        assert slave.state is State.OPERATION_ENABLED
        raise error

    with pytest.raises(error):
        session(fail)
    assert slave.state is State.SWITCH_ON_DISABLED


def test_leaving_when_a_boot_failed_disables_too(bus: Any, clock: Any, slave: Any, axis: AxisConfig) -> None:
    slave.values[0x6007, 0] = 0  # a reset of communication leaves power on
    slave.enable()
    slave.values[0x1018, 1] = 1
    with pytest.raises(DriveError), Drive(bus, axis, clock, slave.od) as drive:
        drive.boot()
    assert slave.state is State.SWITCH_ON_DISABLED


def test_a_silent_drive_is_still_disabled(session: Any, slave: Any) -> None:
    with pytest.raises(DriveError, match=r"not certain that power is off.*enable input"):
        session(lambda drive: setattr(slave, "sends", lambda message: False))
    assert slave.state is State.SWITCH_ON_DISABLED


def test_a_broken_bus_on_exit_is_added_to_the_error(session: Any, bus: Any) -> None:
    def cut_the_cable(drive: Drive) -> None:
        bus.down = errno.ENETDOWN
        drive.read_positions()

    with pytest.raises(BusError) as caught:
        session(cut_the_cable)
    assert any("not certain that power is off" in note for note in caught.value.__notes__)


def test_a_drive_in_fault_is_left_alone_on_exit(bus: Any, clock: Any, slave: Any, axis: AxisConfig) -> None:
    with Drive(bus, axis, clock, slave.od) as drive:
        drive.boot()
        slave.fail()
        slave.controlwords.clear()
    assert slave.controlwords == []
    assert slave.state is State.FAULT
