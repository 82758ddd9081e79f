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
    spy: Callable[[int, bytes], None] | None = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check()
        if self.full or msg.arbitration_id == self.no_room_for:
            self.no_room_for = None
            raise can.CanOperationError("Transmit buffer full", errno.ENOBUFS)
        if self.spy is not None:
            self.spy(msg.arbitration_id, bytes(msg.data))
        super().send(msg, timeout)  # type: ignore[safe-super]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._check()
        return super().recv(timeout)

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
