"""Rig of a job: power, compensation and samples for the benches of `procedures`.

Blocking, for one worker thread; the benches of a job run one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Unpack

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import compensation_for
from hdbridge.control.compensation import Compensation
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind, Knot, Queue, SampleReader
from hdbridge.daemon.service.activity import Activity
from hdbridge.daemon.service.axis import POWER_S
from hdbridge.daemon.service.core import ANSWER_S, Arguments
from hdbridge.daemon.service.procedures import DaemonBench
from hdbridge.daemon.service.reports import stop_hint
from hdbridge.errors import DaemonError, HdbridgeError, SafetyStop

if TYPE_CHECKING:
    from hdbridge.daemon.service.axis import ServiceAxis

STOP_WORDS_S: Final = 3.0
"""Time in which the control process reports the reason for a stop, once the axis is at rest."""


class DaemonRig:
    """`hdbridge.control.rig.Rig` of an axis under control of the daemon, for one job."""

    def __init__(self, axis: ServiceAxis, activity: Activity) -> None:
        """``activity`` is the job's; everything here stops once it is over."""
        self._axis = axis
        self._activity = activity
        self.core = axis.core
        self.index = axis.link.index
        self.period_s = axis.core.memory.period_s
        self.knots: Queue[Knot] = axis.core.memory.knots[self.index]
        self._reader: SampleReader = axis.core.memory.reader()
        self._newest: tuple[int, dict[str, float]] | None = None
        self._turns, self._turned_s = -1, axis.core.timing.clock.now()

    # ---------------------------------------------------------------- Rig

    @property
    def axis(self) -> AxisConfig:
        """Configuration of the axis."""
        return self._axis.axis.config

    @property
    def identity(self) -> Identity:
        """Identity of the drive."""
        return self._axis.commissioning.identity

    def bench(
        self,
        compensation: Compensation | None = None,
        *,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> DaemonBench:
        """Returns a bench on this axis; without a compensation it runs uncompensated."""
        return DaemonBench(self, compensation, interrupted)

    # ---------------------------------------------------------------- for its benches

    def uncompensated(self) -> Compensation:
        """Returns the compensation of a model without effects."""
        return compensation_for(self.axis, TransmissionModel(self.axis.gear.ratio))

    def command(self, kind: CommandKind, within_s: float = ANSWER_S, **arguments: Unpack[Arguments]) -> Event:
        """Runs `Core.do_now` for this axis."""
        return self.core.do_now(kind, self.index, within_s, **arguments)

    def enable(self, compensation: Compensation) -> None:
        """Switches power on, at rest, with the compensation reset to the present position."""
        if self.state is not AxisState.DISABLED:
            self.disable()
        self.command(CommandKind.CHANGE, i=self._axis.models.send_for_job(compensation.model))
        seeds = self._axis.commissioning.prepare()
        self.command(CommandKind.ENABLE, POWER_S, **seeds.arguments())

    def disable(self) -> None:
        """Brakes to rest, then switches power off."""
        self.command(CommandKind.DISABLE, POWER_S)
        self.wait(2.0 * self.period_s)
        if self.state is AxisState.DISABLED:
            self._axis.commissioning.rest()

    def stop(self) -> None:
        """Calls `disable` and ignores errors; the drive's own watchdogs stop what does not answer."""
        with suppress(HdbridgeError):
            self.disable()

    @property
    def state(self) -> AxisState:
        """State of the axis in the control process."""
        return AxisState(int(self.value("state")))

    def value(self, field: str) -> float:
        """Returns a field of the newest sample; waits for the first one."""
        self._look()
        while self._newest is None:
            self.wait(self.period_s)
            self.check_alive()
            self._look()
        return self._newest[1][field]

    def wait(self, duration_s: float) -> None:
        """Sleeps, then reads new events."""
        clock = self.core.timing.clock
        clock.sleep_until(clock.now() + duration_s)
        self.core.log.poll()

    def why_over(self) -> str:
        """Returns the reason why the job must end; empty while it may run."""
        return self._activity.over

    def check_alive(self) -> None:
        """Raises DaemonError if the control process has not completed a turn within `ANSWER_S`."""
        turns, now_s = self.core.memory.status.loop_count, self.core.timing.clock.now()
        if turns != self._turns:
            self._turns, self._turned_s = turns, now_s
        elif now_s - self._turned_s > ANSWER_S:
            raise DaemonError(
                f"{self._axis.name}: the control process hangs or is gone; the drive stops by itself"
            )

    def stopped(self) -> SafetyStop:
        """Returns the error for a stopped axis, with the control process's reason if it arrives in time."""
        log, clock = self.core.log, self.core.timing.clock
        deadline_s = clock.now() + STOP_WORDS_S
        since = max(log.newest - 50, 0)
        while clock.now() < deadline_s:
            told = [each for each in log.of_axis(self.index, since) if each.kind is EventKind.STOPPED]
            if told:
                name = self._axis.name
                return SafetyStop(f"{name}: {told[-1].text}", stop_hint(told[-1], name))
            self.wait(self.period_s)
        why = self._activity.over or f"the axis was stopped; reset it: hdbridge ctl reset {self._axis.name}"
        return SafetyStop(f"{self._axis.name}: {why}")

    def _look(self) -> None:
        rows, _ = self._reader.read()
        if len(rows):
            axis = rows[-1]["axes"][self.index]
            names = axis.dtype.names or ()
            self._newest = int(rows[-1]["cycle"]), {name: float(axis[name]) for name in names}
