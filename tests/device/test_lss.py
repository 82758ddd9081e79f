"""LSS: python-canopen's master finds, selects and numbers a drive; nothing that it sends disturbs an axis."""

import struct

import canopen.lss
import pytest
from canopen.lss import LssError, LssMaster
from hypothesis import given, settings
from hypothesis import strategies as st
from support.ideal_motor import IdealMotor

from hdbridge.daemon.gateway.slave import BEHAVIOUR
from hdbridge.device.lss import LssSlave
from hdbridge.sim.lockstep import lockstep_bench

from .conftest import EDS, RawMaster

PENDING_ID = 9


class Network:
    """The part of a canopen network that its LSS master uses, on the master's end of a lockstep bus."""

    def __init__(self, master: RawMaster) -> None:
        self.master = master
        self.lss = LssMaster()
        self.lss.network = self
        self.lss.RESPONSE_TIMEOUT = 0.01

    def send_message(self, can_id: int, data: bytes) -> None:
        self.master.send(can_id, bytes(data))
        for answer_id, answer in self.master.take():
            if answer_id == LssMaster.LSS_RX_COBID:
                self.lss.on_message_received(answer_id, answer, 0.0)


@pytest.fixture
def lss(master, monkeypatch):
    monkeypatch.setattr(canopen.lss.time, "sleep", lambda _: None)
    return Network(master).lss


def identity(master):
    return tuple(master.read(0x1018, sub) for sub in (1, 2, 3, 4))


def heartbeats(frames):
    return [(can_id - 0x700, data[0]) for can_id, data in frames if 0x700 <= can_id < 0x780]


def test_a_node_without_id_is_silent_until_a_fast_scan(master, lss):
    known = identity(master)
    assert lss.fast_scan() == (False, None)
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    lss.configure_node_id(255)
    master.nmt(130)
    lss.send_switch_state_global(lss.WAITING_STATE)
    master.nmt(1, 0)
    master.send(0x601, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    master.send(0x080)
    assert master.wait(0.5) == []
    assert lss.fast_scan() == (True, list(known))
    lss.configure_node_id(PENDING_ID)
    lss.send_switch_state_global(lss.WAITING_STATE)
    assert heartbeats(master.seen)[-1] == (PENDING_ID, 0)


@pytest.mark.parametrize(("rate_bps", "known"), [(500_000, 2), (1_000_000, 0), (None, None)])
def test_the_bit_rate_is_that_of_the_interface(rate_bps, known):
    slave = LssSlave(lambda sub: sub, 1, stores=True, bit_rate_bps=rate_bps)
    slave.respond(b"\x04\x01" + bytes(6))
    for table, index in [(0, each) for each in range(256)] + [(1, 2)]:
        refused = (table, index) != (0, known)
        assert slave.respond(bytes((0x13, table, index)).ljust(8, b"\0"))[:2] == bytes((0x13, refused))


def test_a_drive_with_a_fixed_node_id_stores_no_other(motor, monkeypatch):
    monkeypatch.setattr(canopen.lss.time, "sleep", lambda _: None)
    with lockstep_bench(motor, EDS, behaviour=BEHAVIOUR) as (bus, clock, node):
        master = RawMaster(bus, clock, node, motor)
        lss = Network(master).lss
        lss.send_switch_state_global(lss.CONFIGURATION_STATE)
        lss.store_configuration()
        lss.configure_node_id(PENDING_ID)
        with pytest.raises(LssError, match="LSS Error: 1"):
            lss.store_configuration()
        master.nmt(130)
        assert heartbeats(master.take()) == [(PENDING_ID, 0)]
        master.nmt(129, PENDING_ID)
        assert heartbeats(master.take()) == [(1, 0)]


COMMANDS = st.sampled_from([0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x52), *range(0x5A, 0x5F), 0xFF])


@settings(max_examples=30)
@given(st.lists(st.tuples(COMMANDS, st.binary(min_size=0, max_size=8)), max_size=20))
def test_no_command_disturbs_an_axis_in_operation(frames):
    def cruise(requests):
        motor = IdealMotor()
        with lockstep_bench(motor, EDS) as (bus, clock, node):
            master = RawMaster(bus, clock, node, motor)
            master.enable_csp()
            seen = []
            for place in range(22):
                for request in requests[place : place + 1]:
                    master.send(0x7E5, request)
                seen.append((master.cruise(10, 1), motor.motor_counts))
            return seen, master.emergencies(), node.node_id

    selected = b"\x04\x01" + bytes(6)
    assert cruise([selected, *(bytes((command, *rest))[:8] for command, rest in frames)]) == cruise([])
