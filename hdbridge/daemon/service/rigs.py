"""The axis that a job works on: power, compensation and samples for the benches of `procedures`.

Blocking, for one worker thread; several benches of a job follow each other.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Unpack

from hdbridge.axis import AxisConfig, Identity
from hdbridge.control.bench import compensation_for
from hdbridge.control.compensation import Compensation
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind, SampleReader
from hdbridge.daemon.memory.knots import KnotQueue
from hdbridge.daemon.service.activity import Activity
from hdbridge.daemon.service.dispatch import ANSWER_S, Arguments
from hdbridge.daemon.service.power import POWER_S
from hdbridge.daemon.service.procedures import DaemonBench
from hdbridge.daemon.service.reports import stop_hint
from hdbridge.errors import DaemonError, HdbridgeError, SafetyStop
from hdbridge.model import TransmissionModel

if TYPE_CHECKING:
    from hdbridge.daemon.service.ports import ServiceAxis

STOP_WORDS_S: Final = 3.0
"""The control process tells why it has stopped an axis when that stands."""


class DaemonRig:
    """`hdbridge.control.rig.Rig` of an axis that the daemon holds, for one job."""

    def __init__(self, axis: ServiceAxis, activity: Activity) -> None:
        """``activity`` is the job's: once it is over, whatever runs here stops."""
        self._axis = axis
        self._activity = activity
        self.core = axis.core
        self.index = axis.link.index
        self.period_s = axis.core.memory.period_s
        self.knots: KnotQueue = axis.core.memory.knots[self.index]
        self._reader: SampleReader = axis.core.memory.reader()
        self._newest: tuple[int, dict[str, float]] | None = None
        self._turns, self._turned_s = -1, axis.core.timing.clock.now()

    # ---------------------------------------------------------------- Rig

    @property
    def axis(self) -> AxisConfig:
        """The axis file."""
        return self._axis.axis.config

    @property
    def identity(self) -> Identity:
        """Which drive answers."""
        return self._axis.commissioning.identity

    def bench(
        self,
        compensation: Compensation | None = None,
        *,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> DaemonBench:
        """A bench on this axis; without a compensation it runs uncompensated."""
        return DaemonBench(self, compensation, interrupted)

    # ---------------------------------------------------------------- for its benches

    def uncompensated(self) -> Compensation:
        """Of a model without effects."""
        return compensation_for(self.axis, TransmissionModel(self.axis.gear.ratio))

    def command(self, kind: CommandKind, within_s: float = ANSWER_S, **arguments: Unpack[Arguments]) -> Event:
        """As `Dispatcher.do_now`."""
        return self.core.dispatch.do_now(kind, self.index, within_s, **arguments)

    def enable(self, compensation: Compensation) -> None:
        """Power on, standing still, compensated anew from here on."""
        if self.state is not AxisState.DISABLED:
            self.disable()
        self.command(CommandKind.CHANGE, i=self._axis.models.send_for_job(compensation.model))
        seeds = self._axis.commissioning.prepare()
        self.command(CommandKind.ENABLE, POWER_S, **seeds.arguments())

    def disable(self) -> None:
        """Brake to rest, power off."""
        self.command(CommandKind.DISABLE, POWER_S)
        self.wait(2.0 * self.period_s)
        if self.state is AxisState.DISABLED:
            self._axis.commissioning.rest()

    def stop(self) -> None:
        """`disable` as far as it can be done; what cannot is the drive's own watchdogs' to do."""
        with suppress(HdbridgeError):
            self.disable()

    @property
    def state(self) -> AxisState:
        """Where the control process has the axis."""
        return AxisState(int(self.value("state")))

    def value(self, field: str) -> float:
        """A field of the newest sample."""
        self._look()
        while self._newest is None:
            self.wait(self.period_s)
            self.check_alive()
            self._look()
        return self._newest[1][field]

    def wait(self, duration_s: float) -> None:
        """Let time pass, and take in what was told."""
        clock = self.core.timing.clock
        clock.sleep_until(clock.now() + duration_s)
        self.core.log.poll()

    def why_over(self) -> str:
        """Why the job is to end, in words; empty while it goes on."""
        return self._activity.over

    def check_alive(self) -> None:
        """DaemonError where the control process has not turned lately."""
        turns, now_s = self.core.memory.status.loop_count, self.core.timing.clock.now()
        if turns != self._turns:
            self._turns, self._turned_s = turns, now_s
        elif now_s - self._turned_s > ANSWER_S:
            raise DaemonError(
                f"{self._axis.name}: the control process hangs or is gone; the drive stops by itself"
            )

    def stopped(self) -> SafetyStop:
        """The error for an axis that the control process has stopped, in its words once it has told them."""
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
