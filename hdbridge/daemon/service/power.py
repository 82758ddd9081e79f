"""Power of one axis: what has to precede it, what follows it, and what leads back after a stop.

The drive is booted and verified by SDO before the control process sends it anything; it is made ready by SDO
before each time that power is switched on; it is verified again after it restarted or the bus was down. The
axis is never enabled by itself.
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
"""By then the drive has power or was refused it; or it was braked and is without."""
FAULT_RESET_S: Final = 2.0
UNKNOWN: Final = frozenset({AxisState.UNVERIFIED, AxisState.LATCHED})
"""States in which the drive has to be verified before anything else."""


class AxisPower:
    """One axis. Its coroutines do not go together: the caller has one run at a time."""

    def __init__(
        self, link: AxisLink, commissioning: Commissioning, check_drive: Callable[[Identity], None]
    ) -> None:
        """``check_drive`` raises InputError where the model that compensates is of another drive."""
        self._link = link
        self._drive = commissioning
        self._check_drive = check_drive
        self._work = link.core.timing.work

    async def enable(self) -> None:
        """Power on, standing still. Raises what refuses it; nothing has moved then."""
        link = self._link
        if link.state is AxisState.ENABLED:
            return
        if link.state is AxisState.UNVERIFIED:
            await self.verify()
        self._check_drive(self._drive.identity)
        if link.state is not AxisState.DISABLED:
            await link.do(CommandKind.ENABLE)  # refused, with the reason
        seeds = await self._work(self._drive.prepare)
        try:
            await link.do(CommandKind.ENABLE, POWER_S, **seeds.arguments())
        except HdbridgeError:
            await self._rest()
            raise

    async def disable(self) -> None:
        """Brake to rest, then power off."""
        await self._link.do(CommandKind.DISABLE, POWER_S)
        await self._rest()

    async def _rest(self) -> None:
        """Where power is off the drive need no longer watch the master."""
        if self._link.state is AxisState.DISABLED and self._link.power is not State.FAULT:
            with suppress(HdbridgeError):  # it is asked for again each time that power is switched on
                await self._work(self._drive.rest)

    async def reset(self) -> None:
        """Release what is latched; disabled then."""
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
        """Boot the drive, compare it with its axis file, and let the control process speak to it."""
        seeds = await self._work(self._drive.verify)
        if clear_fault:
            await self._work(self._drive.clear_fault)
            seeds = await self._work(self._drive.seeds)
        if self._link.state is AxisState.LATCHED:
            await self._link.do(CommandKind.RESET, i=1)
        await self._link.do(CommandKind.VERIFIED, **seeds.arguments())

    async def take_over(self) -> None:
        """A service begins: take the axis as it is. What was lent to the one before is stopped."""
        link = self._link
        await link.until(lambda: link.core.observer.newest is not None, ANSWER_S)
        if link.state is AxisState.LENT:
            await self._work(self._drive.abandon_homing)
            await link.do(CommandKind.RELEASE)
        if link.state not in UNKNOWN:
            await self._work(self._drive.take_over)

    async def home(self, run: HomingRun) -> float:
        """Home by the drive's own method, disabled before and after; the load angle where it then stands."""
        link = self._link
        await link.do(CommandKind.LEND)
        try:
            positions, seeds = await self._work(self._drive.home, run)
        except BaseException:
            # Where it stands may not be known any more: it has to be verified anew.
            with suppress(HdbridgeError):
                await link.do(CommandKind.RELEASE)
            raise
        await link.do(CommandKind.UNLEND, **seeds.arguments())
        return positions.load_deg

    def interrupt(self, reason: str) -> None:
        """End what is asked of the drive by SDO; homing stops by that."""
        self._drive.interrupt(reason)
