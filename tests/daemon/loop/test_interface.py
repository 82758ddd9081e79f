"""The interface of the control process: listening before use, and reopening after a failure."""

import errno
from uuid import uuid4

import can
import pytest
from support.daemon import article_axes

from hdbridge.axis import BusConfig
from hdbridge.clock import MonotonicClock
from hdbridge.daemon.loop import process
from hdbridge.daemon.loop.process import Interface, listen
from hdbridge.drive.link import Link
from hdbridge.errors import BusError, BusInUseError
from hdbridge.sim.lockstep import LockstepBus, VirtualClock


class Talker:
    """A node that sends one frame every 100 ms."""

    def __init__(self, bus: can.BusABC, can_id: int) -> None:
        self._bus, self._can_id, self._next_s = bus, can_id, 0.1

    def next_event_s(self) -> float:
        return self._next_s

    def poll(self, now_s: float) -> None:
        while self._next_s <= now_s:
            self._next_s += 0.1
            self._bus.send(can.Message(arbitration_id=self._can_id, data=b"\x05", is_extended_id=False))


@pytest.mark.parametrize(
    ("can_id", "words"),
    [
        (0x080, "SYNC"),
        (0x77F, "heartbeats of master 127"),
        (0x202, "set-points of node 2"),
        (0x601, "SDO requests to node 1"),
        (0x000, "NMT commands"),
        (0x181, None),
        (0x701, None),
        (0x203, None),
    ],
)
def test_a_bus_with_another_master_is_left_alone(can_id: int, words: str | None) -> None:
    clock = VirtualClock()
    channel = str(uuid4())
    with (
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as other,
        LockstepBus(channel, clock) as bus,
    ):
        clock.nodes.append(Talker(other, can_id))
        link = Link(bus, clock)
        if words is None:
            listen(link, tuple(article_axes(2)))
        else:
            with pytest.raises(BusInUseError, match=words):
                listen(link, tuple(article_axes(2)))
        sent = [message.arbitration_id for message in iter(lambda: other.recv(0), None)]
        assert sent == [], "it spoke before it had listened"
    assert clock.now() >= 0.5


def test_a_missing_interface_is_reported_at_start_and_retried() -> None:
    with Interface(BusConfig(interface="socketcan", channel="nosuchcan7"), MonotonicClock()) as gone:
        with pytest.raises(BusError, match="nosuchcan7"):
            gone.open()
        assert gone.reopen() is None


def test_the_interface_is_reopened_and_the_old_one_closed() -> None:
    settings = BusConfig(interface="virtual", channel=str(uuid4()))
    with Interface(settings, MonotonicClock()) as there:
        first = there.open()
        again = there.reopen()
        assert again is not None
        assert again.bus is not first.bus
        again.send(0x080, b"")
        with pytest.raises(BusError):
            first.send(0x080, b"")


def test_an_interface_that_is_down_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    class Down(Link):
        def recv(self, deadline_s: float) -> None:
            raise BusError(f"Network is down ({errno.ENETDOWN})")

    settings = BusConfig(interface="virtual", channel=str(uuid4()))
    with Interface(settings, MonotonicClock()) as there:
        there.open()
        monkeypatch.setattr(process, "Link", Down)
        assert there.reopen() is None
        monkeypatch.undo()
        assert there.reopen() is not None
