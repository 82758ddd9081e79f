"""One axis's share of the control cycle: what it measured, what is wrong with it, what it is told.

`BusCycle` runs the period and brings the frames; here they are judged by the fault table, and the RPDO that
follows is made. Nothing here waits or sends. An axis is

* *silent*: it gets no RPDO. Its TPDOs are taken when they come, and nothing about it is a fault. So it is
  until `AxisCycle.begin`, after `AxisCycle.silence`, and from a reaction of `Reaction.LATCH` on.
* *speaking*: it gets an RPDO in every period, its TPDOs are awaited, and everything is judged.
* *stopped*: speaking, with a quick stop latched. The quick stop is sent until the motor stands, while the
  other axes go on. When that is over, well or not, nobody waits for its TPDOs any more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import Frames, ProcessImage
from hdbridge.drive.link import Frame, new_tuple
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.pdo import PdoLengthError
from hdbridge.drive.plausibility import Plausibility
from hdbridge.drive.states import State
from hdbridge.drive.supervision import ROWS, Event, Fault, Reaction, Supervision
from hdbridge.drive.traffic import Traffic
from hdbridge.drive.writes import drives_patience_s
from hdbridge.errors import InputError, SafetyStop

Target = int | None
"""Motor counts for 607Ah; None for the last one once more."""
Command = Target | Callable[[Feedback], Target]

STILL_CYCLES: Final = 3
"""After a quick stop the motor has to keep its place for this many cycles to count as standing."""
_ENABLED: Final = State.OPERATION_ENABLED
_POWERED: Final = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
_STILL_DRIVEN: Final = (State.OPERATION_ENABLED, State.FAULT_REACTION_ACTIVE, State.UNKNOWN)


class AxisCycle:
    """One axis on a `BusCycle`; silent until `begin`.

    ``image`` gives the controlword (``image.power.go``) and the scaling; ``supervision`` holds the latch and
    the list of faults; ``monitor`` may be shared with the boot-up. ``plausibility`` is by default what the
    axis file allows. ``refused`` are the errors of a command that stop the axis as a bad target does; others
    pass through the whole cycle, to the cost of the other axes.
    """

    __slots__ = (
        "_awaited_channels", "_channel_ids", "_channels", "_commanded", "_good_cycle", "_last", "_left",
        "_plausibility", "_refused", "_ridden", "_still", "_stop_cycles", "_traffic", "awaited", "changed",
        "command", "feedback", "image", "monitor", "name", "needed", "patience_s", "pending", "rested",
        "silent", "spoke_s", "supervision",
    )  # fmt: skip

    def __init__(
        self,
        image: ProcessImage,
        supervision: Supervision,
        *,
        name: str = "",
        monitor: NetworkMonitor | None = None,
        plausibility: Plausibility | None = None,
        stop_timeout_s: float = 1.0,
        refused: tuple[type[Exception], ...] = (Exception,),
    ) -> None:
        axis = image.axis
        self.image = image
        self.supervision = supervision
        self.name = name or axis.name
        self.monitor = monitor if monitor is not None else NetworkMonitor()
        self.command: Command = None
        """The target in motor counts, None to hold the last one, or a function of the cycle's feedback that
        gives either. It is used while the drive is enabled; before that the target is the actual position, so
        that enabling moves nothing. It stays until another is set."""
        self.silent = True
        """It gets no RPDO."""
        self.feedback = Feedback(
            -1, 0.0, image.statusword or 0, image.motor_counts, image.load_counts, image.demand_counts,
            image.torque_permille, False, image.readings,
        )  # fmt: skip
        """Of the last turn; not fresh where it has none of its own."""
        self.patience_s = drives_patience_s(axis)
        """For how long the drive waits for a silent master before it stops by itself."""
        self.spoke_s = 0.0
        """Begin of the last turn that gave it an RPDO, on the clock."""

        # Between the bus and its axes:
        self.pending: list[tuple[Fault, str]] = []
        """Faults of this turn that are not judged yet."""
        self.needed = 0
        """Bits of the TPDOs that make a turn's feedback fresh."""
        self.awaited = False
        """The turn waits for its TPDOs."""
        self.rested = True
        """It begins with the next turn: what waited is not of it."""
        self.changed: Callable[[], None] = _nobody
        """Called when it is to be treated otherwise from the next turn on."""

        self._traffic = Traffic(image, self.monitor, 0.0)
        self._plausibility = plausibility if plausibility is not None else Plausibility.of(axis)
        self._refused = refused
        self._channels = bool(image.channels)
        self._awaited_channels: list[int] = []
        self._channel_ids = frozenset(layout.can_id for layout in image.channel_tpdos)
        self._last: Feedback | None = None
        self._good_cycle = 0
        self._commanded = False
        self._ridden: Event | None = None
        self._left = self._still = 0
        self._stop_cycles = max(int(stop_timeout_s / axis.drive.cycle_s), STILL_CYCLES + 1)

    def begin(self) -> None:
        """Speak from the next turn on; what came before, and how far the encoders moved, is not judged.

        After a `Reaction.LATCH` it stays silent unless the latch has been released.
        """
        self.rested = True
        self.pending.clear()
        self.silent = self.supervision.reaction is Reaction.LATCH
        self._last = None
        self._commanded = False
        self.image.forget_channels()
        self.changed()

    def silence(self) -> None:
        """Send nothing more to it from the next turn on, and judge nothing about it."""
        self.silent = True
        self.pending.clear()
        self._commanded = False
        self.changed()

    def reset(self, *, verified: bool = False) -> None:
        """Release the latch (`Supervision.reset`); after a `Reaction.LATCH` it speaks again with `begin`."""
        self.supervision.reset(verified=verified)

    @property
    def riding(self) -> bool:
        """A quick stop is being driven: the drive has not confirmed it, and the time for that is not over."""
        stop = self.supervision.stop
        if stop is None or self.supervision.reaction is Reaction.LATCH:
            return False
        return stop is not self._ridden or not self._over()

    @property
    def confirmed(self) -> bool:
        """After a quick stop: the drive has left 'operation enabled', and the motor stood."""
        stop = self.supervision.stop
        return stop is not None and stop is self._ridden and self._still >= STILL_CYCLES

    @property
    def stopped(self) -> SafetyStop | None:
        """The latched stop in its own words; complete once `riding` is over. None while the axis may run."""
        supervision = self.supervision
        if supervision.stop is None:
            return None
        stop = supervision.error()
        if supervision.reaction is not Reaction.QUICK_STOP or self.riding or self.confirmed:
            return stop
        return SafetyStop(
            f"{stop.text}; the drive did not confirm it: its own watchdogs have to stop it", stop.hint
        )

    # ---------------------------------------------------------------- for the bus

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that `hear` takes."""
        return self._traffic.identifiers | self._channel_ids

    def route(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Identifiers of the TPDOs that each turn needs, and of those of the channels that come with it.

        Settles whether the turns to come wait for them.
        """
        self.awaited = not self.silent and (self.supervision.stop is None or self.riding)
        self._awaited_channels = self.image.awaited_channels()
        return self.image.tpdo_ids, tuple(self._awaited_channels)

    def start(self, now: float, count: int) -> None:
        """Its first turn after `begin` starts."""
        self._traffic.heard_s = self.spoke_s = now
        self._good_cycle = count

    @property
    def powered(self) -> bool:
        """The drive has power, or is on the way to it."""
        power = self.image.power
        return power.aim is _ENABLED or power.state in _POWERED

    def stop_before_sync(self) -> Frames | None:
        """RPDOs with a quick stop, if a fault that came before SYNC stops the axis; else None.

        A drive keeps the last RPDO until SYNC. If it has stopped on its own in between, the set-point in
        there would set it in motion again. After a fault that latches the axis, no RPDO is sent at all.
        """
        if max(ROWS[fault].first for fault, _ in self.pending) is not Reaction.QUICK_STOP:
            return None
        self.image.power.quick_stop()
        return self.image.pack_rpdo_stop()

    def glance(self, frame: Frame) -> None:
        """Look at a TPDO that is too early or too late to be used: has the drive dropped out?"""
        word = self.image.statusword_in(frame.can_id, frame.data)
        if self._commanded and word is not None:
            self.image.power.observe(word)
            if self.image.power.dropped is not None:
                self._fell_out()
                self._commanded = False

    def hear(self, frame: Frame) -> None:
        """A frame of the axis that is not waited for: what it means."""
        can_id, data, _ = frame
        if can_id not in self._channel_ids:
            faults = list(self._traffic.faults(frame, commanded=self._commanded))
        else:
            faults = []
            try:
                self.image.accept(can_id, data)
            except PdoLengthError:
                faults.append((Fault.DISCARDED_FRAME, f"{can_id:03X}h with {len(data)} bytes"))
        if not (self.silent or self.rested):
            self.pending += faults

    def turn(self, now: float, count: int, time_s: float, complete: bool) -> Frames | None:
        """One period is received, ``complete`` with every TPDO: judge it; the RPDOs, where they are to go."""
        image, supervision = self.image, self.supervision
        self.spoke_s = now
        stop = supervision.stop
        if stop is not self._ridden:
            self._note(stop)
        if self._channels:
            self._step_channels()
        power = image.power
        enabled = power.state is _ENABLED
        if complete and enabled and self._last is not None:
            complete = self._believable(self._last, count)
        before = self.feedback
        if complete:
            feedback = self._last = new_tuple(Feedback, (
                count, time_s, image.statusword or 0, image.motor_counts,
                image.load_counts, image.demand_counts, image.torque_permille, True,
                image.readings,
            ))  # fmt: skip
            self.feedback = feedback
            self._good_cycle = count
        else:
            feedback = self.stale(count, time_s)
        if self._commanded and (not enabled or power.dropped is not None):
            self._fell_out()
        if now - self._traffic.heard_s > image.heartbeat_timeout_s and (stop is None or not self._over()):
            silent_ms = 1e3 * (now - self._traffic.heard_s)
            self.pending.append((Fault.HEARTBEAT_LOST, f"for {silent_ms:.0f} ms"))

        data = None
        if enabled and stop is None:
            try:
                command = self.command
                target = command(feedback) if callable(command) else command
                data = image.pack_rpdo_held() if target is None else image.pack_rpdo(target)
            except self._refused as error:
                what = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
                self.pending.append((Fault.BAD_TARGET, what))
        if self.pending or not supervision.quiet:
            return self._react(count, data, before)
        if data is None:
            data = self._idle()
        self._commanded = enabled and power.aim is _ENABLED
        return data

    def listen(self, count: int, time_s: float, complete: bool) -> None:
        """One period is over for an axis that is silent."""
        image = self.image
        if self._channels:
            image.step_channels()
        if complete:
            self.feedback = self._last = new_tuple(Feedback, (
                count, time_s, image.statusword or 0, image.motor_counts,
                image.load_counts, image.demand_counts, image.torque_permille, True,
                image.readings,
            ))  # fmt: skip
        else:
            self.stale(count, time_s)

    def also(self, count: int, fault: Fault, detail: str) -> None:
        """A fault that came of answering the turn, or after it."""
        if self.supervision.also(count, fault, detail) is Reaction.LATCH:
            self._latch()

    def bus_down(self, count: int, time_s: float, detail: str) -> None:
        """The interface failed somewhere in the turn."""
        if self.pending:
            self._judge(count)
        self.also(count, Fault.BUS_DOWN, detail)
        if self.feedback.cycle != count:
            self.stale(count, time_s)

    def stale(self, count: int, time_s: float) -> Feedback:
        """Feedback of a cycle that has none of its own: the last good values."""
        image = self.image
        if self._last is not None:
            self.feedback = self._last._replace(cycle=count, time_s=time_s, fresh=False)
        else:
            self.feedback = Feedback(
                count, time_s, image.statusword or 0, image.motor_counts, image.load_counts,
                image.demand_counts, image.torque_permille, False, image.readings,
            )  # fmt: skip
        return self.feedback

    # ---------------------------------------------------------------- the parts of a turn

    def _react(self, count: int, data: Frames | None, before: Feedback) -> Frames | None:
        """The rest of a turn in which something is wrong, or was in the last one."""
        power, stop = self.image.power, self.supervision.stop
        reaction = self._judge(count)
        if reaction is Reaction.QUICK_STOP:
            power.quick_stop()
            data = None
        if stop is not None:
            self._ride(before)
        if reaction is Reaction.LATCH:
            return None
        self._commanded = power.state is State.OPERATION_ENABLED and power.aim is State.OPERATION_ENABLED
        return data if data is not None else self._idle()

    def _judge(self, count: int) -> Reaction:
        reaction = self.supervision.judge(count, self.pending)
        self.pending.clear()
        if reaction is Reaction.LATCH:
            self._latch()
        return reaction

    def _latch(self) -> None:
        """Set-points stop. Whatever comes next, it begins with a drive that nobody wants enabled."""
        self.image.power.quick_stop()
        if not self.silent:
            self.silence()

    def _step_channels(self) -> None:
        """Hold what did not come, give up what stays away, and wait again for what is back."""
        image = self.image
        faults = image.step_channels()
        if faults or len(self._awaited_channels) < len(self._channel_ids):
            self.pending += faults
            if image.awaited_channels() != self._awaited_channels:
                self.changed()

    def _believable(self, last: Feedback, count: int) -> bool:
        """Whether the positions can follow from the last good ones; notes a following error as well."""
        image, plausibility = self.image, self._plausibility
        motor = image.motor_counts
        cycles = count - self._good_cycle
        jump = plausibility.jump(motor - last.motor_counts, image.load_counts - last.load_counts, cycles)
        if jump is not None:
            self.pending.append((Fault.ENCODER_JUMP, jump))
            return False
        lag = plausibility.lag(image.demand_counts - motor)
        if lag is not None:
            self.pending.append((Fault.FOLLOWING_ERROR, lag))
        return True

    def _fell_out(self) -> None:
        power = self.image.power
        state = power.dropped or power.state
        fault = state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
        detail = f"it went to '{state.value}'"
        self.pending.append((Fault.DRIVE_FAULT if fault else Fault.DROPPED_OUT, detail))

    def _idle(self) -> Frames:
        """The RPDOs with the actual position as target."""
        try:
            return self.image.pack_rpdo_idle()
        except InputError:
            # It does not fit the target object. The drive is not enabled or is told to stop: it ignores it.
            return self.image.pack_rpdo_held()

    # ---------------------------------------------------------------- a quick stop, turn by turn

    def _over(self) -> bool:
        """Whether the latched quick stop has been driven to its end."""
        return self._still >= STILL_CYCLES or self._left == 0

    def _note(self, stop: Event | None) -> None:
        """A stop has been latched since the last turn, or released."""
        self._ridden = stop
        self._still, self._left = 0, self._stop_cycles
        if stop is not None:
            self.image.power.quick_stop()
        self.changed()

    def _ride(self, before: Feedback) -> None:
        """One turn of the quick stop is over."""
        if self._over():
            return
        feedback = self.feedback
        self._left -= 1
        halted = feedback.fresh and self.image.power.state not in _STILL_DRIVEN
        kept = halted and abs(feedback.motor_counts - before.motor_counts) <= 1
        self._still = self._still + 1 if kept else 0
        if self._over():
            self.changed()


def _nobody() -> None:
    """It is on no bus yet."""
