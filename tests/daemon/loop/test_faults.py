"""Recovery from faults, their reports, and the unaffected axes. `test_reliability` has each fault."""

import errno
import struct
from collections.abc import Callable

import pytest
from support.daemon import SteppedDaemon

from hdbridge.daemon.loop.faultlog import FAULT_INDEX
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind
from hdbridge.drive.supervision import Fault, Reaction

S, K, E = AxisState, CommandKind, EventKind


def moving(daemon: SteppedDaemon) -> SteppedDaemon:
    daemon.move(200.0)
    daemon.run(1.0)
    return daemon


def drive_fault(daemon: SteppedDaemon) -> None:
    daemon.nodes[0].faults.raise_error(0x3210)


@pytest.mark.parametrize("lent", [False, True])
def test_a_bus_that_goes_down_while_nothing_moves(daemon: SteppedDaemon, lent: bool) -> None:
    daemon.turn()
    if lent:
        daemon.verify()
        daemon.done(K.HOME)
    daemon.bus.down = errno.ENETDOWN
    daemon.run(0.1)
    assert daemon.states == [S.LATCHED if lent else S.UNVERIFIED]
    daemon.bus.down = None
    daemon.run(1.0)
    if lent:
        daemon.drive(0).boot()
        daemon.done(K.RESET, i=1)
    daemon.verify()
    daemon.enable()


def each_cycle(can_id: int, data: bytes = b"", **kind: bool) -> Callable[[SteppedDaemon], None]:
    """Returns an action that sends a frame of another node in each of 500 cycles."""

    def do(daemon: SteppedDaemon) -> None:
        for _ in range(500):
            daemon.interfere(can_id, data, **kind)
            daemon.turn()

    return do


def wish(**faults: int) -> Callable[[SteppedDaemon], None]:
    """Returns an action that makes the simulated drive's TPDOs faulty and runs two seconds."""

    def do(daemon: SteppedDaemon) -> None:
        for name, value in faults.items():
            setattr(daemon.nodes[0].faults, name, value)
        daemon.run(2.0)

    return do


def every_tenth_tpdo_lost(daemon: SteppedDaemon) -> None:
    for _ in range(50):
        daemon.nodes[0].faults.drop_tpdos = 1
        daemon.turn(10)


@pytest.mark.parametrize(
    ("happens", "fault", "reactions"),
    [
        (each_cycle(0x080), Fault.FOREIGN_SYNC, [Reaction.QUICK_STOP]),
        (each_cycle(0x201, bytes(6)), Fault.OWN_ID_ELSEWHERE, [Reaction.QUICK_STOP]),
        (each_cycle(0x181, bytes(6), is_extended_id=True), Fault.DISCARDED_FRAME, [Reaction.GO]),
        (each_cycle(0x081, struct.pack("<HB5x", 0x3110, 1)), Fault.EMERGENCY, [Reaction.GO]),
        (wish(drop_tpdos=500), Fault.LOST_TPDO, [Reaction.FREEZE, Reaction.QUICK_STOP]),
        (wish(shorten_tpdos=500), Fault.WRONG_LENGTH, [Reaction.FREEZE, Reaction.QUICK_STOP]),
        (wish(duplicate_tpdos=500), Fault.DUPLICATE_TPDO, [Reaction.GO]),
        (every_tenth_tpdo_lost, Fault.LOST_TPDO, [Reaction.FREEZE]),
    ],
)
def test_a_fault_is_one_event_and_not_one_per_cycle(
    enabled: SteppedDaemon, happens: Callable[[SteppedDaemon], None], fault: Fault, reactions: list[Reaction]
) -> None:
    moving(enabled)
    happens(enabled)
    reported = [each.id for each in enabled.reported(E.FAULT) if each.code == FAULT_INDEX[fault]]
    assert reported == reactions
    enabled.run(1.5)
    if enabled.states == [S.QUICK_STOPPED]:
        enabled.done(K.RESET)
        enabled.until(lambda: enabled.states == [S.DISABLED])
    happens(enabled)
    again = [each.id for each in enabled.reported(E.FAULT) if each.code == FAULT_INDEX[fault]]
    assert again[: len(reported)] == reported
    assert again[len(reported) :] == reactions


def test_emergencies_with_different_codes_are_all_reported(enabled: SteppedDaemon) -> None:
    for number in range(200):
        enabled.interfere(0x081, struct.pack("<HBB4x", (0x3110, 0x4210, 0x8110)[number % 3], 1, number))
        enabled.turn()
    reported = [each.text for each in enabled.reported(E.FAULT) if each.code == FAULT_INDEX[Fault.EMERGENCY]]
    assert [each[5:10] for each in reported] == ["3110h", "4210h", "8110h"]
    assert enabled.states == [S.ENABLED]


def test_a_drive_fault_is_reset_after_the_stop(enabled: SteppedDaemon) -> None:
    moving(enabled)
    drive_fault(enabled)
    enabled.until(lambda: bool(enabled.reported(E.STOPPED)))
    enabled.done(K.RESET)
    enabled.until(lambda: enabled.states == [S.DISABLED])
    assert "fault" in enabled.order(K.ENABLE, k=0x0008).text
    enabled.done(K.DRIVE_FAULT_RESET)
    enabled.run(0.1)
    assert enabled.order(K.DRIVE_FAULT_RESET).kind is E.REFUSED
    enabled.enable()
