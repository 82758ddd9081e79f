"""The program's end of a simulated bus in this process: a python-can interface called ``hdbridge``.

A program opens this interface like any other, by interface name and channel. It fails in the same way as
SocketCAN: an interface that goes down raises ENETDOWN once in ``recv`` and on each ``send``; a deleted
interface must be opened again.
"""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from enum import Enum
from queue import Empty
from typing import Any, Final

import can
from can.interfaces.virtual import VirtualBus

from hdbridge.sim.lockstep import LockstepBus, VirtualClock

INTERFACE: Final = "hdbridge"
SLICE_S: Final = 0.01
"""Maximum delay before a waiting ``recv`` notices the loss of the interface; s."""

_PORTS: Final[dict[str, Port]] = {}


class Condition(Enum):
    """State of a CAN interface."""

    UP = "up"
    DOWN = "down"
    DELETED = "deleted"


_ERRORS: Final = {
    Condition.DOWN: ("Network is down", errno.ENETDOWN),
    Condition.DELETED: ("No such device or address", errno.ENXIO),
}


class StallingClock(VirtualClock):
    """Virtual clock on which the program can stall and wake up late."""

    stall_s = 0.0
    """Delay to be added to the next wait; s."""

    def step(self, deadline_s: float) -> bool:
        """Steps like `VirtualClock`; a requested stall is added to the elapsed time."""
        going_on = super().step(deadline_s)
        if self.stall_s > 0.0:
            until_s, self.stall_s = self.now() + self.stall_s, 0.0
            while super().step(until_s):
                pass
        return going_on


class Port:
    """Interface of the program: its channel and its condition."""

    def __init__(self, channel: str, clock: StallingClock | None, note: Callable[[str, str], None]) -> None:
        """``clock`` is the lockstep clock, None for real time. ``note`` receives the program's actions."""
        self.channel = channel
        self.clock = clock
        self.note = note
        self.condition = Condition.UP
        self.losses = 0
        """Number of losses of the interface."""
        self.deletions = 0
        self.refused_sends = 0
        """Number of further frames to be refused because the transmit queue is full."""
        self.open_buses: list[ProgramBus] = []

    def __enter__(self) -> Port:
        _PORTS[self.channel] = self
        return self

    def __exit__(self, *_: object) -> None:
        del _PORTS[self.channel]
        for each in list(self.open_buses):  # buses that the program left open
            each.shutdown()

    def fail(self, condition: Condition) -> Callable[[], None]:
        """Takes the interface down or deletes it; returns a function that restores it."""

        def comes_back() -> None:
            self.condition = Condition.UP

        self.condition = condition
        self.losses += 1
        self.deletions += condition is Condition.DELETED
        return comes_back


class ProgramBus(can.BusABC):
    """Bus opened by the program. If the program leaves it open, it is closed with the drive."""

    def __init__(self, channel: str, can_filters: Any = None, **_: Any) -> None:
        """Further options, such as a bit rate, concern hardware and are ignored."""
        port = _PORTS.get(channel)
        if port is None:
            raise can.CanInitializationError(
                f"{INTERFACE}:{channel}: no simulated drive has this channel; give the interface and the "
                "channel of the fixture hdbridge_drive, while its test runs"
            )
        if port.condition is not Condition.UP:
            raise can.CanInitializationError(*_ERRORS[port.condition])
        self._port = port
        self._losses = port.losses
        self._deletions = port.deletions
        self._inner: _LockstepEnd | _RealTimeEnd = (
            _RealTimeEnd(channel, self._check_receive)
            if port.clock is None
            else _LockstepEnd(channel, port.clock, self._check_receive)
        )
        self.channel_info = f"{INTERFACE}:{channel}"
        super().__init__(channel, can_filters)
        port.open_buses.append(self)
        port.note("bus", "the program opens its bus")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        port = self._port
        if port.deletions != self._deletions:
            raise can.CanOperationError(*_ERRORS[Condition.DELETED])
        if port.condition is not Condition.UP:
            raise can.CanOperationError(*_ERRORS[port.condition])
        if port.refused_sends > 0:
            port.refused_sends -= 1
            raise can.CanOperationError("Transmit buffer full", errno.ENOBUFS)
        self._inner.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self._inner.recv(timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def _apply_filters(self, filters: Any) -> None:
        self._inner.set_filters(filters)

    def shutdown(self) -> None:
        if self in self._port.open_buses:
            self._port.open_buses.remove(self)
            self._port.note("bus", "the program closes its bus")
            self._inner.shutdown()
        super().shutdown()

    def _check_receive(self) -> bool:
        """Returns True if frames can arrive; raises if the interface was lost since the last call."""
        port = self._port
        if port.losses != self._losses:
            self._losses = port.losses
            gone = Condition.DELETED if port.deletions != self._deletions else Condition.DOWN
            raise can.CanOperationError(*_ERRORS[gone])
        return port.condition is Condition.UP and port.deletions == self._deletions


class _LockstepEnd(LockstepBus):
    """`LockstepBus` with an interface that can be lost; for one thread."""

    def __init__(self, channel: str, clock: VirtualClock, check: Callable[[], bool]) -> None:
        super().__init__(channel, clock)
        self._check = check
        self._thread = threading.get_ident()
        self._shared = False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check_thread()
        super().send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._check_thread()
        return super().recv(timeout)

    def _take(self) -> can.Message | None:
        ready = self._check()
        message = super()._take()
        return message if ready else None

    def _check_thread(self) -> None:
        # Reported to every thread from then on, because an exception in a can.Notifier's thread is easily
        # overlooked.
        self._shared |= threading.get_ident() != self._thread
        if self._shared:
            raise can.CanOperationError(
                "a lockstep is for a program of one thread, and a second one uses this bus (a can.Notifier, "
                "the package canopen); choose the bus 'virtual', which runs in real time"
            )


class _RealTimeEnd(VirtualBus):
    """python-can's virtual bus with an interface that can be lost."""

    def __init__(self, channel: str, check: Callable[[], bool]) -> None:
        super().__init__(channel)
        self._check = check

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._check_if_open()
        until_s = None if timeout is None else time.monotonic() + timeout
        while True:
            ready = self._check()
            left_s = SLICE_S if until_s is None else min(until_s - time.monotonic(), SLICE_S)
            try:
                message = self.queue.get(block=left_s > 0.0, timeout=max(left_s, 0.0))
            except Empty:
                if left_s <= 0.0:
                    return None, False
            else:
                if ready:
                    return message, False
