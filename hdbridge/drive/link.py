"""Raw CAN frames in and out: the only module of the master that uses python-can.

It runs in the control cycle, so it adds little time to the back end's own call. Every interface failure
becomes a `BusError` that names the interface. Frames that CANopen does not use are dropped and counted. Every
deadline refers to the monotonic clock that was passed in.
"""

import errno
import logging
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

import can

from hdbridge.axis.config import BusConfig
from hdbridge.canframe import DataFrame
from hdbridge.clock import Clock
from hdbridge.drive.interfacelock import InterfaceLock
from hdbridge.errors import BusError, InputError
from hdbridge.files.expectation import nearest

_log = logging.getLogger(__name__)
_GONE: Final = frozenset(
    {errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.ENETUNREACH, errno.EBADF, errno.EIO}
)
_DRAIN_AT_MOST: Final = 4096
_ECHOING: Final = frozenset({"UdpMulticastBus"})
"""python-can back ends that always echo a bus's own frames."""
_PACKAGES: Final = {
    "udp_multicast": ("msgpack", "msgpack"),
    **dict.fromkeys(("slcan", "serial", "robotell", "seeedstudio"), ("serial", "pyserial")),
}
"""Optional dependency (module, package) of each python-can interface that requires one."""
_NETWORK: Final = Path("/sys/class/net")
_ARPHRD_CAN: Final = 280
"""ARPHRD_CAN of linux/if_arp.h, the type of a CAN interface."""
_PROCESS: Final = uuid.uuid4().hex[:12]
_ERROR_FRAME_BUS_OFF: Final = 0x40
"""CAN_ERR_BUSOFF of linux/can/error.h, in the identifier of a SocketCAN error frame."""


class TransmitBufferFull(BusError):  # noqa: N818 - the name says what happened
    """The kernel's transmit queue is full (ENOBUFS). The frame was dropped and must not be sent later."""


class Frame(NamedTuple):
    """A received data frame with an 11-bit identifier."""

    can_id: int
    data: bytes
    time_s: float
    """Time of reception on the link's clock; s."""


new_tuple: Final = tuple.__new__
"""Builds a named tuple from its values in half the time of the tuple's own constructor."""


@dataclass(slots=True)
class Dropped:
    """Counts of received frames that were discarded, by kind."""

    remote: int = 0
    extended: int = 0
    error: int = 0
    fd: int = 0

    @property
    def total(self) -> int:
        """Number of discarded frames of all kinds."""
        return self.remote + self.extended + self.error + self.fd


class Link:
    """CAN bus as seen by the master.

    Once the interface is lost (ENETDOWN, ENODEV, bus-off), every call raises the same `BusError`. A SocketCAN
    socket reports the loss only *once* and then stays silent, which would look like a quiet bus. To continue,
    open the bus again and create a new link.
    """

    def __init__(self, bus: can.BusABC, clock: Clock) -> None:
        self.bus = bus
        self.clock = clock
        self.now = clock.now
        self.name = str(getattr(bus, "channel_info", "") or type(bus).__name__)
        self.dropped = Dropped()
        self.private: bool = getattr(bus, "private", False)
        """True if the bus declares that only the drive and this link can be on it."""
        self.down: str | None = None
        """Reason for the permanent loss of the interface, or None."""
        self.mark = _mark(bus)
        """Channel name of own frames on a back end that echoes them, else None."""
        self._send = bus.send
        # BusABC.recv measures its remaining time on the *wall* clock: if that clock is set back during a
        # wait, recv blocks longer by the same amount. The hook below has no such loop, so it is used for
        # back ends that rely on BusABC.recv.
        own_recv = getattr(type(bus), "recv", None) is not can.BusABC.recv
        self._raw_recv = None if own_recv else bus._recv_internal
        self._recv = bus.recv
        self._matches = bus._matches_filters

    def send(self, can_id: int, data: bytes) -> None:
        """Sends a data frame with an 11-bit identifier; returns when the interface has accepted it.

        Raises `TransmitBufferFull` if the frame was dropped because the queue is full, `BusError` if the
        interface failed.
        """
        if self.down is not None:
            raise BusError(self.down)
        try:
            self._send(DataFrame(can_id, data, self.mark))
        except (can.CanError, OSError) as error:
            raise self._failure("send", error) from error

    def recv(self, deadline_s: float) -> Frame | None:
        """Returns the next data frame; None if none came by ``deadline_s`` (a past deadline polls once).

        Raises `BusError` if the interface failed.
        """
        if self.down is not None:
            raise BusError(self.down)
        raw = self._raw_recv
        now = self.now
        while True:
            timeout_s = deadline_s - now()
            if timeout_s < 0.0:  # noqa: PLR1730 - max() costs three times as much, in every cycle
                timeout_s = 0.0
            try:
                if raw is None:
                    message = self._recv(timeout_s)
                else:
                    message, filtered = raw(timeout_s)
                    if message is not None and not filtered and not self._matches(message):
                        continue
            except (can.CanError, OSError) as error:
                raise self._failure("receive", error) from error
            if message is None:
                if timeout_s == 0.0 or now() >= deadline_s:
                    return None
                continue
            if self.mark is not None and message.channel == self.mark:
                continue
            if type(message) is not DataFrame and (
                message.is_extended_id or message.is_error_frame or message.is_remote_frame or message.is_fd
            ):
                self._drop(message)
                continue
            return new_tuple(Frame, (message.arbitration_id, bytes(message.data), now()))

    def drain(self) -> list[Frame]:
        """Returns the frames that have arrived, without waiting; at most 4096, so that it always ends."""
        frames: list[Frame] = []
        now_s = self.now()
        while len(frames) < _DRAIN_AT_MOST and (frame := self.recv(now_s)) is not None:
            frames.append(frame)
        return frames

    def _drop(self, message: can.Message) -> None:
        if message.is_error_frame:
            self.dropped.error += 1
            if self.name.startswith("socketcan") and message.arbitration_id & _ERROR_FRAME_BUS_OFF:
                # This frame is the only sign of bus-off, because sends still "succeed" and nothing arrives.
                self.down = (
                    f"{self.name}: the CAN controller went bus-off; check wiring, bit rate and termination"
                )
                raise BusError(self.down)
        elif message.is_remote_frame:
            self.dropped.remote += 1
        elif message.is_extended_id:
            self.dropped.extended += 1
        else:
            self.dropped.fd += 1

    def _failure(self, doing: str, error: Exception) -> BusError:
        code = _errno(error)
        text = str(error) or type(error).__name__
        if code == errno.ENOBUFS or "buffer full" in text.lower():
            return TransmitBufferFull(
                f"{self.name}: the transmit queue is full, the frame was dropped; "
                "check that another node acknowledges and that the bus is not overloaded"
            )
        message = f"{self.name}: cannot {doing}: {text}; check that the interface is up"
        if code in _GONE or "closed bus" in text.lower():
            self.down = message
        return BusError(message)


def _mark(bus: can.BusABC) -> str | None:
    """Returns the channel name that marks this bus's own frames on a back end that echoes them, else None.

    Such a back end transports the channel with the frame, so echoes are identified reliably: an identical
    frame from another master has a different mark, or none. All links of a bus share one mark.
    """
    if type(bus).__name__ not in _ECHOING:
        return None
    return f"{_PROCESS}-{os.getpid():x}-{id(bus):x}"


def _errno(error: BaseException | None) -> int | None:
    """Returns the operating system's error number from wherever python-can stored it, or None."""
    while error is not None:
        code = getattr(error, "error_code", None) or getattr(error, "errno", None)
        if isinstance(code, int):
            return code
        error = error.__cause__
    return None


def check_interface(interface: str, where: str) -> None:
    """Raises `InputError` for an unknown interface; ``where`` is the key or option that names it."""
    if unknown := unknown_interface(interface):
        raise InputError(f"{where}: {unknown}")


def unknown_interface(interface: str) -> str | None:
    """Returns an error text if python-can has no such interface, else None."""
    if interface in can.VALID_INTERFACES:
        return None
    known = sorted(can.VALID_INTERFACES)
    close = nearest(interface, known)
    hint = f"; did you mean '{close}'?" if close else ""
    return f"python-can has no interface {interface!r}; expected one of {', '.join(known)}{hint}"


def absent_interface(settings: BusConfig) -> str | None:
    """Returns an error text if this computer lacks the network interface of SocketCAN, else None."""
    channel = str(settings.channel)
    if settings.interface != "socketcan" or (_NETWORK / channel).exists():
        return None
    types = ((each.name, each / "type") for each in sorted(_NETWORK.glob("*")))
    there = [name for name, kind in types if kind.exists() and int(kind.read_text()) == _ARPHRD_CAN]
    close = nearest(channel, there)
    hint = f"; did you mean '{close}'?" if close else f"; its CAN interfaces: {', '.join(there) or 'none'}"
    return f"this computer has no network interface {channel!r}{hint}"


@contextmanager
def open_bus(settings: BusConfig, *, shared: bool = False) -> Iterator[can.BusABC]:
    """Opens the bus of an axis file; raises a one-line `BusError` on failure.

    Only one process of a computer may open an interface. The next is refused with `BusInUseError`, because
    two masters on one bus stop each other's axes. ``shared`` skips this check, for programs that are not a
    master and for an explicit override. python-can's configuration files in the home folder are ignored.
    """
    lock = nullcontext() if shared else InterfaceLock(settings.interface, settings.channel)
    with lock, _opened(settings) as bus:
        yield bus


@contextmanager
def _opened(settings: BusConfig) -> Iterator[can.BusABC]:
    name = f"{settings.interface}:{settings.channel}"
    check_interface(settings.interface, f"{name}: bus.interface")
    options: dict[str, Any] = dict(settings.options)
    if settings.bitrate_bps is not None:
        options["bitrate"] = settings.bitrate_bps
    if settings.interface == "socketcan":
        # CANopen uses only 11-bit identifiers: the kernel drops the others before they wake the process.
        options["can_filters"] = [{"can_id": 0, "can_mask": 0, "extended": False}]
    try:
        bus = can.Bus(interface=settings.interface, channel=settings.channel, ignore_config=True, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as error:
        module, package = _PACKAGES.get(settings.interface, ("", ""))
        if module and find_spec(module) is None:
            what = f"python-can needs the package {package} for it: python -m pip install {package}"
        else:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            what = f"cannot open it: {reason}; "
            what += absent_interface(settings) or "check bus.channel and that the interface is up"
        raise BusError(f"{name}: {what}") from error
    if bus.channel_info == "unknown":  # python-can's placeholder; messages need a name
        bus.channel_info = name
    _log.info("bus opened", {"bus": name})
    try:
        yield bus
    finally:
        _log.info("bus closed", {"bus": name})
        # A device that has been unplugged may fail to close. Nothing is lost then.
        with suppress(can.CanError, OSError):
            bus.shutdown()
