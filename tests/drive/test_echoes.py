"""Back ends that give a master its own frames back: the echo is dropped, a second master is not."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import can
import pytest

from hdbridge.axis import BusConfig
from hdbridge.clock import MonotonicClock
from hdbridge.drive import Link, open_bus
from hdbridge.drive.fastlink import fast_link

GROUP = "239.74.163.77"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def multicast() -> BusConfig:
    """A multicast channel of this test's own; skips the test if the machine has no multicast."""
    config = BusConfig(interface="udp_multicast", channel=GROUP, options={"port": free_port()})
    try:
        with open_bus(config, shared=True) as near, open_bus(config, shared=True) as far:
            near.send(can.Message(arbitration_id=1, is_extended_id=False))
            arrived = far.recv(1.0) is not None
    except Exception as error:
        pytest.skip(f"no multicast on this machine: {error}")
    if not arrived:
        pytest.skip("no multicast on this machine: a frame did not arrive")
    return config


@pytest.fixture
def links(multicast: BusConfig) -> Iterator[tuple[Link, Link]]:
    """Two masters on the channel."""
    with ExitStack() as stack:
        one, two = (stack.enter_context(open_bus(multicast, shared=True)) for _ in range(2))
        yield Link(one, MonotonicClock()), Link(two, MonotonicClock())


def heard(link: Link, wait_s: float = 1.0) -> tuple[int, bytes] | None:
    frame = link.recv(link.now() + wait_s)
    return None if frame is None else (frame.can_id, frame.data)


def test_own_frames_are_not_received(links: tuple[Link, Link]) -> None:
    near, far = links
    near.send(0x080, b"")
    fast_link(near).send(0x201, b"\x0f\x00")
    assert [heard(far), heard(far)] == [(0x080, b""), (0x201, b"\x0f\x00")]
    assert near.drain() == []
    assert fast_link(near).drain() == []


def test_the_same_frame_from_another_master_is_received(links: tuple[Link, Link]) -> None:
    near, far = links
    near.send(0x080, b"")
    far.send(0x080, b"")
    assert heard(near) == (0x080, b"")
    assert near.drain() == []
    assert heard(far) == (0x080, b"")


def test_unmarked_frames_are_received(links: tuple[Link, Link], multicast: BusConfig) -> None:
    near, _ = links
    with open_bus(multicast, shared=True) as node:
        node.send(can.Message(arbitration_id=0x181, data=b"\x01", is_extended_id=False))
        assert heard(near) == (0x181, b"\x01")


def test_a_bus_without_a_name_is_named_after_the_axis_file(links: tuple[Link, Link]) -> None:
    assert links[0].name == f"udp_multicast:{GROUP}"


def test_other_back_ends_send_unmarked_frames() -> None:
    with (
        can.Bus(interface="virtual", channel="unmarked", ignore_config=True) as near,
        can.Bus(interface="virtual", channel="unmarked", ignore_config=True) as far,
    ):
        Link(near, MonotonicClock()).send(0x080, b"")
        message = far.recv(1.0)
        assert message is not None
        assert message.channel in (None, "unmarked")
