"""Loan of the bus to another program of this computer, such as ``hdbridge calibrate --borrow``.

The control process brings its axes to rest, switches them off and ends; the keeper releases the interface and
takes it back when the borrower has released it, however the borrower ends. The axes come up disabled.
"""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING, Final

from hdbridge.daemon.memory import Cell, CommandKind
from hdbridge.daemon.service.timing import POLL_S
from hdbridge.drive.interfacelock import InterfaceLock, process_words
from hdbridge.errors import RefusedError

if TYPE_CHECKING:
    from hdbridge.axis import BusConfig
    from hdbridge.daemon.service.core import Core

SIGNAL_AGAIN_S: Final = 1.0
"""Minimum interval between stop signals to the borrower, which ends at once on the third."""
_STOPS: Final = frozenset({CommandKind.STOP, CommandKind.QUICK_STOP})


class Lending:
    """Lends the bus of a machine, and refuses commands to the axes meanwhile."""

    def __init__(self, core: Core, bus: BusConfig, reason_against: str) -> None:
        """``reason_against`` explains why the bus cannot be lent; empty if it can."""
        self._core, self._reason_against = core, reason_against
        self._status = core.memory.status
        self._lock = InterfaceLock(bus.interface, bus.channel)
        self._signalled_s = 0.0
        self._status[Cell.BUS_REQUESTED] = 0
        core.refuse = self.refuse

    @property
    def borrower(self) -> str | None:
        """Description of the program that has the bus; None if the bus is not lent."""
        if not self._status[Cell.BUS_LENT]:
            return None
        number = self._lock.holder
        return process_words(number) if number else "the program that asked for it"

    @property
    def lent_s(self) -> float | None:
        """Seconds since the bus was lent; None if not lent."""
        since_ns = self._status[Cell.BUS_LENT]
        return 1e-9 * (time.monotonic_ns() - since_ns) if since_ns else None

    async def lend(self) -> None:
        """Stops the axes; returns once the keeper has released the interface.

        The keeper ends a control process whose axes do not come to rest. Raises RefusedError if the bus
        cannot be lent.
        """
        self.refuse()
        if self._reason_against:
            raise RefusedError(f"the bus cannot be lent: {self._reason_against}")
        self._status[Cell.BUS_REQUESTED] = 1
        try:
            while not self._status[Cell.BUS_LENT]:
                await self._core.timing.sleep(POLL_S)
        finally:
            self._status[Cell.BUS_REQUESTED] = 0

    def refuse(self, kind: CommandKind | None = None) -> None:
        """Raises RefusedError while the bus is lent. A stop is passed on to the borrower as SIGTERM."""
        borrower = self.borrower
        if borrower is None:
            return
        what = "its axes are disabled for everybody else until it ends"
        if kind in _STOPS and (number := self._lock.holder):
            what = "it was asked to stop its axis and to end"
            try:
                if time.monotonic() - self._signalled_s > SIGNAL_AGAIN_S:
                    self._signalled_s = time.monotonic()
                    os.kill(number, signal.SIGTERM)
            except OSError as error:
                what = f"it could not be asked to stop ({error.strerror}): end it with 'kill {number}'"
        raise RefusedError(f"the bus is lent to {borrower}; {what}")
