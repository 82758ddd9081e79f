"""Further services of CiA 301: node guarding, SYNC with a counter, stored parameters."""

from __future__ import annotations

import struct
from contextlib import contextmanager

import can
import pytest
from can.interfaces.virtual import VirtualBus

from hdbridge.device.dictionary import BUNDLED
from hdbridge.device.node import DriveNode
from hdbridge.sim.lockstep import VirtualClock
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

NODE = 1
SAVE, LOAD = struct.unpack("<I", b"save")[0], struct.unpack("<I", b"load")[0]


class Bench:
    def __init__(self, channel, truth, store=None):
        self.clock = VirtualClock()
        self.master, self._bus = VirtualBus(channel), VirtualBus(channel)
        self.node = DriveNode(self._bus, Machine(truth, 0), BUNDLED, NODE, self.clock, store=store)
        self.frames()

    def send(self, can_id, data=b"", *, remote=False):
        self.master.send(
            can.Message(arbitration_id=can_id, data=data, is_extended_id=False, is_remote_frame=remote)
        )
        return self.frames()

    def frames(self, until_s=None):
        if until_s is not None:
            while self.node.next_event_s() <= until_s:
                self.clock.now_s = max(self.clock.now_s, self.node.next_event_s())
                self.node.poll(self.clock.now_s)
            self.clock.now_s = until_s
        self.node.poll(self.clock.now_s)
        found = []
        while (message := self.master.recv(0)) is not None:
            found.append((message.arbitration_id, bytes(message.data)))
        return found

    def write(self, index, sub, value, size):
        head = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        ((_, answer),) = self.send(0x600 + NODE, head + value.to_bytes(size, "little").ljust(4, b"\0"))
        return int.from_bytes(answer[4:], "little")

    def value(self, index, sub=0):
        return self.node.dictionary.value(index, sub)


@pytest.fixture
def bench(request):
    with bench_of(request.node.name) as made:
        yield made


@contextmanager
def bench_of(channel, store=None):
    made = Bench(channel, Truth.load(BUNDLED.parents[1] / "profiles" / "article" / "truth.yaml"), store)
    yield made
    made.master.shutdown()
    made._bus.shutdown()


def test_node_guarding_tells_the_state_with_a_toggle_bit(bench):
    asked = [bench.send(0x701, remote=True) for _ in range(3)]
    assert asked == [[(0x701, b"\x7f")], [(0x701, b"\xff")], [(0x701, b"\x7f")]]
    bench.send(0, bytes((1, NODE)))
    assert bench.send(0x701, remote=True) == [(0x701, b"\x85")]
    assert bench.send(0x701, b"\x05") == []  # a data frame is no request


def test_life_guarding_begins_with_the_first_request(bench):
    assert bench.write(0x100C, 0, 100, 2) == bench.write(0x100D, 0, 3, 1) == 0
    assert bench.frames(2.0) == []
    bench.send(0x701, remote=True)
    assert bench.frames(2.29) == []
    assert [data[:2] for can_id, data in bench.frames(2.31) if can_id == 0x81] == [b"\x30\x81"]
    assert [data[:2] for can_id, data in bench.send(0x701, remote=True) if can_id == 0x81] == [b"\0\0"]


def test_a_tpdo_counts_from_its_sync_start_value(bench):
    bench.write(0x1019, 0, 10, 1)
    bench.write(0x1800, 1, 0x80000181, 4)
    assert bench.write(0x1800, 6, 3, 1) == 0
    bench.write(0x1800, 2, 4, 1)
    bench.write(0x1800, 1, 0x181, 4)
    assert bench.write(0x1800, 6, 4, 1) == 0x08000022  # fixed while the PDO exists
    bench.send(0, bytes((1, NODE)))
    sent = []
    for turn in range(20):
        bench.clock.now_s += 0.004
        sent += [turn % 10 + 1 for can_id, _ in bench.send(0x80, bytes((turn % 10 + 1,))) if can_id == 0x181]
    assert sent == [3, 7, 1, 5, 9]


def test_stored_parameters_outlive_a_reset_and_the_process(tmp_path, request):
    store = tmp_path / "parameters.json"
    with bench_of("store-1", store) as bench:
        bench.write(0x6065, 0, 1234, 4)
        assert bench.write(0x1010, 1, LOAD, 4) == 0x08000020
        assert bench.write(0x1010, 1, SAVE, 4) == 0
        bench.write(0x6065, 0, 99, 4)
        bench.write(0x607A, 0, 5000, 4)
        bench.send(0, bytes((129, NODE)))
        assert bench.value(0x6065) == 1234
    with bench_of("store-2", store) as bench:
        assert bench.value(0x6065) == 1234
        assert bench.value(0x607A) == 0
        default = bench.node.dictionary[0x6065, 0].default
        assert bench.write(0x1011, 1, LOAD, 4) == 0
        assert bench.value(0x6065) == 1234  # until the next reset
        bench.send(0, bytes((129, NODE)))
        assert bench.value(0x6065) == default
    for content in (
        b"",
        b"{",
        b"[1]",
        b'{"6065:00": "x", "zz": 1, "6098:00": 1e99, "607D:01": 1e3}',
        b"\xff\xfe",
    ):
        store.write_bytes(content)
        with bench_of("store-3", store) as bench:
            assert bench.value(0x6065) == default


def test_nothing_is_stored_while_the_axis_has_power(bench):
    bench.write(0x6060, 0, 1, 1)
    for word in (6, 7, 15):
        bench.write(0x6040, 0, word, 2)
    assert bench.write(0x1010, 1, SAVE, 4) == 0x08000022
