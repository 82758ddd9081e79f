"""Simulated CAN interfaces that can fail."""

import errno
import os
from collections.abc import Callable

import can
from can.interfaces.virtual import VirtualBus

from hdbridge.sim.lockstep import LockstepBus, VirtualClock


class Spoilt(can.BusABC):
    """Interface that can fail, with a spy on the frames that it sends."""

    down: int | None = None
    """Error number of every call while the interface is down (ENETDOWN) or deleted (ENODEV); else None."""
    no_room_for: int | None = None
    """Identifier of a frame for which the transmit queue is full once."""
    full = False
    """True while the transmit queue is full."""
    bus_off_at: int | None = None
    """Identifier of a frame whose transmission makes the controller go bus-off."""
    unsent: list[can.Message] | None = None
    """Frames in the transmit queue while the controller is bus-off; else None."""
    spy: Callable[[int, bytes], None] | None = None
    _reports_bus_off = False

    def recover(self) -> None:
        """Ends bus-off; the queued frames are sent."""
        unsent, self.unsent = self.unsent or [], None
        for each in unsent:
            self.send(each)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check()
        if self.full or msg.arbitration_id == self.no_room_for:
            self.no_room_for = None
            raise can.CanOperationError("Transmit buffer full", errno.ENOBUFS)
        if self.spy is not None:
            self.spy(msg.arbitration_id, bytes(msg.data))
        if self.unsent is not None:
            self.unsent.append(msg)
            return
        if msg.arbitration_id == self.bus_off_at:
            self.bus_off_at, self.unsent = None, []
            self._reports_bus_off = True
            return
        super().send(msg, timeout)  # type: ignore[safe-super]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._check()
        if self._reports_bus_off:
            self._reports_bus_off = False
            return can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False)
        message = super().recv(timeout)
        return message if self.unsent is None else None

    def _check(self) -> None:
        if self.down is not None:
            raise can.CanOperationError(os.strerror(self.down), self.down)


class SpoiltVirtualBus(Spoilt, VirtualBus):
    """Interface of a virtual bus that can fail."""


class SpoiltBus(Spoilt, LockstepBus):
    """Master's interface of a simulated bus, which can fail."""

    def __init__(self, channel: str, clock: VirtualClock) -> None:
        super().__init__(channel, clock)
        self.clock = clock
