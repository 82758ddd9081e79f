"""Power of one axis: verification, preparation, enabling, disabling and reset.

The drive is booted and verified by SDO before the control process sends it anything. It is prepared by SDO
each time before power is switched on, and verified again after it restarted or the bus was down. An axis is
never enabled automatically.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind
from hdbridge.daemon.service.axislink import AxisLink
from hdbridge.daemon.service.commissioning import Commissioning, HomingRun
from hdbridge.daemon.service.dispatch import ANSWER_S
from hdbridge.drive.states import State
from hdbridge.errors import DriveError, HdbridgeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from hdbridge.axis import Identity

POWER_S: Final = 20.0
"""Time-out for ENABLE and DISABLE, braking included."""
FAULT_RESET_S: Final = 2.0
UNKNOWN: Final = frozenset({AxisState.UNVERIFIED, AxisState.LATCHED})
"""States in which the drive must be verified before any other request."""


class AxisPower:
    """Power of one axis. The caller runs one coroutine at a time."""

    def __init__(
        self, link: AxisLink, commissioning: Commissioning, check_drive: Callable[[Identity], None]
    ) -> None:
        """``check_drive`` raises InputError if the compensating model belongs to another drive."""
        self._link = link
        self._drive = commissioning
        self._check_drive = check_drive
        self.is_prepared = False
        """True if all SDO work that precedes power is done, and no SDO transfer has followed."""
        self._work = link.core.timing.work

    async def enable(self) -> None:
        """Switches power on, at rest. Raises the reason for a refusal; nothing has moved then."""
        link = self._link
        if link.state is AxisState.ENABLED:
            return
        if link.state is AxisState.UNVERIFIED:
            await self.verify()
        self._check_drive(self._drive.identity)
        if link.state is not AxisState.DISABLED:
            await link.do(CommandKind.ENABLE)  # refused, with the reason
        if self.is_prepared:
            self.is_prepared = False
            seeds = link.seeds()
        else:
            seeds = (await self._work(self._drive.prepare)).arguments()
        try:
            await link.do(CommandKind.ENABLE, POWER_S, **seeds)
        except HdbridgeError:
            await self._rest()
            raise

    async def prepare(self) -> None:
        """Do what precedes power by SDO, so that the next `enable` needs none. Raises as `enable` does."""
        self._check_drive(self._drive.identity)
        await self._work(self._drive.prepare)
        self.is_prepared = True

    async def disable(self) -> None:
        """Brakes to rest, then switches power off."""
        await self._link.do(CommandKind.DISABLE, POWER_S)
        await self._rest()

    async def _rest(self) -> None:
        """Ends the drive's monitoring of the master if power is off."""
        self.is_prepared = False
        if self._link.state is AxisState.DISABLED and self._link.power is not State.FAULT:
            with suppress(HdbridgeError):  # monitoring is set up again each time power is switched on
                await self._work(self._drive.rest)

    async def reset(self) -> None:
        """Releases a latched stop and resets the drive's fault; the axis is disabled afterwards."""
        link = self._link
        if link.state in UNKNOWN:
            await self.verify(clear_fault=True)
        elif link.state is AxisState.QUICK_STOPPED:
            await link.do(CommandKind.RESET)
            await link.until(lambda: link.state not in {AxisState.STOPPING, AxisState.QUICK_STOPPED}, POWER_S)
        if link.state is AxisState.DISABLED and link.power is State.FAULT:
            await link.do(CommandKind.DRIVE_FAULT_RESET)
            if not await link.until(lambda: link.power is not State.FAULT, FAULT_RESET_S):
                raise DriveError(
                    f"{link.name}: the drive's fault stays after a reset; remove its cause (see 603Fh and "
                    f"the drive's manual), then reset it again: hdbridge ctl reset {link.name}"
                )
        await self._rest()

    async def verify(self, *, clear_fault: bool = False) -> None:
        """Boots and verifies the drive, then lets the control process communicate with it."""
        self.is_prepared = False
        seeds = await self._work(self._drive.verify)
        if clear_fault:
            await self._work(self._drive.clear_fault)
            seeds = await self._work(self._drive.seeds)
        if self._link.state is AxisState.LATCHED:
            await self._link.do(CommandKind.RESET, i=1)
        await self._link.do(CommandKind.VERIFIED, **seeds.arguments())

    async def take_over(self) -> None:
        """Takes over the axis as it is; stops a drive that was lent to an earlier service."""
        link = self._link
        await link.until(lambda: link.core.observer.newest is not None, ANSWER_S)
        if link.state is AxisState.LENT:
            await self._work(self._drive.abandon_homing)
            await link.do(CommandKind.RELEASE)
        if link.state not in UNKNOWN:
            await self._work(self._drive.take_over)

    async def home(self, run: HomingRun) -> float:
        """Homes by the drive's own method, disabled before and after; returns the load angle afterwards."""
        link = self._link
        self.is_prepared = False
        await link.do(CommandKind.LEND)
        try:
            positions, seeds = await self._work(self._drive.home, run)
        except BaseException:
            # The position may be lost, so the drive must be verified again.
            with suppress(HdbridgeError):
                await link.do(CommandKind.RELEASE)
            raise
        await link.do(CommandKind.UNLEND, **seeds.arguments())
        return positions.load_deg

    def interrupt(self, reason: str) -> None:
        """Interrupts the present SDO request; a homing axis stops."""
        self._drive.interrupt(reason)
