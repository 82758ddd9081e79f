"""Stored parameters survive a reset and, with a file, the process."""

import struct
from contextlib import contextmanager

from can.interfaces.virtual import VirtualBus
from support.ideal_motor import IdealMotor

from hdbridge.device.node import DriveNode
from hdbridge.sim.lockstep import LockstepBus, VirtualClock

from .conftest import EDS, RawMaster

SAVE, LOAD = struct.unpack("<I", b"save")[0], struct.unpack("<I", b"load")[0]


@contextmanager
def stored(channel, store):
    """A drive with a file for its parameters."""
    clock, motor = VirtualClock(), IdealMotor()
    with VirtualBus(channel) as own, LockstepBus(channel, clock) as bus:
        node = DriveNode(own, motor, EDS, 1, clock, store=store)
        clock.nodes.append(node)
        yield RawMaster(bus, clock, node, motor)


def test_stored_parameters_survive_a_reset_and_the_process(tmp_path):
    store = tmp_path / "parameters.json"
    with stored("store-1", store) as master:
        master.write(0x6065, 0, 1234, 4)
        assert master.write(0x1010, 1, LOAD, 4) == 0x08000020
        assert master.write(0x1010, 1, SAVE, 4) == 0
        master.write(0x6065, 0, 99, 4)
        master.write(0x607A, 0, 5000, 4)
        master.nmt(129)
        assert master.read(0x6065) == 1234
    with stored("store-2", store) as master:
        assert master.read(0x6065) == 1234
        assert master.read(0x607A) == 0
        default = master.node.dictionary[0x6065, 0].default
        assert master.write(0x1011, 1, LOAD, 4) == 0
        assert master.read(0x6065) == 1234  # the value holds until the next reset
        master.nmt(129)
        assert master.read(0x6065) == default
    for content in (
        b"",
        b"{",
        b"[1]",
        b'{"6065:00": "x", "zz": 1, "6098:00": 1e99, "607D:01": 1e3}',
        b"\xff\xfe",
    ):
        store.write_bytes(content)
        with stored("store-3", store) as master:
            assert master.read(0x6065) == default


def test_nothing_is_stored_while_the_axis_has_power(master):
    master.enable(1)
    assert master.write(0x1010, 1, SAVE, 4) == 0x08000022
