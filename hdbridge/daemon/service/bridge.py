"""Machine as seen by the API: axes, lease, coordinated moves, loan of the bus, state and events.

    async with ServiceBridge(machine, memory, timing) as bridge:
        ...

Everything runs in one event loop. The axes do not depend on this process. If it dies, they complete their
current commands, and the next service process takes them over in their current state.

Angles are load angles in degrees, speeds in deg/s. ``holder`` is the lease token. All coroutines of machine
and axes raise an `HdbridgeError` whose text is one line with the cause and the remedy:

    InputError      a value is invalid: outside the limits, not finite, no such model or object
    RefusedError    not possible in this state: not enabled, in motion, the bus is lent, a fault is latched
    LeaseError      ``holder`` is not the token of the current lease
    DriveError      the drive refuses the request or does not answer
    SafetyStop      the supervision stopped the axis during the call
    BusError        the CAN interface is gone
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Final, Self

from hdbridge.client import messages
from hdbridge.daemon.loop.states import UNKNOWN
from hdbridge.daemon.memory import Cell, CommandKind, EventKind
from hdbridge.daemon.recorder.flightlog import MARK
from hdbridge.daemon.service import reports
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.daemon.service.core import ANSWER_S, PERIOD_S, Core
from hdbridge.daemon.service.lending import Lending
from hdbridge.daemon.service.moves import run_together
from hdbridge.daemon.service.outermaster import Latency, OuterMaster
from hdbridge.daemon.service.timing import Timing
from hdbridge.errors import HdbridgeError, InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.memory import Event, Memory, SampleArray
    from hdbridge.daemon.recorder.recorder import FlightRecorder

VERIFY_AGAIN_S: Final = (0.0, 1.0, 2.0, 5.0, 10.0)
"""Pauses before successive attempts to verify a drive that did not answer; the last pause repeats."""
SETTLE_AGAIN_S: Final = (0.0, 0.5)
"""Pauses before successive attempts to send an unacknowledged compensation."""
EVENTS_RETURNED: Final = 1000
_log = logging.getLogger(__name__)


class ServiceBridge:
    """Machine, for the API."""

    def __init__(
        self,
        machine: Machine,
        memory: Memory,
        timing: Timing,
        *,
        simulated: bool = False,
        forced: bool = False,
    ) -> None:
        """``forced`` states that the daemon does not hold the lock of its interface."""
        self.machine = machine
        self.core = Core(memory, timing, machine.lease_s, [axis.name for axis in machine.axes])
        against = "the daemon was started with --force and does not hold the interface" if forced else ""
        if simulated:
            against = "its axes are simulated; a command has a simulated axis of its own with --simulate"
        self.lending = Lending(self.core, machine.bus, against)
        self.axes: dict[str, ServiceAxis] = {
            axis.name: ServiceAxis(index, axis, self.core, partial(self._outer, index))
            for index, axis in enumerate(machine.axes)
        }
        self.reader = memory.reader
        """Returns a reader of samples from now on."""
        self.recorder: FlightRecorder | None = None
        self._names = tuple(self.axes)
        self._simulated = simulated
        self._started = datetime.now(UTC)
        self._bus_up = True
        self.core.add_sink(self)
        self._latency = Latency(memory.axes)
        if machine.gateway is not None:
            self.core.add_sink(self._latency)
        self.lease = self.core.lease
        """Right to move."""
        self.lease.doing = self._doing

    def _doing(self) -> str:
        """Describes the current motions for a client without the lease."""
        states = [axis.state() for axis in self.axes.values()]
        return "; ".join(
            f"axis '{each.name}' is in motion ({each.mode})" for each in states if each.mode != "hold"
        )

    # ---------------------------------------------------------------- begin and end

    async def __aenter__(self) -> Self:
        """Takes over every axis in its current state and monitors all of them from now on.

        Returns once the control process compensates each axis by its setting, or does not answer.
        """
        self.core.start(self._watch())
        for axis in self.axes.values():
            self.core.start(self._take_over(axis))
            # The drive is booted and verified whenever necessary; the axis stays disabled.
            for is_due, attempt, pauses_s, failure in (
                (
                    lambda axis: not axis.models.settled,
                    axis.settle, SETTLE_AGAIN_S, "the compensation could not be changed",
                ),
                (
                    lambda axis: axis.link.state in UNKNOWN and self._bus_up,
                    axis.verify, VERIFY_AGAIN_S, "the drive could not be verified",
                ),
            ):  # fmt: skip
                self.core.start(self._persist(axis, is_due, attempt, pauses_s, failure))
        if (gateway := self.machine.gateway) is not None:
            master = OuterMaster(self.core, gateway)
            self.core.start(master.keep())
            for name in gateway.nodes:
                self.core.start(master.serve(self.axes[name]))
        # Let each take-over start, so that no other request precedes it.
        await asyncio.sleep(0)
        timing = self.core.timing
        deadline_s = timing.clock.now() + ANSWER_S
        while not all(axis.models.settled for axis in self.axes.values()) and timing.clock.now() < deadline_s:
            await timing.sleep(PERIOD_S)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stops monitoring; the axes complete their current commands."""
        await self.core.close()
        for axis in self.axes.values():
            axis.commissioning.close()

    async def _watch(self) -> None:
        """Reads samples and events, checks the lease and notices a new control process, every `PERIOD_S`.

        If it fails, the keeper restarts the service.
        """
        core, status = self.core, self.core.memory.status
        known = status[Cell.LOOP_PID]
        while True:
            core.poll()
            status[Cell.SERVICE_TIME_NS] = time.monotonic_ns()
            if (pid := status[Cell.LOOP_PID]) and pid != known:
                if known:
                    core.log.note("the control process was started again: every axis is disabled")
                    self._bus_up = True
                known = pid
            for axis in self.axes.values():
                try:
                    await axis.motion.end_without_lease()
                except HdbridgeError as error:
                    core.log.note(f"could not be stopped: {error}", axis.link.index)
            await core.timing.sleep(PERIOD_S)

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes the loop's events from the core: those of an axis, and failures of the bus."""
        for event in events:
            if event.axis >= 0:
                self.axes[self._names[event.axis]].on_event(event)
            elif event.kind in (EventKind.BUS_DOWN, EventKind.BUS_UP):
                self._bus_up = event.kind is EventKind.BUS_UP

    async def _persist(
        self,
        axis: ServiceAxis,
        is_due: Callable[[ServiceAxis], bool],
        attempt: Callable[[], Awaitable[None]],
        pauses_s: Sequence[float],
        failure: str,
    ) -> None:
        """Repeats an attempt while it is due, until cancelled; notes each different error."""
        timing, attempts, noted = self.core.timing, 0, ""
        while True:
            if not is_due(axis):
                attempts, noted = 0, ""
                await timing.sleep(PERIOD_S)
                continue
            await timing.sleep(pauses_s[min(attempts, len(pauses_s) - 1)])
            attempts += 1
            try:
                if is_due(axis):
                    await attempt()
            except HdbridgeError as error:
                if str(error) != noted:
                    noted = str(error)
                    self.core.log.note(f"{failure}: {error}", axis.link.index)
                    _log.warning(failure, {"axis": axis.name, "why": noted})

    async def _take_over(self, axis: ServiceAxis) -> None:
        try:
            await axis.take_over()
        except HdbridgeError as error:
            self.core.log.note(
                f"the drive could not be compared with its axis file: {error}", axis.link.index
            )

    # ---------------------------------------------------------------- state

    def state(self) -> messages.MachineState:
        """Returns the state of the machine in the newest cycle."""
        core = self.core
        newest = core.newest
        head = newest[0] if newest is not None else None
        return messages.MachineState(
            name=self.machine.name,
            version=version("hdbridge"),
            started=self._started,
            simulated=self._simulated,
            axes=[axis.state() for axis in self.axes.values()],
            bus=messages.BusState(
                interface=self.machine.bus.interface,
                channel=str(self.machine.bus.channel),
                up=self._bus_up,
                lent_to=self.lending.borrower,
                lent_s=self.lending.lent_s,
                load=float(head["bus_load"]) if head is not None else None,
            ),
            cycle=messages.CycleState(
                period_s=core.memory.period_s,
                cycle=core.cycle,
                alive=core.alive,
                pid=core.memory.status[Cell.LOOP_PID],
                skipped=int(head["skipped"]) if head is not None else 0,
                late_us=float(head["late_us"]) if head is not None else None,
                busy_us=float(head["busy_us"]) if head is not None else None,
            ),
            lease=reports.lease_state(core.lease, core.timing.clock.now()),
            recorder=self.recorder.state() if self.recorder else messages.RecorderState(on=False),
            warnings=self._warnings(),
        )

    def _outer(self, index: int) -> messages.OuterState | None:
        """Returns the state of an axis as seen by the outer master; None if it has no node in a gateway."""
        gateway, memory = self.machine.gateway, self.core.memory
        node_id = gateway.nodes.get(self._names[index]) if gateway is not None else None
        if node_id is None:
            return None
        alive_ns = memory.status[Cell.GATEWAY_TIME_NS]
        return reports.outer_state(memory.outer[index], node_id, alive_ns, self._latency.of(index))

    def _warnings(self) -> list[str]:
        core = self.core
        warnings = []
        if (borrower := self.lending.borrower) is not None:
            warnings.append(
                f"the bus is lent to {borrower}, for {self.lending.lent_s or 0.0:.0f} s now; its axes will "
                "be disabled when it ends"
            )
        elif not core.alive:
            warnings.append(
                "the control process completes no cycles: it hangs or has died; it is restarted automatically"
            )
        if not self._bus_up:
            warnings.append("the bus is down: bring the interface up; it is reopened automatically")
        if core.lost:
            warnings.append(f"{core.lost} cycles were lost before they were read: this machine is too busy")
        return warnings

    def events(self, since: int = 0) -> messages.Events:
        """Returns at most the newest `EVENTS_RETURNED` events after number ``since``, oldest first."""
        events = self.core.log.since(since)[-EVENTS_RETURNED:]
        newest = events[-1].sequence if events else self.core.log.newest
        return messages.Events(
            events=events,
            lost=max(newest - since - len(events), 0),
            newest=newest,
        )

    # ---------------------------------------------------------------- requests

    async def quick_stop(self) -> None:
        """Quick-stops all axes. Requires no lease."""
        for axis in self.axes.values():
            axis.cancel_activity("it was stopped by a quick stop")
        await self.core.do(CommandKind.QUICK_STOP)

    async def lend_bus(self, holder: str) -> None:
        """Stops the axes, switches them off and releases the bus to another program of this computer."""
        self.core.lease.check(holder)
        await self.lending.lend()

    async def coordinated(
        self, holder: str, moves: Mapping[str, float], speed: float = 1.0, wait: bool = True
    ) -> None:
        """Moves several axes so that all begin and end together; ``speed`` is a fraction of the limits."""
        for name in moves.keys() - self.axes.keys():
            raise InputError(f"there is no axis '{name}'; expected one of: {', '.join(self.axes)}")
        await run_together(holder, [self.axes[name] for name in moves], moves, speed, wait=wait)

    def mark(self, text: str) -> None:
        """Adds a remark to the event log and the flight recorder, which keeps the time around it."""
        self.core.log.note(text, kind=MARK)
