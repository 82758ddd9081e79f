"""A master listens before it speaks, and holds a lock on its interface while it does."""

import os
import pwd
import re
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
import pytest
from support.chatter import Chatter

from hdbridge.axis import AxisConfig
from hdbridge.drive.drive import Drive
from hdbridge.drive.interfacelock import InterfaceLock, holders
from hdbridge.drive.link import open_bus
from hdbridge.errors import BusError, BusInUseError
from hdbridge.files.profile import bundled_profile
from hdbridge.sim.lockstep import lockstep_bench, simulated_bench
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

AXIS = AxisConfig.load(bundled_profile("article"))
SDO_REQUEST = (0x601, b"\x40\x00\x10\0\0\0\0\0")


@contextmanager
def bench(*frames, period_s=0.1):
    """Provides the master's end of a bus on which another node sends ``frames``, and a witness of the sent
    frames.
    """
    channel = f"detection-{uuid4()}"
    truth = Truth.load(bundled_profile("article"))
    with ExitStack() as stack:
        chatter, witness = (
            stack.enter_context(can.Bus(interface="virtual", channel=channel, ignore_config=True))
            for _ in range(2)
        )
        others: Any = [Chatter(chatter, *frames, period_s=period_s)]
        bus, clock, _ = stack.enter_context(
            lockstep_bench(Machine(truth, 0), AXIS.eds_path, 1, channel, others=others)
        )
        yield bus, clock, witness


def identifiers(witness: can.BusABC) -> set[int]:
    seen = set()
    while (message := witness.recv(0)) is not None:
        seen.add(message.arbitration_id)
    return seen


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        ((0x080, b""), "SYNC"),
        ((0x000, b"\x01\x05"), "NMT commands"),
        ((0x77F, b"\x05"), "heartbeats of master 127"),
        ((0x201, bytes(6)), "set-points of node 1"),
        ((0x301, bytes(6)), "set-points of node 1"),
        ((0x501, bytes(6)), "set-points of node 1"),
        (SDO_REQUEST, "SDO requests to node 1"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value[0]:03X}h",
)
def test_a_drive_of_another_master_is_left_alone(frame: tuple[int, bytes], name: str) -> None:
    with bench(frame) as (bus, clock, witness), Drive(bus, AXIS, clock) as drive:
        with pytest.raises(BusInUseError, match=f"another master is on this bus: .*{name}") as refused:
            drive.boot()
        assert "\n" not in str(refused.value)
        drive.close()
        assert identifiers(witness) <= {frame[0], 0x701, 0x581}
    assert refused.value.exit_status == 3


def test_the_slowest_other_master_is_heard() -> None:
    with bench((0x080, b""), period_s=0.255) as (bus, clock, _), pytest.raises(BusInUseError):
        Drive(bus, AXIS, clock).boot()


def test_frames_of_other_nodes_are_not_a_master() -> None:
    others = ((0x702, b"\x05"), (0x182, bytes(8)), (0x202, bytes(6)), (0x602, bytes(8)), (0x081, bytes(8)))
    with bench(*others) as (bus, clock, _), Drive(bus, AXIS, clock) as drive:
        drive.boot()


def test_old_frames_are_not_evidence_of_a_master() -> None:
    with bench() as (bus, clock, witness), Drive(bus, AXIS, clock) as drive:
        witness.send(can.Message(arbitration_id=0x080, is_extended_id=False))
        drive.boot()


def test_force_skips_the_check() -> None:
    with bench((0x77F, b"\x05")) as (bus, clock, _), Drive(bus, AXIS, clock, force=True) as drive:
        drive.boot()


def test_listens_once_and_not_on_a_private_bus() -> None:
    with bench() as (bus, clock, _), Drive(bus, AXIS, clock) as drive:
        drive.listen()
        begun_s = clock.now()
        drive.listen()
        assert clock.now() == begun_s
    with simulated_bench(bundled_profile("article"), AXIS.eds_path) as (bus, clock, _):
        Drive(bus, AXIS, clock).listen()
        assert clock.now() == 0.0


# ------------------------------------------------------------------ the lock


def test_one_master_per_interface_on_a_machine(tmp_path: Path) -> None:
    with InterfaceLock("socketcan", "can0", tmp_path):
        user, number = pwd.getpwuid(os.getuid()).pw_name, os.getpid()
        other = (
            "socketcan:can0: another hdbridge on this machine masters it "
            f".*process {number} of {user}, '.*end it with 'kill {number}'"
        )
        with (
            pytest.raises(BusInUseError, match=other),
            InterfaceLock("socketcan", "can0", tmp_path),
        ):
            pass
        with InterfaceLock("socketcan", "can1", tmp_path), InterfaceLock("slcan", "/dev/ttyUSB0", tmp_path):
            pass
    with InterfaceLock("socketcan", "can0", tmp_path):
        pass


def test_holders_of_all_interfaces_are_listed(tmp_path):
    assert holders(tmp_path) == {}
    with InterfaceLock("socketcan", "can0", tmp_path), InterfaceLock("slcan", "/dev/ttyUSB0", tmp_path):
        (tmp_path / "hdbridge-socketcan-can7.lock").touch()  # the lock of a process that has ended
        (tmp_path / "another.lock").touch()
        found = holders(tmp_path)
    assert list(found) == [os.getpid()]
    assert re.fullmatch(rf"s\w+can:.* is held by process {os.getpid()} of .+, '.+'", found[os.getpid()])
    assert holders(tmp_path) == {}


def test_the_virtual_bus_needs_no_lock(tmp_path: Path) -> None:
    with InterfaceLock("virtual", "x", tmp_path), InterfaceLock("virtual", "x", tmp_path):
        assert not list(tmp_path.iterdir())


def test_an_unusable_lock_is_reported(tmp_path: Path) -> None:
    (tmp_path / "hdbridge-socketcan-can0.lock").symlink_to(tmp_path / "elsewhere")
    with (
        pytest.raises(BusError, match="lock of the CAN interface"),
        InterfaceLock("socketcan", "can0", tmp_path),
    ):
        pass


def test_opening_a_bus_takes_the_lock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The lock is required for every kind of interface: no interface is opened before the lock is held."""
    monkeypatch.setattr("hdbridge.drive.interfacelock._folder", lambda: tmp_path)
    settings = AXIS.on_bus(interface="socketcan", channel="absent0").bus
    with InterfaceLock("socketcan", "absent0"):
        with pytest.raises(BusInUseError), open_bus(settings):
            pass
        with pytest.raises(BusError, match="cannot open it"), open_bus(settings, shared=True):
            pass
    with pytest.raises(BusError, match="cannot open it"), open_bus(settings):
        pass
