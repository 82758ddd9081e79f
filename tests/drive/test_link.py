"""The link: dropped frames, errors, bounded waits."""

import errno
import sys
import time
from collections import deque
from copy import deepcopy

import can
import pytest

from hdbridge.axis import BusConfig
from hdbridge.canframe import DataFrame
from hdbridge.clock import MonotonicClock
from hdbridge.drive import Link, TransmitBufferFull, open_bus
from hdbridge.errors import BusError, InputError


def message(can_id: int = 0x181, data: bytes = b"\x01", **flags: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **flags})


class FakeBus(can.BusABC):
    """Returns queued messages, or raises queued errors."""

    def __init__(self, *inbox: can.Message | Exception | None, on_send: Exception | None = None) -> None:
        super().__init__(channel="x")
        self.channel_info = "socketcan channel 'can0'"
        self.inbox = deque(inbox)
        self.on_send = on_send

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.on_send is not None:
            raise self.on_send

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        item = self.inbox.popleft() if self.inbox else None
        if isinstance(item, Exception):
            raise item
        return item, False


@pytest.fixture
def closing() -> deque[can.BusABC]:
    buses: deque[can.BusABC] = deque()
    yield buses  # type: ignore[misc]
    for bus in buses:
        bus.shutdown()


def link_to(closing: deque[can.BusABC], bus: FakeBus) -> Link:
    closing.append(bus)
    return Link(bus, MonotonicClock())


def test_frames_unused_by_canopen_are_dropped_and_counted(closing: deque[can.BusABC]) -> None:
    link = link_to(
        closing,
        FakeBus(
            message(is_remote_frame=True),
            message(0x181, is_extended_id=True),
            message(is_error_frame=True),
            message(is_fd=True),
            message(0x181, b"good"),
            message(0x182, b"too"),
        ),
    )
    assert [frame.data for frame in link.drain()] == [b"good", b"too"]
    dropped = link.dropped
    assert (dropped.remote, dropped.extended, dropped.error, dropped.fd, dropped.total) == (1, 1, 1, 1, 4)


@pytest.mark.parametrize("code", [errno.ENETDOWN, errno.ENODEV])
def test_an_interface_that_went_down_stays_down(closing: deque[can.BusABC], code: int) -> None:
    gone = can.CanOperationError("Failed to receive: down", code)
    link = link_to(closing, FakeBus(gone, None, message()))
    with pytest.raises(BusError, match=r"can0.*cannot receive"):
        link.recv(0.0)
    # SocketCAN reports it once and is silent from then on.
    for call in (lambda: link.recv(0.0), lambda: link.send(1, b"")):
        with pytest.raises(BusError, match="can0"):
            call()
    assert link.down is not None


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"),
        OSError(errno.ENOBUFS, "No buffer space available"),
    ],
)
def test_a_full_transmit_queue_is_a_temporary_error(closing: deque[can.BusABC], error: Exception) -> None:
    bus = FakeBus(on_send=error)
    link = link_to(closing, bus)
    with pytest.raises(TransmitBufferFull, match="dropped"):
        link.send(0x201, b"")
    bus.on_send = None
    link.send(0x201, b"")
    assert link.down is None


def test_bus_off_is_the_end_of_the_link(closing: deque[can.BusABC]) -> None:
    link = link_to(closing, FakeBus(message(0x40, is_error_frame=True), message()))
    with pytest.raises(BusError, match="bus-off"):
        link.recv(0.0)
    with pytest.raises(BusError, match="bus-off"):
        link.send(1, b"")


def test_setting_back_the_wall_clock_does_not_extend_a_wait(closing, monkeypatch):
    walls = iter(range(10_000, 0, -100))
    monkeypatch.setattr("can.bus.time", lambda: float(next(walls)))
    link = link_to(closing, FakeBus())
    assert link.recv(time.monotonic() + 0.001) is None


def test_a_link_to_a_closed_bus_reports_it() -> None:
    bus = can.Bus(interface="virtual", channel="closed", ignore_config=True)
    link = Link(bus, MonotonicClock())
    bus.shutdown()
    with pytest.raises(BusError, match="closed"):
        link.send(1, b"")
    assert link.down is not None


def test_opening_an_unknown_interface() -> None:
    with (
        pytest.raises(InputError, match=r"no interface 'nonsense'.*socketcan") as caught,
        open_bus(BusConfig(interface="nonsense", channel="x")),
    ):
        pass
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("interface", "module", "package"),
    [("udp_multicast", "msgpack", "msgpack"), ("slcan", "serial", "pyserial")],
)
def test_a_missing_package_is_reported_with_its_install_command(monkeypatch, interface, module, package):
    def refuse(**options: object) -> None:
        raise can.CanInterfaceNotImplementedError(f"{module} not installed")

    monkeypatch.setattr("can.Bus", refuse)
    monkeypatch.setitem(sys.modules, module, None)
    with (
        pytest.raises(BusError, match=f"needs the package {package} for it: python -m pip install {package}"),
        open_bus(BusConfig(interface=interface, channel="239.0.0.9"), shared=True),
    ):
        pass


def test_an_opened_bus_is_closed_again() -> None:
    with open_bus(
        BusConfig(interface="virtual", channel="open", options={"receive_own_messages": True})
    ) as bus:
        bus.send(message())
        assert bus.recv(0) is not None
    with pytest.raises(can.CanOperationError):
        bus.send(message())


def test_options_passed_to_the_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    passed: dict[str, object] = {}

    def bus(**options: object) -> FakeBus:
        passed.update(options)
        return FakeBus()

    monkeypatch.setattr("can.Bus", bus)
    with open_bus(BusConfig(interface="socketcan", channel="can0", bitrate_bps=500_000), shared=True):
        pass
    assert passed == {
        "interface": "socketcan",
        "channel": "can0",
        "ignore_config": True,
        "bitrate": 500_000,
        "can_filters": [{"can_id": 0, "can_mask": 0, "extended": False}],
    }


def test_the_messages_of_the_cycle_are_those_of_python_can() -> None:
    plain = can.Message(arbitration_id=0x201, is_extended_id=False, data=b"\x0f\x00\x01", channel="x")
    for message in (made := DataFrame(0x201, b"\x0f\x00\x01", "x"), copy := deepcopy(made)):
        for name in can.Message.__slots__:
            if name != "__weakref__":
                assert getattr(message, name) == getattr(plain, name), name
    assert copy.data is not made.data
