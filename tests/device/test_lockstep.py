"""The lockstep bus and the virtual clock: deterministic time that passes only while waiting."""

import struct
from pathlib import Path

import can
import pytest

from hdbridge.errors import InputError
from hdbridge.sim.lockstep import (
    LockstepBus,
    SimulatedAxis,
    VirtualClock,
    lockstep_bench,
    simulated_benches,
)

ROOT = Path(__file__).parents[2]
EDS = ROOT / "eds" / "hdbridge-402.eds"
ARTICLE = ROOT / "profiles" / "article"


def message(can_id: int, data: bytes = b"", **flags) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False, **flags)


def test_time_passes_only_while_waiting(master):
    before = master.clock.now()
    master.put(0x607A, 0, 5, 4)
    master.bus.recv(0)
    assert master.clock.now() == before
    assert master.bus.recv(0.25) is None
    assert master.clock.now() == before + 0.25
    master.clock.sleep_until(before + 1.0)
    assert master.clock.now() == before + 1.0
    master.clock.sleep_until(before)
    assert master.clock.now() == before + 1.0


def test_a_wait_ends_with_the_frame(master):
    before = master.clock.now()
    master.put(0x1017, 0, 30, 2)
    frame = master.bus.recv(1.0)
    assert frame.arbitration_id == 0x701
    assert frame.timestamp == master.clock.now() == pytest.approx(before + 0.03)


def test_a_wait_without_peers_ends():
    clock = VirtualClock(5.0)
    with LockstepBus("nobody-here", clock) as bus:
        assert bus.recv(1.0) is None
        assert clock.now() == 6.0
        with pytest.raises(can.CanOperationError, match="virtual time"):
            bus.recv()


def test_filters_are_applied(master):
    master.bus.set_filters([{"can_id": 0x181, "can_mask": 0x7FF, "extended": False}])
    master.nmt(1)
    master.send(0x080)
    assert [can_id for can_id, _ in master.take()] == [0x181]


def test_other_nodes_on_the_channel_are_received(motor):
    with (
        lockstep_bench(motor, EDS, channel="shared-channel") as (bus, _, _),
        can.Bus(interface="virtual", channel="shared-channel", ignore_config=True) as other,
    ):
        other.send(message(0x000, b"\x01\x01"))
        other.send(message(0x080))
        got = []
        while (frame := bus.recv(0)) is not None:
            got.append(frame.arbitration_id)
        assert got == [0x000, 0x080, 0x181, 0x281]
        assert other.recv(0).arbitration_id == 0x181


def test_every_kind_of_frame_passes_unchanged(motor):
    with (
        lockstep_bench(motor, EDS, channel="kinds") as (bus, _, _),
        can.Bus(interface="virtual", channel="kinds", ignore_config=True) as other,
    ):
        frames = [
            message(0x123, b"\x01\x02"),
            message(0x124, is_remote_frame=True, dlc=4),
            can.Message(arbitration_id=0x18FF0001, data=b"abc", is_extended_id=True),
            message(0x125, bytes(12), is_fd=True),
        ]
        for frame in frames:
            bus.send(frame)
            assert other.recv(0).equals(
                frame, timestamp_delta=None, check_channel=False, check_direction=False
            )


def run_several(node_ids: list[int]) -> dict[int, list[bytes]]:
    """Sends 200 SYNCs to several axes on one bus; returns the TPDO1s of each by its node id."""
    frames: dict[int, list[bytes]] = {node_id: [] for node_id in node_ids}
    axes = [SimulatedAxis(ARTICLE, EDS, node_id, seed=node_id) for node_id in node_ids]
    with simulated_benches(axes) as (bus, clock, nodes):
        assert [node.node_id for node in nodes] == node_ids
        bus.send(message(0x000, b"\x01\x00"))
        for k in range(200):
            clock.sleep_until(k * 0.004)
            bus.send(message(0x080))
            while (frame := bus.recv(0)) is not None:
                if 0x180 <= frame.arbitration_id < 0x200:
                    frames[frame.arbitration_id - 0x180].append(bytes(frame.data))
            for node_id in node_ids:
                word = 0x0006 if k < 3 else 0x0007 if k < 5 else 0x000F
                bus.send(message(0x200 + node_id, struct.pack("<Hi", word, 20 * max(0, k - 6))))
    return frames


def test_axes_on_one_bus_do_not_disturb_each_other():
    together = run_several([1, 2, 5])
    assert all(len(frames) == 200 for frames in together.values())
    for node_id in (1, 2, 5):
        assert together[node_id] == run_several([node_id])[node_id]


def test_two_simulated_drives_need_different_node_ids():
    twice = [SimulatedAxis(ARTICLE, EDS, 4), SimulatedAxis(ARTICLE, EDS, 4)]
    with pytest.raises(InputError, match="node 4"), simulated_benches(twice):
        pass
