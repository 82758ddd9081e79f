"""The cycle's link on real sockets: vcan, vxcan and slcan."""

import os
import select
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from hdbridge.clock import MonotonicClock
from hdbridge.drive.fastlink import fast_link
from hdbridge.drive.link import Frame, Link, TransmitBufferFull
from hdbridge.errors import BusError


@pytest.fixture
def pair(interface: str) -> Iterator[tuple[Link, can.BusABC]]:
    """A link, and another node on its bus."""
    with (
        can.Bus(interface="socketcan", channel=interface, ignore_config=True) as bus,
        can.Bus(interface="socketcan", channel=interface, ignore_config=True) as other,
    ):
        link = fast_link(Link(bus, MonotonicClock()))
        assert type(link) is not Link
        yield link, other


@pytest.mark.parametrize("data", [b"", b"\x05", bytes(range(8))])
def test_frames_go_out_and_come_in_as_they_are(pair, data: bytes) -> None:
    link, other = pair
    link.send(0x123, data)
    message = other.recv(1.0)
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x123, data, False)
    other.send(can.Message(arbitration_id=0x7FF, data=data, is_extended_id=False))
    frame = link.recv(link.now() + 1.0)
    assert isinstance(frame, Frame)
    assert frame[:2] == (0x7FF, data)


def test_its_own_frames_do_not_come_back(pair) -> None:
    link, _ = pair
    link.send(0x123, b"")
    deadline = link.now() + 0.05
    assert link.recv(deadline) is None
    assert link.now() >= deadline


def test_a_deadline_that_has_passed_polls_once(pair) -> None:
    link, other = pair
    assert link.recv(0.0) is None
    other.send(can.Message(arbitration_id=0x55, is_extended_id=False))
    time.sleep(0.05)
    assert link.recv(0.0) is not None


def test_remote_and_extended_frames_are_dropped_and_counted(pair) -> None:
    link, other = pair
    other.send(can.Message(arbitration_id=0x181, is_extended_id=False, is_remote_frame=True))
    other.send(can.Message(arbitration_id=0x181, is_extended_id=True, data=bytes(8)))
    other.send(can.Message(arbitration_id=0x182, is_extended_id=False))
    assert link.recv(link.now() + 1.0)[0] == 0x182
    assert (link.dropped.remote, link.dropped.extended) == (1, 1)


def test_an_interface_that_went_down_stays_unusable(pair, may_configure, interface: str) -> None:
    link, _ = pair
    may_configure("link", "set", "down", interface)
    with pytest.raises(BusError, match="interface"):
        link.recv(link.now() + 0.1)
    may_configure("link", "set", "up", interface)
    with pytest.raises(BusError):
        link.send(0x80, b"")
    assert link.down is not None


@pytest.fixture
def stuck_slcan(may_configure) -> Iterator[str]:
    """Serial CAN adapter that accepts no more data: a pseudo terminal without a reader."""
    ours, theirs = os.openpty()
    name = "slcan9"
    daemon = subprocess.Popen(
        ["slcand", "-o", "-s8", "-F", os.ttyname(theirs), name],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        for _ in range(50):
            if Path(f"/sys/class/net/{name}").exists():
                break
            time.sleep(0.1)
        else:
            pytest.skip("this kernel has no slcan")
        may_configure("link", "set", "up", name)
        yield name
    finally:
        # The terminal must be drained, or the daemon cannot end.
        while select.select([ours], [], [], 0.1)[0]:
            os.read(ours, 65536)
        daemon.terminate()
        daemon.wait()
        os.close(ours)
        os.close(theirs)


def test_a_full_transmit_queue_has_its_own_error(stuck_slcan: str) -> None:
    with can.Bus(interface="socketcan", channel=stuck_slcan, ignore_config=True) as bus:
        link = fast_link(Link(bus, MonotonicClock()))

        def send_for_ever() -> None:
            for _ in range(20_000):
                link.send(0x201, bytes(8))

        with pytest.raises(TransmitBufferFull):
            send_for_ever()
        assert link.down is None
