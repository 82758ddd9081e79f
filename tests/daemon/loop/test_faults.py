"""What goes wrong on the bus and around it: the state that follows, how soon, and that it stays."""

from __future__ import annotations

import struct

import pytest
from support.daemon import SteppedDaemon, stepped_daemon

from hdbridge.daemon.loop.faultlog import FAULT_INDEX
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind
from hdbridge.drive.supervision import Fault, Reaction

S, K, E = AxisState, CommandKind, EventKind


def stands(daemon: SteppedDaemon) -> None:
    """The axis comes to rest and stays there, whatever is sent."""
    daemon.run(1.0)
    place = daemon.nodes[0].firmware.motion.machine.motor_counts
    daemon.run(0.5)
    assert abs(daemon.nodes[0].firmware.motion.machine.motor_counts - place) <= 2


def moving(daemon: SteppedDaemon) -> SteppedDaemon:
    daemon.move(200.0)
    daemon.run(1.0)
    return daemon


def silent(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.silent = True


def drop(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.drop_tpdos = 4


def shorten(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.shorten_tpdos = 4


def mute(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.mute_heartbeat = True


def drive_fault(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.raise_error(0x3210)


def encoder_jump(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.load_jump_counts = 100_000


def no_room(daemon: SteppedDaemon) -> None:
    daemon.bus.no_room_for = 0x201


def foreign_rpdo(daemon: SteppedDaemon) -> None:
    daemon.interfere(0x201, bytes(6))


def foreign_sync(daemon: SteppedDaemon) -> None:
    daemon.interfere(0x080)


def boot_up(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.boot_up()


def pre_operational(daemon: SteppedDaemon) -> None:
    daemon.interfere(0x701, b"\x7f")


def interface_down(daemon: SteppedDaemon) -> None:
    daemon.bus.down = True


ROWS = [
    (silent, Fault.LOST_TPDO, S.QUICK_STOPPED, 2),
    (drop, Fault.LOST_TPDO, S.QUICK_STOPPED, 2),
    (shorten, Fault.WRONG_LENGTH, S.QUICK_STOPPED, 2),
    (mute, Fault.HEARTBEAT_LOST, S.QUICK_STOPPED, 26),
    (drive_fault, Fault.DRIVE_FAULT, S.QUICK_STOPPED, 2),
    (encoder_jump, Fault.ENCODER_JUMP, S.QUICK_STOPPED, 3),
    (no_room, Fault.TRANSMIT_FULL, S.QUICK_STOPPED, 1),
    (foreign_rpdo, Fault.OWN_ID_ELSEWHERE, S.QUICK_STOPPED, 1),
    (foreign_sync, Fault.FOREIGN_SYNC, S.QUICK_STOPPED, 1),
    (boot_up, Fault.BOOT_UP, S.LATCHED, 2),
    (pre_operational, Fault.NMT_CHANGE, S.LATCHED, 1),
    (interface_down, Fault.BUS_DOWN, S.LATCHED, 1),
]


@pytest.mark.parametrize(("spoil", "fault", "state", "turns"), ROWS, ids=[row[0].__name__ for row in ROWS])
def test_each_fault_stops_the_axis_in_time_and_for_good(
    enabled: SteppedDaemon, spoil, fault: Fault, state: AxisState, turns: int
) -> None:
    moving(enabled)
    spoil(enabled)
    enabled.turn(turns)
    assert enabled.states == [state]
    assert fault in {event.fault for event in enabled.axes[0].supervision.events}
    enabled.until(lambda: bool(enabled.told(E.STOPPED)))
    (stopped,) = enabled.told(E.STOPPED)
    assert stopped.code == FAULT_INDEX[fault]
    assert fault.value in stopped.text
    assert {each.code for each in enabled.told(E.STATE)} >= {state}
    sent: list[int] = []
    enabled.bus.spy = lambda can_id, data: sent.append(data[0]) if can_id == 0x201 else None
    for kind in (K.MOVE, K.JOG, K.ENABLE, K.VERIFIED):
        assert enabled.order(kind).kind is E.REFUSED
    stands(enabled)
    assert 0x0F not in sent
    if state is S.LATCHED:
        assert sent == []


def test_a_drive_that_restarted_is_verified_again_and_comes_up_disabled(enabled: SteppedDaemon) -> None:
    moving(enabled)
    boot_up(enabled)
    enabled.run(0.1)
    assert enabled.states == [S.LATCHED]
    assert "boot and verify" in enabled.order(K.RESET).text
    enabled.drive(0).boot()
    assert enabled.states == [S.LATCHED]
    enabled.done(K.RESET, i=1)
    assert enabled.states == [S.UNVERIFIED]
    sent: list[bytes] = []
    enabled.bus.spy = lambda can_id, data: sent.append(data) if can_id == 0x201 else None
    enabled.done(K.VERIFIED, **enabled.seeds(0))
    enabled.run(0.5)
    assert enabled.states == [S.DISABLED]
    assert {struct.unpack("<Hi", data)[0] for data in sent} == {0}
    enabled.enable()
    id_ = enabled.move(0.0)
    enabled.until(lambda: enabled.ended(id_), 30.0)


def test_an_interface_that_comes_back_is_used_again_with_everything_disabled(enabled: SteppedDaemon) -> None:
    moving(enabled)
    interface_down(enabled)
    enabled.run(1.3)
    (down,) = enabled.told(E.BUS_DOWN)
    assert "Network is down" in down.text
    assert enabled.told(E.BUS_UP) == []
    enabled.bus.down = False
    enabled.until(lambda: bool(enabled.told(E.BUS_UP)), 0.6)
    assert enabled.states == [S.LATCHED]
    enabled.drive(0).boot()
    enabled.done(K.RESET, i=1)
    enabled.done(K.VERIFIED, **enabled.seeds(0))
    enabled.enable()
    assert len(enabled.told(E.BUS_DOWN)) == 1


@pytest.mark.parametrize("lent", [False, True])
def test_a_bus_that_goes_down_while_nothing_moves(daemon: SteppedDaemon, lent: bool) -> None:
    daemon.turn()
    if lent:
        daemon.verify()
        daemon.done(K.LEND)
    daemon.bus.down = True
    daemon.run(0.1)
    assert daemon.states == [S.LATCHED if lent else S.UNVERIFIED]
    daemon.bus.down = False
    daemon.run(1.0)
    if lent:
        daemon.drive(0).boot()
        daemon.done(K.RESET, i=1)
    daemon.verify()
    daemon.enable()


def test_a_process_that_hung_does_not_catch_up_and_the_axis_stops(enabled: SteppedDaemon) -> None:
    moving(enabled)
    before = enabled.axes[0].set_point.position_deg
    enabled.hang(0.5)
    enabled.turn(2)
    assert enabled.states[0] in (S.QUICK_STOPPED, S.LATCHED)
    assert abs(enabled.axes[0].set_point.position_deg - before) <= 2 * 20.0 * 0.004
    stands(enabled)


def test_one_late_cycle_costs_a_period_and_nothing_else(enabled: SteppedDaemon) -> None:
    moving(enabled)
    enabled.hang(0.007)
    enabled.turn(2)
    enabled.run(0.2)
    assert enabled.states == [S.ENABLED]
    samples, _ = enabled.samples.read()
    assert samples["skipped"][-1] >= 1
    assert samples["late_us"].max() > 2000
    (event,) = [each for each in enabled.told(E.FAULT) if each.code == FAULT_INDEX[Fault.OVERRUN]]
    assert event.id == Reaction.GO


def test_faults_that_change_nothing_are_told_once_a_second(enabled: SteppedDaemon) -> None:
    for _ in range(500):
        enabled.interfere(0x081, struct.pack("<HB5x", 0x3110, 1))
        enabled.turn()
    told = [each for each in enabled.told(E.FAULT) if each.code == FAULT_INDEX[Fault.EMERGENCY]]
    assert len(told) == 2
    assert "3110h" in told[0].text
    assert enabled.states == [S.ENABLED]


def test_a_drive_fault_is_reset_by_command_after_the_stop_was(enabled: SteppedDaemon) -> None:
    moving(enabled)
    drive_fault(enabled)
    enabled.until(lambda: bool(enabled.told(E.STOPPED)))
    enabled.done(K.RESET)
    enabled.until(lambda: enabled.states == [S.DISABLED])
    assert "fault" in enabled.order(K.ENABLE, k=0x0008).text
    enabled.done(K.DRIVE_FAULT_RESET)
    enabled.run(0.1)
    assert enabled.order(K.DRIVE_FAULT_RESET).kind is E.REFUSED
    enabled.enable()


def test_the_axis_waits_at_the_end_of_its_move_when_the_service_is_gone(enabled: SteppedDaemon) -> None:
    """Nothing is taken from or put into the memory on the service's side any more."""
    enabled.post(K.MOVE, a=15.0, b=20.0, c=200.0)
    for _ in range(1000):
        enabled.controller.turn()
    assert enabled.states == [S.ENABLED]
    assert enabled.axes[0].set_point.position_deg == 15.0
    for _ in range(20_000):
        enabled.controller.turn()
    assert enabled.states == [S.ENABLED]


@pytest.mark.parametrize("how", ["jog", "stream"])
def test_what_needs_the_service_runs_out_and_stops_when_it_is_gone(enabled: SteppedDaemon, how: str) -> None:
    from hdbridge.daemon.memory import Knot

    if how == "jog":
        enabled.post(K.JOG, a=10.0, b=0.3)
    else:
        begin = enabled.axes[0].set_point.position_deg
        path = [Knot(9, 0.1 * n, begin + 0.5 * 4.0 * (0.1 * n) ** 2, 0.4 * n) for n in range(10)]
        enabled.memory.knots[0].put(path)
        enabled.post(K.STREAM_BEGIN, a=0.3, i=1, j=9)
    for _ in range(100):
        enabled.controller.turn()
    for _ in range(400):
        enabled.controller.turn()
    assert enabled.states == [S.ENABLED]
    assert enabled.axes[0].set_point.at_rest


def test_the_bus_is_silent_from_the_control_processs_death_on_and_the_drive_stops_by_itself() -> None:
    with stepped_daemon() as daemon:
        daemon.verify()
        daemon.enable()
        moving(daemon)
        machine = daemon.nodes[0].firmware.motion.machine
        daemon.hang(1.0)  # nothing is sent any more
        place = machine.motor_counts
        daemon.hang(0.5)
        assert abs(machine.motor_counts - place) <= 2
