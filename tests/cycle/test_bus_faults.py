"""Stop, latch and recovery of one axis while the other moves; `test_reliability` has the fault table."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import pytest
from support.twoaxes import TwoAxes, two_axes

from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction


@pytest.fixture
def pair() -> Iterator[TwoAxes]:
    """Both enabled and moving at constant speed."""
    with two_axes() as made:
        made.enable(0)
        made.enable(1)
        made.turn(60)
        yield made


@pytest.mark.parametrize(("can_id", "allowed"), [(0x080, 1), (0x201, 1), (0x202, 1), (0x77F, 8)])
def test_no_room_for_any_frame_stops_both(pair: TwoAxes, can_id: int, allowed: int) -> None:
    pair.bus.no_room_for = can_id
    pair.turn(allowed)
    for axis in pair.axes:
        assert axis.stopped is not None
        assert axis.supervision.stop.fault is Fault.TRANSMIT_FULL
    pair.turn(300)
    assert pair.stands(0)
    assert pair.stands(1)


def broken(feedback: object) -> int:
    raise ZeroDivisionError("1 / 0")


def test_an_exception_in_a_command_stops_only_its_axis(pair: TwoAxes) -> None:
    pair.moving[0] = False
    pair.axes[0].command = broken
    pair.turn()
    assert pair.reactions(0, Fault.BAD_TARGET) == [Reaction.QUICK_STOP]
    assert pair.follows(1, 300)
    assert not pair.axes[1].supervision.events
    assert pair.stands(0)
    assert not pair.axes[0].stopping


def test_the_quick_stop_is_driven_and_confirmed_while_the_other_axis_moves(pair: TwoAxes) -> None:
    pair.interfere(0x601, bytes(8))
    pair.turn()
    assert pair.axes[0].stopping
    assert pair.follows(1)
    assert not pair.axes[0].stopping
    assert pair.axes[0].confirmed
    assert "did not confirm" not in str(pair.axes[0].stopped)
    assert pair.axes[0].image.power.state is State.SWITCH_ON_DISABLED


def test_an_unconfirmed_stop_is_reported_and_delays_no_axis_forever(pair: TwoAxes) -> None:
    pair.nodes[0].faults.silent = True
    pair.turn(2)
    pair.turn(270)
    assert not pair.axes[0].stopping
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
    assert pair.axes[0].silent, "a latch is not released by a new start"


def test_nothing_enables_a_latched_axis_automatically(pair: TwoAxes) -> None:
    pair.interfere(0x701, b"\x00")
    pair.turn(300)
    pair.axes[0].reset(verified=True)
    pair.axes[0].begin()
    pair.turn(300)
    assert pair.axes[0].image.power.state is not State.OPERATION_ENABLED
    assert pair.follows(1)


def test_a_stopped_axis_gets_no_commands(pair: TwoAxes) -> None:
    pair.interfere(0x601, bytes(8))
    pair.turn()
    asked: list[object] = []
    pair.moving[0] = False
    pair.axes[0].command = asked.append  # type: ignore[assignment]
    pair.axes[0].image.power.go(State.OPERATION_ENABLED)
    pair.turn(100)
    assert asked == []
    assert pair.axes[0].image.power.state is not State.OPERATION_ENABLED


def test_verified_axes_move_again_after_the_interface_is_reopened(pair: TwoAxes) -> None:
    pair.bus.down = errno.ENETDOWN
    pair.turn()
    assert pair.cycle.down is not None
    count, began = pair.cycle.count, pair.clock.now()
    pair.turn(250)
    assert pair.cycle.count == count + 250, "it keeps time without a bus"
    assert pair.clock.now() == pytest.approx(began + 1.0, abs=0.01)
    pair.bus.down = None
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
