"""The interface of the control process: listening before use, and reopening after a failure."""

import errno
from contextlib import nullcontext
from uuid import uuid4

import can
import pytest
from support.chatter import Chatter
from support.daemon import article_axes

from hdbridge.axis import BusConfig
from hdbridge.clock import MonotonicClock
from hdbridge.daemon.loop import process
from hdbridge.daemon.loop.process import Interface
from hdbridge.drive.link import Link
from hdbridge.drive.masterdetection import refuse_other_masters
from hdbridge.errors import BusError, BusInUseError
from hdbridge.sim.lockstep import LockstepBus, VirtualClock


@pytest.mark.parametrize(
    ("can_id", "words"),
    [(0x77F, "heartbeats of master 127"), (0x202, "set-points of node 2"), (0x203, None)],
)
def test_a_bus_with_another_master_is_left_alone(can_id: int, words: str | None) -> None:
    """`drive.test_master_detection` has the frames by which a master is recognised."""
    clock, channel = VirtualClock(), str(uuid4())
    with (
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as other,
        LockstepBus(channel, clock) as bus,
        pytest.raises(BusInUseError, match=words) if words else nullcontext(),
    ):
        clock.nodes.append(Chatter(other, (can_id, bytes(6))))
        refuse_other_masters(Link(bus, clock), article_axes(2))
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
