"""One axis as seen by clients: power, motion, compensation and objects of the drive.

The drive is booted and verified by SDO before the control process sends it anything. It is prepared by SDO
each time before power is switched on, and verified again after a restart or a bus failure. An axis is never
enabled automatically.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Literal

from hdbridge.client import messages
from hdbridge.daemon.loop.states import MAY_MOVE, STOPPED, UNKNOWN, AxisState
from hdbridge.daemon.memory import CommandKind, EventKind, SampleFlag
from hdbridge.daemon.service import reports
from hdbridge.daemon.service.axislink import AxisLink
from hdbridge.daemon.service.commissioning import Commissioning
from hdbridge.daemon.service.core import ANSWER_S
from hdbridge.daemon.service.models import AxisModels
from hdbridge.daemon.service.moves import AxisMotion
from hdbridge.drive.states import State
from hdbridge.drive.values import Object, Value
from hdbridge.enums import Scheme
from hdbridge.errors import DriveError, HdbridgeError, InputError, RefusedError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Axis
    from hdbridge.daemon.memory import Event
    from hdbridge.daemon.service.core import Core
    from hdbridge.daemon.service.following import Following
    from hdbridge.daemon.setting import CompensationSetting

CHANGE_S: Final = 120.0
"""Time-out for fading in another compensation, long enough for a slow ramp."""
POWER_S: Final = 20.0
"""Time-out for ENABLE and DISABLE, including braking."""
FAULT_RESET_S: Final = 2.0


class ServiceAxis:
    """One axis of the machine. Methods that change it require the lease; stopping and reading do not."""

    def __init__(
        self, index: int, axis: Axis, core: Core, outer: Callable[[], messages.OuterState | None]
    ) -> None:
        """``outer`` returns the state of the axis's node in a gateway."""
        self.axis = axis
        self.name = axis.name
        self.core = core
        self.link = AxisLink(core, index, axis.config)
        self.commissioning = Commissioning(axis.config, core)
        self.models = AxisModels(axis, core.memory.settings[index])
        self.is_prepared = False
        """True if `prepare` has done the SDO transfers before power-on, and nothing has invalidated them."""
        self.motion = AxisMotion(self.link, self.check_may)
        self.stopped: tuple[Event, datetime] | None = None
        """Last stop and its time of day, once the axis is at rest; None before."""
        self.loop_doubt = "the reason is in the log of an earlier service"
        """Reason why the load loop does not act, from its last event; a placeholder before the first
        event."""
        self.following: Following | None = None
        """Watch and adaptation; None without."""
        self._outer = outer
        self._work = core.timing.work
        self._changing = asyncio.Lock()
        self._doing = ""
        """Client request with exclusive use of the drive, in words; empty if no request has it."""
        self._drive = asyncio.Lock()
        """Held during exclusive use of the drive, also by the service's own work, for which clients wait."""

    # ---------------------------------------------------------------- checks

    def state(self) -> messages.AxisState:
        """Returns the state of the axis in the newest cycle."""
        return reports.axis_state(self, self._outer())

    def on_event(self, event: Event) -> None:
        """Takes an event of the axis."""
        self.link.on_event(event)
        if event.kind is EventKind.STOPPED:
            self.stopped = event, datetime.now(UTC)
        elif event.kind is EventKind.STATE and event.code in STOPPED:
            self.stopped = None  # the reason is reported once the axis is at rest
        elif event.kind is EventKind.LOAD_LOOP:
            self.loop_doubt = event.text

    def check_may(self, holder: str) -> None:
        """Raises LeaseError unless ``holder`` has the lease, RefusedError if a request uses the drive."""
        self.core.lease.check(holder)
        self.check_free()

    def check_free(self) -> None:
        """Raises RefusedError if another request has exclusive use of the drive."""
        if self._doing:
            raise RefusedError(
                f"{self.name}: {self._doing}; wait for its end, or end it with "
                f"'hdbridge ctl stop {self.name}'"
            )

    @asynccontextmanager
    async def _exclusive_use(self, doing: str) -> AsyncIterator[None]:
        """Reserves the drive for one request; a stop remains possible at any time."""
        self.check_free()
        holder = self.core.lease.holder
        self._doing = doing if holder is None else f"{doing} for '{holder.client}'"
        try:
            async with self._drive:
                yield
        finally:
            self._doing = ""

    # ---------------------------------------------------------------- power

    async def enable(self, holder: str, is_withdrawn: Callable[[], bool] = lambda: False) -> None:
        """Switches power on, at rest; first boots and verifies the drive if this was not done.

        Power stays off if the axis is stopped, the lease ends or ``is_withdrawn()`` becomes True meanwhile.
        """
        self.check_may(holder)
        request = self.link.request(holder)
        async with self._exclusive_use("the axis is being enabled"):
            self.motion.replace(None, "the axis was enabled again")
            await self.settle()
            link = self.link
            if link.state is AxisState.ENABLED:
                return
            if link.state is AxisState.UNVERIFIED:
                await self._verify()
            self.models.check_drive(self.commissioning.drive.identity)
            if link.state is not AxisState.DISABLED:
                await link.do(CommandKind.ENABLE)  # raises RefusedError with the reason
            if self.is_prepared:
                self.is_prepared = False
                seeds = link.seeds()
            else:
                seeds = await self._work(self.commissioning.prepare)
            try:
                request.check()
                if is_withdrawn():
                    raise RefusedError(f"{self.name}: the request for power was withdrawn")
                await link.do(CommandKind.ENABLE, POWER_S, **seeds)
            except HdbridgeError:
                await self._rest()
                raise

    async def prepare(self) -> None:
        """Prepares the drive, so that the next `enable` needs no SDO transfers. Raises like `enable`."""
        self.check_free()
        async with self._drive:
            if self.link.state is AxisState.DISABLED:
                self.models.check_drive(self.commissioning.drive.identity)
                await self._work(self.commissioning.prepare)
                self.is_prepared = True

    async def disable(self, holder: str) -> None:
        """Brakes to rest, then switches power off."""
        self.core.lease.check(holder)
        self.motion.replace(None, "the axis was disabled")
        async with self._exclusive_use("the axis is being disabled"):
            await self.link.do(CommandKind.DISABLE, POWER_S)
            await self._rest()

    def cancel_activity(self, why: str) -> None:
        """Withdraws all requests for power and motion; interrupts SDO requests, so a homing axis stops."""
        self.link.withdraw_requests(why)
        self.motion.replace(None, why)
        self.commissioning.interrupt(f"{self.name}: {why}")

    async def quick_stop(self) -> None:
        """Quick-stops the axis and latches the stop until `reset`. Requires no lease."""
        self.cancel_activity("it was stopped by a quick stop")
        await self.link.do(CommandKind.QUICK_STOP)

    async def stop(self) -> None:
        """Brakes to rest and stays enabled. Cancels queue and stream. Requires no lease."""
        self.cancel_activity("it was stopped by a client")
        await self.link.do(CommandKind.STOP)

    async def reset(self, holder: str) -> None:
        """Releases a latched stop, resets the drive's fault and verifies the drive if necessary.

        The axis is disabled afterwards.
        """
        self.check_may(holder)
        async with self._exclusive_use("the axis is being reset"):
            self.motion.replace(None, "the axis was reset")
            link = self.link
            if link.state in UNKNOWN:
                await self._verify(clear_fault=True)
            elif link.state is AxisState.QUICK_STOPPED:
                await link.do(CommandKind.RESET)
                stopping = {AxisState.STOPPING, AxisState.QUICK_STOPPED}
                await self.core.until(lambda: link.state not in stopping, POWER_S)
            if link.state is AxisState.DISABLED and link.power is State.FAULT:
                await link.do(CommandKind.DRIVE_FAULT_RESET)
                if not await self.core.until(lambda: link.power is not State.FAULT, FAULT_RESET_S):
                    raise DriveError(
                        f"{self.name}: the drive's fault persists after a reset; remove its cause (see 603Fh "
                        f"and the drive's manual), then reset it again: hdbridge ctl reset {self.name}"
                    )
            await self._rest()

    async def take_over(self) -> None:
        """Takes over the axis from an earlier service process; stops a drive that was lent to it."""
        link = self.link
        async with self._drive:
            await self.core.until(lambda: self.core.newest is not None, ANSWER_S)
            if link.state is AxisState.LENT:
                try:
                    await self._work(self.commissioning.abandon_homing)
                finally:
                    await link.do(CommandKind.RELEASE)  # the drive is then booted again, without power
            if link.state not in UNKNOWN:
                await self._work(self.commissioning.take_over)

    async def verify(self) -> None:
        """Boots and verifies the drive if it is not verified; the axis is disabled afterwards."""
        async with self._drive:
            if self.link.state not in UNKNOWN:
                return
            await self._verify()
        self.core.log.note("the drive was verified; the axis is disabled", self.link.index)

    async def home(self, holder: str, run: messages.Home) -> None:
        """Homes by a method of 6098h. The axis is disabled before and after."""
        self.check_may(holder)
        request = self.link.request(holder)
        async with self._exclusive_use("the axis is being homed"):
            self.is_prepared = False
            request.check()
            await self.link.do(CommandKind.HOME)
            try:
                seeds = await self._work(self.commissioning.home, run, request.check_not_stopped)
                await self.link.do(CommandKind.HOMED, **seeds)
            except BaseException:
                # The position may be lost, so the drive must be verified again.
                with suppress(HdbridgeError):
                    await self.link.do(CommandKind.RELEASE)
                raise

    async def _verify(self, *, clear_fault: bool = False) -> None:
        """Boots and verifies the drive, then lets the control process communicate with it."""
        self.is_prepared = False
        seeds = await self._work(self.commissioning.verify, clear_fault=clear_fault)
        if self.link.state is AxisState.LATCHED:
            await self.link.do(CommandKind.RESET, i=1)
        await self.link.do(CommandKind.VERIFIED, **seeds)

    async def _rest(self) -> None:
        """Ends the drive's monitoring of the master if power is off."""
        self.is_prepared = False
        if self.link.state is AxisState.DISABLED and self.link.power is not State.FAULT:
            with suppress(HdbridgeError):  # monitoring is set up again each time power is switched on
                await self._work(self.commissioning.rest)

    # ---------------------------------------------------------------- compensation

    async def compensate(self, holder: str, scheme: Scheme) -> None:
        """Selects the part of the model that compensates; fades it in, also during motion."""
        self.check_may(holder)
        async with self._changing:
            await self._use(await self._work(self.models.with_scheme, scheme))

    async def activate_model(self, holder: str, version: int | Literal["pending", "active"]) -> None:
        """Activates a model of the profile and uses it: a version, ``pending`` or ``active``.

        ``pending`` commits it; ``active`` reads the profile's model again. Fades it in, also during motion.
        """
        self.check_may(holder)
        identity = self.commissioning.drive.identity
        async with self._changing:
            await self._use(await self._work(self.models.found, version, identity))
            date = datetime.now(UTC)
            await self._work(self.models.activate, version, identity, date)
            await self._use(self.models.chosen)

    async def settle(self) -> None:
        """Sends the chosen setting to the control process unless that uses it already."""
        async with self._changing:
            if not self.models.settled:
                await self._use(self.models.chosen)

    def following_for(self, holder: str) -> Following:
        """Returns the adaptation, for a change by ``holder``; raises InputError if the axis has none."""
        self.core.lease.check(holder)
        if self.following is None:
            raise InputError(f"{self.name}: this axis has no adaptation; configure one in the machine file")
        return self.following

    async def switch_load_loop(self, holder: str, *, on: bool) -> None:
        """Switches the load loop on or off."""
        self.check_may(holder)
        async with self._changing:
            await self._use(self.models.with_load_loop(on))

    async def _use(self, setting: CompensationSetting) -> None:
        """Sends a setting to the control process and waits until it is in effect."""
        link = self.link
        await link.do(CommandKind.CHANGE, i=self.models.send(setting))
        self.models.chosen = setting
        await self.core.until(lambda: not int(link.value("flags")) & SampleFlag.CHANGING, CHANGE_S)

    # ---------------------------------------------------------------- objects of the drive

    async def sdo_read(self, object_: str) -> tuple[Object, Value]:
        """Reads an object of the drive by its number (``6064h``, ``0x1018:4``) or EDS name."""
        return await self._work(self.commissioning.read, object_)

    async def sdo_write(self, holder: str, object_: str, value: str) -> Object:
        """Writes an object of the drive, given as text; refused while the axis is enabled."""
        self.check_may(holder)
        if self.link.state in MAY_MOVE:
            raise RefusedError(
                f"{self.name}: no object is written while the axis is enabled; disable it first"
            )
        self.is_prepared = False
        return await self._work(self.commissioning.write, object_, value)
