"""Enabling, moving, homing and faults; a drive is never left enabled."""

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.drive import Drive, Mode, State
from hdbridge.errors import BusError, DriveError, InputError, TransitionError


@pytest.fixture
def drive(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> Iterator[Drive]:
    with Drive(bus, axis, clock, tiny.od, sdo_timeout_s=0.1) as drive:
        drive.boot()
        tiny.controlwords.clear()
        yield drive
        bus.refuse = None
        tiny.silent = False


def test_enabling_walks_every_state_and_moves_nothing(drive: Drive, tiny: Any) -> None:
    tiny.values[0x607A, 0] = 99_999
    drive.enable(Mode.PP)
    assert tiny.state == 0x27
    assert tiny.controlwords == [0x06, 0x07, 0x0F]
    assert tiny.values[0x607A, 0] == 1000 == tiny.position
    assert tiny.values[0x6060, 0] == Mode.PP
    drive.disable()
    assert tiny.controlwords[3:] == [0x07, 0x00]
    assert tiny.state == 0x40


def test_in_csp_power_is_left_to_the_cycle(drive: Drive, tiny: Any) -> None:
    drive.enable()
    assert tiny.state == 0x40
    assert tiny.values[0x6060, 0] == Mode.CSP
    image = drive.image
    assert (image.motor_counts, image.load_counts, image.statusword) == (1000, 7200, 0x40)
    ((can_id, data),) = image.pack_rpdo_idle()
    assert (can_id, struct.unpack("<Hi", data)) == (0x201, (0x06, 1000))


def test_before_the_boot_nothing_is_enabled(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> None:
    with Drive(bus, axis, clock, tiny.od) as drive, pytest.raises(TransitionError, match="boot"):
        drive.enable()
    assert bus.sent == []


def test_an_unsupported_or_refused_mode(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> None:
    tiny.values[0x6502, 0] = 0x80
    with Drive(bus, axis, clock, tiny.od) as drive:
        drive.boot()
        with pytest.raises(DriveError, match="no mode PP"):
            drive.enable(Mode.PP)
        tiny.stuck.add((0x6060, 0))
        with pytest.raises(DriveError, match=r"6061h:00.*shows 0 after mode 8"):
            drive.enable()
    assert tiny.state == 0x40


def test_a_target_that_cannot_be_preloaded_prevents_enabling(drive: Drive, tiny: Any) -> None:
    tiny.stuck.add((0x607A, 0))
    with pytest.raises(DriveError, match="reads back 0; the drive was not enabled"):
        drive.enable(Mode.PP)
    assert tiny.state == 0x40


def test_an_axis_outside_its_limits_is_not_enabled(drive: Drive, tiny: Any) -> None:
    tiny.position = 500_000
    with pytest.raises(DriveError, match="stands at 450 deg"):
        drive.enable(Mode.PP)
    drive.enable(Mode.HM)


def test_a_drive_ignoring_a_transition(drive: Drive, tiny: Any) -> None:
    original = tiny.control
    tiny.control = lambda word: original(word) if word & 0x0F != 0x07 else None
    with pytest.raises(
        TransitionError, match=r"'switched on' did not occur within 1 s.*'ready to switch on'"
    ):
        drive.enable(Mode.PP)


@pytest.mark.parametrize("stale", [0x0000, 0x0033, 0xFFFF])
def test_a_stale_or_invalid_statusword_never_counts_as_enabled(drive: Drive, tiny: Any, stale: int) -> None:
    state = tiny.value
    tiny.value = lambda key: stale if key == (0x6041, 0) else state(key)
    with pytest.raises(DriveError):
        drive.enable(Mode.PP)
    assert drive.image.power.state is not State.OPERATION_ENABLED
    tiny.value = state


def test_a_profile_move_arrives(drive: Drive, tiny: Any, clock: Any) -> None:
    start_s = clock.now()
    positions = drive.move_to(2.0)
    assert positions.motor_counts == round(2.0 * 50 * 8000 / 360)
    assert positions.motor_deg == pytest.approx(100.0, abs=0.03)
    assert clock.now() - start_s > 0.05
    assert tiny.heartbeats_heard >= 3
    drive.move_to(-1.0, velocity_deg_s=10.0)
    assert tiny.values[0x6081, 0] == round(10 * 50 * 8000 / 360)


@pytest.mark.parametrize("target", [math.nan, math.inf, -math.inf, 400.01, -1e9])
def test_impossible_targets_are_refused_before_anything_is_sent(
    drive: Drive, tiny: Any, target: float
) -> None:
    drive.enable(Mode.PP)
    before = list(tiny.sdo_order)
    with pytest.raises(InputError, match="nothing was sent"):
        drive.move_to(target)
    assert tiny.sdo_order == before
    assert tiny.position == 1000


@pytest.mark.parametrize("velocity", [0.0, -1.0, 20.1, math.nan, math.inf])
def test_speeds_beyond_the_limit_are_refused(drive: Drive, tiny: Any, velocity: float) -> None:
    drive.enable(Mode.PP)
    with pytest.raises(InputError, match=r"limits\.velocity_deg_s"):
        drive.move_to(1.0, velocity_deg_s=velocity)
    assert tiny.position == 1000


def test_a_blocked_axis_is_stopped_after_a_bounded_time(drive: Drive, tiny: Any) -> None:
    tiny.blocked = True
    with pytest.raises(TransitionError, match="arrival at 2 deg did not occur"):
        drive.move_to(2.0)
    assert tiny.state == 0x07


def test_a_fault_during_a_move_is_reported_with_its_code(
    drive: Drive, tiny: Any, bus: Any, clock: Any
) -> None:
    drive.enable(Mode.PP)

    def fault_after_a_while() -> None:
        if tiny.goal is not None and tiny.position > 1500:
            bus.peers.remove(fault_after_a_while)
            tiny.fail(0x8611)

    bus.peers.append(fault_after_a_while)
    with pytest.raises(DriveError, match=r"fault while waiting for arrival.*error code 8611h.*EMCY 8611h"):
        drive.move_to(2.0)
    with pytest.raises(DriveError, match="fault before it was enabled"):
        drive.enable(Mode.PP)
    drive.fault_reset()
    assert tiny.state == 0x40
    drive.enable(Mode.PP)


def test_a_fault_reset_is_an_edge(drive: Drive, tiny: Any) -> None:
    with pytest.raises(TransitionError, match="fault reset"):
        drive.fault_reset()
    tiny.fail()
    tiny.controlword = 0x80
    drive.fault_reset()
    assert tiny.controlwords == [0x00, 0x80, 0x00]


def test_a_fault_that_stays(drive: Drive, tiny: Any) -> None:
    tiny.fail(0x3210)
    tiny.fault_persists = True
    with pytest.raises(DriveError, match=r"that a reset does not clear.*3210h"):
        drive.fault_reset()
    assert tiny.controlwords[-1] == 0x00


def test_homing(drive: Drive, tiny: Any) -> None:
    positions = drive.home(35, 2.0, 1.0, offset_deg=1.0)
    assert tiny.values[0x6098, 0] == 35
    assert tiny.values[0x6099, 2] == round(1.0 * 50 * 8000 / 360)
    assert positions.motor_counts == round(50 * 8000 / 360)
    assert tiny.controlwords[-1] == 0x0F
    assert tiny.values[0x6060, 0] == Mode.HM
    drive.move_to(2.0)
    assert tiny.values[0x6060, 0] == Mode.PP


def test_homing_that_fails(drive: Drive, tiny: Any) -> None:
    tiny.blocked = True
    with pytest.raises(DriveError, match="homing by method 17 failed"):
        drive.home(17, 2.0, 1.0)
    assert tiny.state == 0x07
    with pytest.raises(InputError, match="607Ch can hold"):
        drive.home(17, 2.0, 1.0, offset_deg=math.nan)


def test_halt_stops_and_stays_enabled(drive: Drive, tiny: Any, bus: Any) -> None:
    drive.enable(Mode.PP)
    tiny.goal = 1e9
    assert drive.halt()
    assert tiny.controlwords[-1] == 0x010F
    assert tiny.state == 0x27


def test_quick_stop_and_recovery(drive: Drive, tiny: Any) -> None:
    drive.enable(Mode.PP)
    assert drive.quick_stop() is State.QUICK_STOP_ACTIVE
    with pytest.raises(TransitionError, match="disable it first"):
        drive.enable(Mode.PP)
    drive.disable()
    assert tiny.state == 0x40


def test_leaving_disables_and_ends_operation(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> None:
    with Drive(bus, axis, clock, tiny.od) as drive:
        drive.boot()
        drive.enable(Mode.PP)
        tiny.controlwords.clear()
    assert tiny.controlwords == [0x02, 0x00]
    assert tiny.state == 0x40
    assert tiny.nmt_state == 127
    assert tiny.values[0x1016, 1] == 0


@pytest.fixture
def session(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> Callable[[Callable[[Drive], object]], None]:
    """Opens and enables a drive, acts on it, and leaves."""

    def run(do: Callable[[Drive], object]) -> None:
        with Drive(bus, axis, clock, tiny.od) as drive:
            drive.boot()
            drive.enable(Mode.PP)
            do(drive)

    return run


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_leaving_by_an_error_disables_too(session: Any, tiny: Any, error: type[BaseException]) -> None:
    def fail(drive: Drive) -> None:
        assert tiny.state == 0x27
        raise error

    with pytest.raises(error):
        session(fail)
    assert tiny.state == 0x40


def test_leaving_when_a_boot_failed_disables_too(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> None:
    tiny.state, tiny.controlword = 0x27, 0x0F
    tiny.values[0x1018, 1] = 1
    with pytest.raises(DriveError), Drive(bus, axis, clock, tiny.od) as drive:
        drive.boot()
    assert tiny.state == 0x40


def test_a_silent_drive_is_still_disabled(session: Any, tiny: Any) -> None:
    with pytest.raises(DriveError, match=r"not certain that power is off.*enable input"):
        session(lambda drive: setattr(tiny, "send", lambda function, data: None))
    assert tiny.state == 0x40


def test_a_broken_bus_on_exit_is_added_to_the_error(session: Any, bus: Any) -> None:
    def cut_the_cable(drive: Drive) -> None:
        bus.refuse = can.CanOperationError("Failed to transmit: Network is down", 100)
        drive.read_positions()

    with pytest.raises(BusError) as caught:
        session(cut_the_cable)
    assert any("not certain that power is off" in note for note in caught.value.__notes__)


def test_a_drive_in_fault_is_left_alone_on_exit(bus: Any, clock: Any, tiny: Any, axis: AxisConfig) -> None:
    with Drive(bus, axis, clock, tiny.od) as drive:
        drive.boot()
        tiny.fail()
        tiny.controlwords.clear()
    assert tiny.controlwords == []
    assert tiny.state == 0x08
