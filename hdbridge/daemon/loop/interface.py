"""The control process's CAN interface: opened at the start and reopened after each failure."""

from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Final, Self

from hdbridge.axis import AxisConfig, BusConfig
from hdbridge.clock import Clock
from hdbridge.drive.link import Link, open_bus
from hdbridge.drive.manners import USUAL_MASTER, Ear, listening_s
from hdbridge.errors import BusError, HdbridgeError

_POLLS: Final = 256
"""Frames read to test whether an opened interface works."""


class Interface:
    """Opens the bus of a machine file. The interface's lock is held by the keeper, which outlives this."""

    def __init__(self, settings: BusConfig, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self._stack = ExitStack()

    def open(self) -> Link:
        """Opens the bus and returns a link; raises BusError if that fails."""
        self.close()
        bus = self._stack.enter_context(open_bus(self._settings, shared=True))
        return Link(bus, self._clock)

    def reopen(self) -> Link | None:
        """Reopens the bus after a failure; returns a link, or None if the interface does not work yet.

        An interface that is down can be opened; only the first read fails.
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
        """Closes the bus."""
        with suppress(HdbridgeError):
            self._stack.close()

    def __enter__(self) -> Self:
        """Returns itself; opens nothing yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Calls `close`."""
        self.close()


def listen(link: Link, axes: tuple[AxisConfig, ...]) -> None:
    """Listens for another master before the first SYNC; raises BusInUseError if there is one."""
    if link.private:
        return
    masters = {axis.drive.master_node_id for axis in axes} | {USUAL_MASTER}
    drives = {axis.drive.node_id for axis in axes}
    encoders = {node for axis in axes if (node := axis.load_encoder.source.node) is not None}
    duration_s = listening_s(max(axis.drive.heartbeat_ms for axis in axes))
    ear = Ear(drives, masters, drives | encoders)
    ear.listen(link, duration_s)
    ear.refuse(link.name, duration_s)
