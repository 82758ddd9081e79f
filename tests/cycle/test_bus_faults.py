"""The fault table with two axes on one bus: a fault of one stops that one, a fault of the bus stops both."""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import can
import pytest
from support.twoaxes import TwoAxes, two_axes

from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction

from .conftest import SpoiltBus

F, R = Fault, Reaction
FIRST, BOTH = (0,), (0, 1)
DOWN = can.CanOperationError("Network is down", errno.ENETDOWN)
DELETED = can.CanOperationError("No such device", errno.ENODEV)


@pytest.fixture
def pair() -> Iterator[TwoAxes]:
    """Both enabled and moving at constant speed."""
    with two_axes(SpoiltBus) as made:
        made.enable(0)
        made.enable(1)
        made.turn(60)
        yield made


def drive(**wishes: Any) -> Callable[[TwoAxes], None]:
    def make(pair: TwoAxes) -> None:
        for name, value in wishes.items():
            setattr(pair.nodes[0].faults, name, value)

    return make


def frame(can_id: int, data: bytes = b"", times: int = 1, **kind: bool) -> Callable[[TwoAxes], None]:
    def make(pair: TwoAxes) -> None:
        for _ in range(times):
            pair.interfere(can_id, data, **kind)

    return make


def command(value: object) -> Callable[[TwoAxes], None]:
    def make(pair: TwoAxes) -> None:
        pair.moving[0] = False
        pair.axes[0].command = value  # type: ignore[assignment]

    return make


def interface(**wishes: Any) -> Callable[[TwoAxes], None]:
    def make(pair: TwoAxes) -> None:
        for name, value in wishes.items():
            setattr(pair.bus, name, value)

    return make


def broken(feedback: object) -> int:
    raise ZeroDivisionError("1 / 0")


@dataclass(frozen=True)
class Row:
    """One fault: how it is made, whom it concerns, what comes of it, and within how many cycles."""

    make: Callable[[TwoAxes], object]
    fault: Fault
    reaction: Reaction
    whom: tuple[int, ...] = FIRST
    allowed: int = 1
    again: bool = False
    """Made before each cycle."""


ROWS = {
    "lost TPDO": Row(drive(drop_tpdos=1), F.LOST_TPDO, R.FREEZE),
    "TPDOs lost twice": Row(drive(drop_tpdos=4), F.LOST_TPDO, R.QUICK_STOP, allowed=2),
    "late TPDO": Row(drive(hold_tpdos=1), F.LOST_TPDO, R.FREEZE),
    "short TPDO": Row(drive(shorten_tpdos=1), F.WRONG_LENGTH, R.FREEZE),
    "short TPDOs twice": Row(drive(shorten_tpdos=4), F.WRONG_LENGTH, R.QUICK_STOP, allowed=2),
    "doubled TPDO": Row(drive(duplicate_tpdos=2), F.DUPLICATE_TPDO, R.GO, allowed=2),
    "stale TPDO": Row(frame(0x181, b"\x37\x16" + bytes(6)), F.DUPLICATE_TPDO, R.GO),
    "left 'operation enabled' between two SYNCs": Row(
        frame(0x181, b"\x07\x16" + bytes(6)), F.DROPPED_OUT, R.QUICK_STOP
    ),
    "drive missed the master's heartbeat": Row(
        frame(0x081, b"\x30\x81\x11" + bytes(5)), F.MASTER_LOST, R.QUICK_STOP
    ),
    "drive missed set-points": Row(frame(0x081, b"\x50\x82\x11" + bytes(5)), F.MASTER_LOST, R.QUICK_STOP),
    "cable pulled": Row(drive(silent=True), F.LOST_TPDO, R.QUICK_STOP, allowed=2),
    "heartbeat lost": Row(drive(mute_heartbeat=True), F.HEARTBEAT_LOST, R.QUICK_STOP, allowed=26),
    "node restarts": Row(lambda pair: pair.nodes[0].faults.boot_up(), F.BOOT_UP, R.LATCH, allowed=2),
    "leaves OPERATIONAL": Row(frame(0x701, b"\x7f"), F.NMT_CHANGE, R.LATCH),
    "emergency": Row(frame(0x081, struct.pack("<HB5x", 0x3110, 1)), F.EMERGENCY, R.GO),
    "drive fault": Row(
        lambda pair: pair.nodes[0].faults.raise_error(0x3210), F.DRIVE_FAULT, R.QUICK_STOP, allowed=2
    ),
    "drops out": Row(
        lambda pair: pair.nodes[0].faults.lose_master(0x8130), F.DROPPED_OUT, R.QUICK_STOP, allowed=2
    ),
    "encoder jump": Row(drive(load_jump_counts=100_000), F.ENCODER_JUMP, R.QUICK_STOP, allowed=3),
    "its RPDO from elsewhere": Row(frame(0x201, bytes(6)), F.OWN_ID_ELSEWHERE, R.QUICK_STOP),
    "an SDO request to it": Row(frame(0x601, bytes(8)), F.OWN_ID_ELSEWHERE, R.QUICK_STOP),
    "target NaN": Row(command(math.nan), F.BAD_TARGET, R.QUICK_STOP),
    "target outside the limits": Row(command(2**31), F.BAD_TARGET, R.QUICK_STOP),
    "command that breaks": Row(command(broken), F.BAD_TARGET, R.QUICK_STOP),
    "foreign SYNC": Row(frame(0x080), F.FOREIGN_SYNC, R.QUICK_STOP, BOTH),
    "foreign master's heartbeat": Row(frame(0x77F, b"\x05"), F.OWN_ID_ELSEWHERE, R.QUICK_STOP, BOTH),
    "foreign NMT command": Row(frame(0x000, b"\x01\x05"), F.OWN_ID_ELSEWHERE, R.QUICK_STOP, BOTH),
    "remote frame": Row(frame(0x181, is_remote_frame=True), F.DISCARDED_FRAME, R.GO, BOTH),
    "babbling node": Row(frame(0x7E5, bytes(8), times=300), F.FLOOD, R.QUICK_STOP, BOTH, 2, again=True),
    "overrun": Row(lambda pair: pair.hang(0.007), F.OVERRUN, R.GO, BOTH),
    "overruns in a row": Row(lambda pair: pair.hang(0.007), F.OVERRUN, R.QUICK_STOP, BOTH, 2, again=True),
    "hang": Row(lambda pair: pair.hang(0.4), F.HANG, R.QUICK_STOP, BOTH),
    "no room for SYNC": Row(interface(no_room_for=0x080), F.TRANSMIT_FULL, R.QUICK_STOP, BOTH),
    "no room for the first RPDO": Row(interface(no_room_for=0x201), F.TRANSMIT_FULL, R.QUICK_STOP, BOTH),
    "no room for the second RPDO": Row(interface(no_room_for=0x202), F.TRANSMIT_FULL, R.QUICK_STOP, BOTH),
    "no room for the heartbeat": Row(interface(no_room_for=0x77F), F.TRANSMIT_FULL, R.QUICK_STOP, BOTH, 8),
    "interface down": Row(interface(recv_error=DOWN), F.BUS_DOWN, R.LATCH, BOTH),
    "interface deleted": Row(interface(send_error=DELETED), F.BUS_DOWN, R.LATCH, BOTH),
}  # fmt: skip


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_a_fault_stops_whom_it_concerns_and_nobody_else(pair: TwoAxes, row: Row) -> None:
    for cycle in range(row.allowed):
        if row.again or cycle == 0:
            row.make(pair)
        pair.turn()
        if all(row.reaction in pair.reactions(place, row.fault) for place in row.whom):
            break
    for place in row.whom:
        assert row.reaction in pair.reactions(place, row.fault)
    stops = row.reaction >= R.QUICK_STOP
    for place in row.whom if stops else ():
        assert pair.axes[place].supervision.reaction >= row.reaction
        assert pair.axes[place].stopped is not None
    for place in {0, 1}.difference(row.whom):
        assert not pair.axes[place].supervision.events
        assert pair.follows(place, 300)
        assert not pair.axes[place].supervision.events
    pair.turn(300)
    if stops:
        assert all(pair.stands(place) for place in row.whom)
        assert not any(pair.axes[place].riding for place in row.whom)


def test_the_quick_stop_is_driven_and_confirmed_while_the_other_axis_moves(pair: TwoAxes) -> None:
    pair.interfere(0x601, bytes(8))
    pair.turn()
    assert pair.axes[0].riding
    assert pair.follows(1)
    assert not pair.axes[0].riding
    assert pair.axes[0].confirmed
    assert "did not confirm" not in str(pair.axes[0].stopped)
    assert pair.axes[0].image.power.state is State.SWITCH_ON_DISABLED


def test_a_stop_that_is_not_confirmed_says_so_and_delays_nobody_for_ever(pair: TwoAxes) -> None:
    pair.nodes[0].faults.silent = True
    pair.turn(2)
    pair.turn(270)
    assert not pair.axes[0].riding
    assert "did not confirm it" in str(pair.axes[0].stopped)
    pair.bus.sent.clear()
    pair.turn(20)
    syncs = [time_s for time_s, can_id, _ in pair.bus.sent if can_id == 0x080]
    targets = [time_s for time_s, can_id, _ in pair.bus.sent if can_id == 0x202]
    assert len(syncs) == len(targets) == 20
    assert targets == pytest.approx(syncs, abs=1e-9)


def test_a_latched_axis_gets_no_rpdo_while_the_other_moves(pair: TwoAxes) -> None:
    pair.interfere(0x701, b"\x00")
    pair.bus.sent.clear()
    pair.turn(20)
    assert [can_id for _, can_id, _ in pair.bus.sent].count(0x201) == 0
    assert [can_id for _, can_id, _ in pair.bus.sent].count(0x202) == 20
    assert pair.axes[0].silent
    pair.axes[0].begin()
    assert pair.axes[0].silent, "a latch is not released by beginning anew"


def test_after_a_latch_nothing_enables_the_axis_by_itself(pair: TwoAxes) -> None:
    pair.interfere(0x701, b"\x00")
    pair.turn(300)
    pair.axes[0].reset(verified=True)
    pair.axes[0].begin()
    pair.turn(300)
    assert pair.axes[0].image.power.state is not State.OPERATION_ENABLED
    assert pair.follows(1)


def test_a_stopped_axis_is_reset_and_moves_again_while_the_other_never_stopped(pair: TwoAxes) -> None:
    pair.interfere(0x601, bytes(8))
    pair.turn(100)
    assert pair.axes[0].stopped is not None
    pair.axes[0].reset()
    pair.axes[0].image.power.go(State.SWITCH_ON_DISABLED)
    pair.turn(20)
    pair.enable(0)
    assert pair.follows(0)
    assert pair.follows(1)


def test_a_stopped_axis_is_told_nothing_and_not_asked(pair: TwoAxes) -> None:
    pair.interfere(0x601, bytes(8))
    pair.turn()
    asked: list[object] = []
    pair.moving[0] = False
    pair.axes[0].command = asked.append  # type: ignore[assignment]
    pair.axes[0].image.power.go(State.OPERATION_ENABLED)
    pair.turn(100)
    assert asked == []
    assert pair.axes[0].image.power.state is not State.OPERATION_ENABLED


def test_after_the_interface_was_opened_anew_verified_axes_move_again(pair: TwoAxes) -> None:
    pair.bus.recv_error = DOWN
    pair.turn()
    assert pair.cycle.down is not None
    count, began = pair.cycle.count, pair.clock.now()
    pair.turn(250)
    assert pair.cycle.count == count + 250, "it keeps time without a bus"
    assert pair.clock.now() == pytest.approx(began + 1.0, abs=0.01)
    pair.bus.recv_error = None
    pair.turn()
    assert pair.cycle.down is not None, "a link that has failed stays down"
    pair.cycle.relink(Link(pair.bus, pair.clock))
    sent = len(pair.bus.sent)
    pair.turn(10)
    assert pair.cycle.down is None
    frames = [(can_id, data) for _, can_id, data in pair.bus.sent[sent:]]
    assert frames[:3] == [(0x000, b"\x80\x01"), (0x000, b"\x80\x02"), (0x080, b"")], "pre-operational first"
    assert {can_id for can_id, _ in frames[3:]} == {0x080, 0x77F}
    for place in (0, 1):
        pair.drives[place].boot()
        pair.drives[place].enable()
        pair.axes[place].reset(verified=True)
    pair.enable(0)
    pair.enable(1)
    assert pair.follows(0)
    assert pair.follows(1)
