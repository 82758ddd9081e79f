"""The CAN interface of the control process: opened at the start, and again whenever it has gone."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Final, Self

from hdbridge.axis import AxisConfig, BusConfig
from hdbridge.clock import Clock
from hdbridge.drive.link import Link, open_bus
from hdbridge.drive.manners import USUAL_MASTER, Ear, listening_s
from hdbridge.errors import BusError, HdbridgeError

_POLLS: Final = 256
"""Frames looked at to see whether an interface that could be opened works."""


class Interface:
    """Opens the bus of a machine file. The lock of the interface is the keeper's, who outlives this."""

    def __init__(self, settings: BusConfig, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self._stack = ExitStack()

    def open(self) -> Link:
        """A link on the newly opened bus; BusError where that is not possible."""
        self.close()
        bus = self._stack.enter_context(open_bus(self._settings, shared=True))
        return Link(bus, self._clock)

    def reopen(self) -> Link | None:
        """The same after a failure, where the interface works again; None where it does not.

        An interface that is down can be opened; the first look at it says that it is.
        """
        try:
            link = self.open()
            for _ in range(_POLLS):
                if link.recv(self._clock.now()) is None:
                    break
        except BusError:
            self.close()
            return None
        return link

    def close(self) -> None:
        """Leave the bus."""
        with suppress(HdbridgeError):
            self._stack.close()

    def __enter__(self) -> Self:
        """Itself; nothing is opened yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """`close`."""
        self.close()


def listen(link: Link, axes: tuple[AxisConfig, ...]) -> None:
    """Hear whether somebody else masters the bus, before the first SYNC; `BusInUseError` then."""
    if link.private:
        return
    masters = {axis.drive.master_node_id for axis in axes} | {USUAL_MASTER}
    drives = {axis.drive.node_id for axis in axes}
    encoders = {node for axis in axes if (node := axis.load_encoder.source.node) is not None}
    duration_s = listening_s(max(axis.drive.heartbeat_ms for axis in axes))
    ear = Ear(drives, masters, drives | encoders)
    ear.listen(link, duration_s)
    ear.refuse(link.name, duration_s)
