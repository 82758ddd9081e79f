"""One control cycle for several axes: its frames, its figures, and an axis that is silent or has stopped."""

import errno
import math
from collections.abc import Iterator
from itertools import pairwise

import pytest
from can.interfaces.virtual import VirtualBus
from support.daemon import SteppedDaemon, article_axis, stepped_daemon

from hdbridge.axis import AxisConfig
from hdbridge.axis.encoders import Source
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.control.buscycle import BusCycle
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import EventKind, RelayedFrame, SampleFlag
from hdbridge.drive.busload import FRAME_BITS, bus_load
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction, Supervision
from hdbridge.errors import InputError
from hdbridge.sim.lockstep import LockstepBus, VirtualClock

S, E = AxisState, EventKind
UPLOAD = RelayedFrame(0, 0x601, bytes([0x40, 0x64, 0x60, 0, 0, 0, 0, 0]))


@pytest.fixture
def both(pair: SteppedDaemon) -> SteppedDaemon:
    """Two axes at constant speed."""
    for axis in range(2):
        pair.move(300.0, axis)
    pair.run(0.5)
    return pair


@pytest.fixture
def one() -> Iterator[SteppedDaemon]:
    """Two axes, the first at constant speed, the second booted but not verified and therefore silent."""
    with stepped_daemon(2) as made:
        made.drive(1).boot()
        made.verify()
        made.enable()
        made.move(300.0)
        made.run(0.5)
        yield made


def follows(daemon: SteppedDaemon, axis: int, turns: int = 60) -> bool:
    """Returns True if an axis keeps moving, with fresh feedback in each cycle."""
    before, samples = daemon.motor_counts(axis), daemon.memory.reader()
    daemon.turn(turns)
    fresh = samples.read()[0]["axes"]["flags"][:, axis] & SampleFlag.FRESH
    return bool(fresh.all()) and daemon.motor_counts(axis) - before > 60 * turns


def stands(daemon: SteppedDaemon, axis: int) -> bool:
    before = daemon.motor_counts(axis)
    daemon.turn(20)
    return abs(daemon.motor_counts(axis) - before) <= 2


def times(sent: list[tuple[float, int, bytes]], can_id: int) -> list[float]:
    return [time_s for time_s, each, _ in sent if each == can_id]


def test_one_sync_both_rpdos_and_one_heartbeat(both: SteppedDaemon) -> None:
    sent = both.sent()
    both.turn(250)
    names = {0x080: "s", 0x201: "1", 0x202: "2", 0x77F: "h"}
    frames = "".join(names[can_id] for _, can_id, _ in sent)
    assert frames.replace("h", "") == "s12" * 250
    assert frames.count("h") == pytest.approx(1.0 / 0.025, abs=3)
    assert {(can_id, data) for _, can_id, data in sent if can_id in (0x080, 0x77F)} == {
        (0x080, b""),
        (0x77F, b"\x05"),
    }
    gaps = [b - a for a, b in pairwise(times(sent, 0x080))]
    assert gaps == pytest.approx([0.004] * 249, abs=1e-9)


def test_the_shortest_heartbeat_of_the_axes_is_kept() -> None:
    with stepped_daemon([article_axis(1), article_axis(2, heartbeat_ms=20.0)]) as daemon:
        sent = daemon.sent()
        daemon.run(0.4)
    assert max(b - a for a, b in pairwise(times(sent, 0x77F))) <= 0.010 + 0.004 + 1e-9


# ------------------------------------------------------------------ silent axes


def test_a_silent_axis_gets_no_rpdo_and_its_tpdos_are_taken(one: SteppedDaemon) -> None:
    sent, samples = one.sent(), one.memory.reader()
    one.turn(30)
    assert 0x202 not in {can_id for _, can_id, _ in sent}
    silent = samples.read()[0]["axes"][:, 1]
    assert (silent["flags"] & SampleFlag.FRESH).all()
    assert silent["statusword"].all()


def test_a_silent_axis_neither_delays_the_other_nor_faults(one: SteppedDaemon) -> None:
    one.nodes[1].faults.silent = True
    one.turn(100)
    sent, samples = one.sent(), one.memory.reader()
    assert follows(one, 0)
    assert not (samples.read()[0]["axes"]["flags"][:, 1] & SampleFlag.FRESH).any()
    assert not one.axes[1].supervision.events
    assert times(sent, 0x201) == pytest.approx(times(sent, 0x080), abs=1e-9)


def test_frames_of_a_silent_axis_cause_no_fault_and_reach_the_service(one: SteppedDaemon) -> None:
    incoming = one.memory.incoming_reader()
    frames = [(0x702, b"\x00"), (0x702, b"\x7f"), (0x082, bytes(8)), (0x582, bytes(8))]
    for frame in (*frames, (0x602, bytes(8))):
        one.interfere(*frame)
        one.turn()
    assert set(frames) <= {frame[1:] for frame in incoming.read()[0]}
    assert not one.axes[1].supervision.events
    assert follows(one, 0)


def with_load_encoder(node_id: int) -> AxisConfig:
    """Returns an axis whose load encoder is node 5."""
    axis = article_axis(node_id)
    source = Source(index=0x6004, subindex=0, type="uint32", via="tpdo", node=5)
    return axis.model_copy(update={"load_encoder": axis.load_encoder.model_copy(update={"source": source})})


@pytest.mark.parametrize(
    ("first", "other", "words"),
    [
        (article_axis(1), article_axis(1).model_copy(update={"name": "second"}),
         ["'second'", "'axis1'", "node 1", "drive.node_id"]),
        (article_axis(1), article_axis(2, master_node_id=100), ["drive.master_node_id", "100", "127"]),
        (article_axis(1), article_axis(127), ["node 127", "'axis127'"]),
        (article_axis(1), article_axis(2, cycle_ms=8.0), ["drive.cycle_ms", "8 ms", "4 ms"]),
        (with_load_encoder(1), with_load_encoder(2),
         ["load_encoder.source.node", "'axis2'", "node 5", "'axis1'"]),
    ],
    ids=["node id", "master", "node id of the master", "cycle", "load encoder"],
)  # fmt: skip
def test_axes_that_cannot_share_a_bus_are_refused(
    first: AxisConfig, other: AxisConfig, words: list[str]
) -> None:
    clock = VirtualClock()
    with LockstepBus("shared", clock) as bus:
        cycle = BusCycle(Link(bus, clock), clock, 0.004)
        cycle.join(AxisCycle(ProcessImage(first), Supervision()))
        with pytest.raises(InputError) as refused:
            cycle.join(AxisCycle(ProcessImage(other), Supervision()))
    assert all(word in str(refused.value) for word in words), refused.value
    assert len(cycle.axes) == 1


# ------------------------------------------------------------------ figures of a cycle


def slow_at(daemon: SteppedDaemon, can_id: int, duration_s: float) -> list[int]:
    """Delays the loop by this time at a frame; returns a list of the frames sent."""
    sent: list[int] = []

    def spy(each: int, _: bytes) -> None:
        sent.append(each)
        if each == can_id:
            daemon.hang(duration_s)

    daemon.bus.spy = spy
    return sent


def test_lateness_and_duration_of_a_cycle_are_reported(both: SteppedDaemon) -> None:
    samples = both.memory.reader()
    slow_at(both, 0x201, 0.001)
    both.turn()
    both.sent()
    both.hang(0.0045)
    both.turn()
    found, _ = samples.read()
    assert found["busy_us"] == pytest.approx([1000.0, 0.0], abs=0.1)
    assert found["late_us"] == pytest.approx([0.0, 1500.0], abs=0.1)


def test_bus_load_of_a_cycle_matches_its_frames(both: SteppedDaemon) -> None:
    cycle = both.controller.cycle
    with VirtualBus(both.intruder.channel_id) as witness:
        for _ in range(50):
            both.turn()
            seen = sum(FRAME_BITS[len(frame.data)] for frame in iter(lambda: witness.recv(0), None))
            # A heartbeat that arrives after the end of a cycle counts in the next one.
            assert cycle.bus_load * 4000 == pytest.approx(seen, abs=2 * FRAME_BITS[1])
    most = bus_load([axis.config for axis in both.axes], 1_000_000)
    assert most is not None
    assert cycle.bus_load <= most


def test_bus_load_is_unknown_without_a_bit_rate() -> None:
    with stepped_daemon(2, bitrate_bps=None) as daemon:
        daemon.turn()
        assert math.isnan(daemon.controller.cycle.bus_load)


def test_at_most_one_relayed_frame_follows_the_rpdos(both: SteppedDaemon) -> None:
    for _ in range(2):
        both.memory.outgoing.add(UPLOAD)
    sent = both.sent()
    both.turn(3)
    order = [can_id for _, can_id, _ in sent if can_id != 0x77F]
    assert order == [*(0x080, 0x201, 0x202, 0x601) * 2, 0x080, 0x201, 0x202]


def test_a_relayed_frame_without_room_stops_no_axis(both: SteppedDaemon) -> None:
    both.bus.no_room_for = 0x601
    both.memory.outgoing.add(UPLOAD)
    assert follows(both, 0)
    assert both.controller.cycle.refused == 1
    assert not both.axes[0].supervision.events


def test_a_late_cycle_relays_nothing(both: SteppedDaemon) -> None:
    both.memory.outgoing.add(UPLOAD)
    late = slow_at(both, 0x202, 0.0037)
    both.turn()
    assert 0x601 not in late
    sent = both.sent()
    both.turn()
    assert times(sent, 0x601)


# ------------------------------------------------------------------ an axis that stops


@pytest.mark.parametrize(("can_id", "allowed"), [(0x080, 1), (0x201, 1), (0x202, 1), (0x77F, 8)])
def test_no_room_for_any_frame_stops_both(both: SteppedDaemon, can_id: int, allowed: int) -> None:
    both.bus.no_room_for = can_id
    both.turn(allowed)
    assert both.states == [S.QUICK_STOPPED] * 2
    for axis in both.axes:
        assert axis.supervision.stop is not None
        assert axis.supervision.stop.fault is Fault.TRANSMIT_FULL
    both.turn(300)
    assert stands(both, 0)
    assert stands(both, 1)


def broken(feedback: object) -> int:
    raise ZeroDivisionError("1 / 0")


def test_an_exception_in_a_command_stops_only_its_axis(both: SteppedDaemon) -> None:
    both.axes[0].cycle.command = broken
    both.turn()
    events = both.axes[0].supervision.events
    assert [event.reaction for event in events if event.fault is Fault.BAD_TARGET] == [Reaction.QUICK_STOP]
    assert follows(both, 1, 300)
    assert not both.axes[1].supervision.events
    assert stands(both, 0)


def test_a_quick_stop_is_driven_and_confirmed_without_commands(both: SteppedDaemon) -> None:
    both.interfere(0x601, bytes(8))
    both.turn()
    asked: list[object] = []
    both.axes[0].cycle.command = asked.append  # type: ignore[assignment]
    assert both.reported(E.STOPPED) == []
    assert follows(both, 1)
    (stopped,) = both.reported(E.STOPPED, 0)
    assert "did not confirm" not in stopped.text
    assert both.axes[0].image.power.state is State.SWITCH_ON_DISABLED
    assert asked == []


def test_a_latched_axis_is_silent_while_the_other_moves(both: SteppedDaemon) -> None:
    both.interfere(0x701, b"\x00")
    sent = both.sent()
    both.turn(20)
    assert (len(times(sent, 0x201)), len(times(sent, 0x202))) == (0, 20)
    both.axes[0].cycle.begin()
    assert both.axes[0].cycle.silent, "a latch is not released by a new start"


def test_an_unconfirmed_stop_is_reported_and_delays_no_axis_forever(both: SteppedDaemon) -> None:
    both.nodes[0].faults.silent = True
    both.turn(272)
    (stopped,) = both.reported(E.STOPPED, 0)
    assert "did not confirm it" in stopped.text
    sent = both.sent()
    both.turn(20)
    assert len(times(sent, 0x202)) == 20
    assert times(sent, 0x202) == pytest.approx(times(sent, 0x080), abs=1e-9)


def test_the_cycle_continues_without_a_bus_and_drives_are_silenced_when_it_returns(
    both: SteppedDaemon,
) -> None:
    count, began_s = both.controller.cycle.count, both.clock.now()
    both.bus.down = errno.ENETDOWN
    both.turn(250)
    assert both.controller.cycle.count == count + 250
    assert both.clock.now() == pytest.approx(began_s + 1.0, abs=0.01)
    both.bus.down = None
    sent = both.sent()
    both.until(lambda: bool(both.reported(E.BUS_UP)))
    both.turn(10)
    frames = [(can_id, data) for _, can_id, data in sent]
    assert frames[:3] == [(0x000, b"\x80\x01"), (0x000, b"\x80\x02"), (0x080, b"")]
    assert {can_id for can_id, _ in frames[3:]} == {0x080, 0x77F}
