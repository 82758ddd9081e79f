"""One control cycle for several axes: order, silent axes, joining and leaving, figures of a cycle."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import pytest
from support.twoaxes import TwoAxes, axis_of, two_axes

from hdbridge.axis.encoders import Source
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.drive.busload import FRAME_BITS, bus_load
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import InputError


@pytest.fixture
def pair() -> Iterator[TwoAxes]:
    """Both enabled and moving at constant speed."""
    with two_axes() as made:
        made.enable(0)
        made.enable(1)
        made.turn(60)
        made.bus.sent.clear()
        yield made


def test_bus_load_is_unknown_without_a_bit_rate() -> None:
    with two_axes(bitrate_bps=None) as made:
        made.turn()
        assert math.isnan(made.cycle.bus_load)


def test_one_sync_both_rpdos_and_one_heartbeat(pair: TwoAxes) -> None:
    pair.turn(250)
    sent = [can_id for _, can_id, _ in pair.bus.sent]
    assert sent.count(0x080) == sent.count(0x201) == sent.count(0x202) == 250
    assert sent.count(0x77F) == pytest.approx(1.0 / 0.025, abs=3)
    assert {(can_id, data) for _, can_id, data in pair.bus.sent if can_id in (0x080, 0x77F)} == {
        (0x080, b""),
        (0x77F, b"\x05"),
    }
    frames = "".join({0x080: "s", 0x201: "1", 0x202: "2", 0x77F: "h"}[can_id] for can_id in sent)
    assert frames.replace("h", "") == "s12" * 250
    times = [time_s for time_s, can_id, _ in pair.bus.sent if can_id == 0x080]
    assert [b - a for a, b in pairwise(times)] == pytest.approx([0.004] * 249, abs=1e-9)


def test_the_shortest_heartbeat_of_the_axes_is_kept() -> None:
    with two_axes() as pair:
        cycle = pair.cycle
        cycle.leave(pair.axes[1])
        slow = axis_of(2, heartbeat_ms=20)
        cycle.join(AxisCycle(ProcessImage(slow), Supervision()))
        times = []
        cycle.on_frame = None
        for _ in range(100):
            cycle.exchange()
            while (message := pair.intruder.recv(0)) is not None:
                if message.arbitration_id == 0x77F:
                    times.append(pair.clock.now())
        assert max(b - a for a, b in pairwise(times)) <= 0.010 + 0.004 + 1e-9


# ------------------------------------------------------------------ silent axes


def test_a_new_axis_is_silent_and_its_tpdos_are_taken() -> None:
    with two_axes() as pair:
        pair.enable(0)
        pair.turn(30)
        assert pair.axes[1].silent
        assert all(pair.fresh[1][-20:])
        assert 0x202 not in {can_id for _, can_id, _ in pair.bus.sent}
        assert pair.axes[1].image.statusword is not None


def test_a_silent_axis_neither_delays_the_other_nor_faults() -> None:
    with two_axes() as pair:
        pair.enable(0)
        pair.nodes[1].faults.silent = True
        pair.turn(100)
        pair.bus.sent.clear()
        assert pair.follows(0)
        assert not any(pair.fresh[1][-20:])
        assert not pair.axes[1].supervision.events
        syncs = [time_s for time_s, can_id, _ in pair.bus.sent if can_id == 0x080]
        targets = [time_s for time_s, can_id, _ in pair.bus.sent if can_id == 0x201]
        assert targets == pytest.approx(syncs, abs=1e-9)


def test_frames_of_a_silent_axis_cause_no_fault_and_reach_the_hook() -> None:
    with two_axes() as pair:
        pair.enable(0)
        heard: list[tuple[int, bytes]] = []
        pair.cycle.on_frame = lambda frame: heard.append(frame[:2])
        for can_id, data in ((0x702, b"\x00"), (0x702, b"\x7f"), (0x082, bytes(8)), (0x582, bytes(8))):
            pair.interfere(can_id, data)
            pair.turn()
            assert (can_id, data) in heard
        pair.interfere(0x602, bytes(8))
        pair.turn()
        assert not pair.axes[1].supervision.events
        assert pair.follows(0)


# ------------------------------------------------------------------ joining and leaving


def test_frames_of_an_axis_that_left_are_ignored(pair: TwoAxes) -> None:
    pair.moving[1] = False
    pair.axes[1].image.power.go(State.SWITCH_ON_DISABLED)
    pair.turn(50)
    pair.cycle.leave(pair.axes[1])
    pair.bus.sent.clear()
    pair.interfere(0x702, b"\x00")
    assert pair.follows(0)
    assert 0x202 not in {can_id for _, can_id, _ in pair.bus.sent}
    pair.cycle.join(pair.axes[1])
    pair.axes[1].begin()
    pair.turn(20)
    assert pair.axes[1].feedback.fresh
    assert not pair.axes[1].supervision.events


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (axis_of(1, "second"), ["'second'", "'axis 1'", "node 1", "drive.node_id"]),
        (axis_of(2, "second", master_node_id=100), ["drive.master_node_id", "100", "127"]),
        (axis_of(127, "second"), ["node 127", "'second'"]),
        (axis_of(2, "second", cycle_ms=8.0), ["drive.cycle_ms", "8 ms", "4 ms"]),
    ],
    ids=["node id", "master", "node id of the master", "cycle"],
)
def test_axes_that_cannot_share_a_bus_are_refused(other, words: list[str]) -> None:
    with two_axes(boot=()) as pair:
        pair.cycle.leave(pair.axes[1])
        with pytest.raises(InputError) as refused:
            pair.cycle.join(AxisCycle(ProcessImage(other), Supervision()))
        for word in words:
            assert word in str(refused.value)
        assert pair.cycle.axes == pair.axes[:1]


def test_one_load_encoder_node_cannot_be_two_axes() -> None:
    source = Source(index=0x6004, subindex=0, type="uint32", via="tpdo", node=5)

    def with_encoder(node_id: int) -> AxisCycle:
        axis = axis_of(node_id)
        encoder = axis.load_encoder.model_copy(update={"source": source})
        return AxisCycle(ProcessImage(axis.model_copy(update={"load_encoder": encoder})), Supervision())

    with two_axes(boot=()) as pair:
        pair.cycle.leave(pair.axes[0])
        pair.cycle.leave(pair.axes[1])
        pair.cycle.join(with_encoder(1))
        with pytest.raises(InputError, match=r"load_encoder\.source\.node.*'axis 2'.*node 5.*'axis 1'"):
            pair.cycle.join(with_encoder(2))


# ------------------------------------------------------------------ figures of a cycle


def test_reports_lateness_and_load_of_a_turn(pair: TwoAxes) -> None:
    busy = iter([0.0, 0.001])

    def compute(feedback: object) -> None:
        pair.clock.sleep_until(pair.clock.now() + next(busy))

    pair.moving[0] = False
    pair.axes[0].command = compute
    pair.turn()
    assert (pair.cycle.late_s, pair.cycle.busy_s) == pytest.approx((0.0, 0.0), abs=1e-12)
    pair.turn()
    assert pair.cycle.busy_s == pytest.approx(0.001, abs=1e-9)
    pair.axes[0].command = None
    pair.hang(0.0045)
    pair.turn()
    assert pair.cycle.late_s == pytest.approx(0.0015, abs=1e-9)


def test_bus_load_of_a_turn_matches_its_frames(pair: TwoAxes) -> None:
    cycle = pair.cycle
    while pair.intruder.recv(0) is not None:
        pass
    for _ in range(50):
        pair.turn()
        seen = 0
        while (message := pair.intruder.recv(0)) is not None:
            seen += FRAME_BITS[len(message.data)]
        # A heartbeat that arrives after the end of a cycle counts in the next one.
        assert cycle.bus_load * 4000 == pytest.approx(seen, abs=2 * FRAME_BITS[1])
    configs = [axis.image.axis for axis in pair.axes]
    most = bus_load(configs, 1_000_000)
    assert most is not None
    assert cycle.bus_load <= most


def test_one_relayed_frame_follows_the_rpdos(pair: TwoAxes) -> None:
    waiting = [(0x640, b"a"), (0x640, b"b")]
    pair.cycle.outgoing = lambda: waiting.pop(0) if waiting else None
    pair.turn(3)
    relayed = [(place, data) for place, (_, can_id, data) in enumerate(pair.bus.sent) if can_id == 0x640]
    assert [data for _, data in relayed] == [b"a", b"b"]
    order = [can_id for _, can_id, _ in pair.bus.sent if can_id != 0x77F]
    assert order == [0x080, 0x201, 0x202, 0x640, 0x080, 0x201, 0x202, 0x640, 0x080, 0x201, 0x202]


def test_a_relayed_frame_without_room_stops_no_axis(pair: TwoAxes) -> None:
    pair.bus.no_room_for = 0x640
    waiting = [(0x640, b"a")]
    pair.cycle.outgoing = lambda: waiting.pop(0) if waiting else None
    assert pair.follows(0)
    assert pair.cycle.refused == 1
    assert not pair.axes[0].supervision.events


def test_a_late_turn_relays_nothing(pair: TwoAxes) -> None:
    asked: list[int] = []
    pair.cycle.outgoing = lambda: asked.append(1)  # type: ignore[func-returns-value]
    pair.moving[0] = False
    pair.axes[0].command = lambda feedback: pair.clock.sleep_until(pair.clock.now() + 0.0037)
    pair.turn()
    assert asked == []
    pair.axes[0].command = None
    pair.turn()
    assert asked == [1]


def test_events_since_a_count_are_the_newer_ones(pair: TwoAxes) -> None:
    supervision = pair.axes[0].supervision
    pair.nodes[0].faults.drop_tpdos = 1
    pair.turn()
    noted = supervision.noted
    assert [event.fault for event in supervision.since(0)] == [event.fault for event in supervision.events]
    assert supervision.since(noted) == []
    pair.interfere(0x77F, b"\x05")
    pair.turn()
    assert [event.fault.name for event in supervision.since(noted)] == ["OWN_ID_ELSEWHERE"]
