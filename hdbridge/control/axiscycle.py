"""One axis's part of the control cycle: feedback, fault judgement, and the RPDOs in reply.

`BusCycle` runs the period and delivers the frames. This module judges them by the fault table and builds the
next RPDOs; it neither waits nor sends. An axis is

* *silent*: it receives no RPDO. TPDOs are accepted when they arrive, and nothing is judged as a fault. This
  is the state before `AxisCycle.begin`, after `AxisCycle.silence`, and after a reaction of `Reaction.LATCH`.
* *speaking*: it receives an RPDO in every period, its TPDOs are awaited, and every fault is judged.
* *stopped*: speaking, with a quick stop that a fault or `AxisCycle.quick_stop` has latched. The quick stop is
  sent until the motor is at rest, while the other axes continue. After that, or after its time-out, its TPDOs
  are no longer awaited.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import Frames, ProcessImage
from hdbridge.drive.link import Frame, new_tuple
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import COB_NMT
from hdbridge.drive.pdo import PdoLengthError
from hdbridge.drive.plausibility import Plausibility
from hdbridge.drive.standstill import Standstill
from hdbridge.drive.states import FAULTS, OFF, State
from hdbridge.drive.supervision import ROWS, Event, Fault, Reaction, Supervision
from hdbridge.drive.traffic import Traffic
from hdbridge.drive.writes import drive_master_timeout_s
from hdbridge.errors import InputError, SafetyStop

Target = int | None
"""Motor counts for 607Ah; None repeats the last target."""
Command = Target | Callable[[Feedback], Target]

OBEY_S: Final = 0.25
"""Maximum time from the command of a quick stop until the drive leaves 'operation enabled'.

A drive that takes longer loses its voltage."""
_ENABLED: Final = State.OPERATION_ENABLED
_POWERED: Final = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
_NOT_STOPPED: Final = (State.OPERATION_ENABLED, State.UNKNOWN)
_STILL_DRIVEN: Final = (State.OPERATION_ENABLED, State.FAULT_REACTION_ACTIVE, State.UNKNOWN)


class AxisCycle:
    """One axis on a `BusCycle`; silent until `begin`.

    ``image`` provides the controlword (``image.power.go``) and the scaling; ``supervision`` holds the latch
    and the list of faults; ``monitor`` may be shared with the boot-up. An exception of a command whose type
    is in ``refused`` stops only this axis, like a bad target; any other exception propagates out of the cycle
    and affects all axes.
    """

    def __init__(
        self,
        image: ProcessImage,
        supervision: Supervision,
        *,
        name: str = "",
        monitor: NetworkMonitor | None = None,
        stop_timeout_s: float = 1.0,
        refused: tuple[type[Exception], ...] = (Exception,),
    ) -> None:
        axis = image.axis
        self.image = image
        self.supervision = supervision
        self.name = name or axis.name
        self.monitor = monitor if monitor is not None else NetworkMonitor()
        self.command: Command = None
        """Target in motor counts, None to repeat the last target, or a function of the cycle's feedback that
        returns either. It is used while the drive is enabled. Before that, the target is the actual
        position, so that enabling causes no motion. It remains in force until replaced."""
        self.silent = True
        """True while the axis receives no RPDO."""
        self.feedback = self._feedback(-1, 0.0, False)
        """Feedback of the last cycle; stale if the cycle had none."""
        self.master_timeout_s = drive_master_timeout_s(axis)
        """Time without a frame of the master after which the drive stops on its own."""
        self.last_sent_s = 0.0
        """Clock time at the start of the last cycle that sent an RPDO to this axis."""

        # Shared with `BusCycle`:
        self.pending: list[tuple[Fault, str]] = []
        """Faults of this cycle that have not been judged yet."""
        self.needed = 0
        """Bits of the TPDOs required for fresh feedback."""
        self.awaited = False
        """True if the cycle waits for this axis's TPDOs."""
        self.flushing = True
        """True from `begin` until the next cycle has read the queued frames, which are not judged."""
        self.changed: Callable[[], None] = _nobody
        """Called when the identifiers or the state of the axis change; the change takes effect in the next
        cycle.
        """

        self._traffic = Traffic(image, self.monitor, 0.0)
        self._plausibility = Plausibility.of(axis)
        self._refused = refused
        self._channels = bool(image.channels)
        self._awaited_channels: list[int] = []
        self._channel_ids = frozenset(layout.can_id for layout in image.channel_tpdos)
        self._last: Feedback | None = None
        self._good_cycle = 0
        self._commanded = False
        self._may_run = True
        """False once the drive was off and power was not requested since."""
        self._ordered = False
        """True from `quick_stop` until `begin`."""
        self._handled_stop: Event | bool = False
        self._standstill = Standstill(axis)
        self._left = 0
        self._disobeyed = False
        """True if the drive was still in 'operation enabled' `OBEY_S` after the command."""
        braking_s = axis.limits.velocity_deg_s / axis.limits.acceleration_deg_s2
        timeout_s = max(stop_timeout_s, 2.0 * braking_s)
        self._stop_cycles = int(timeout_s / axis.drive.cycle_s)
        self._obey_cycles = int(OBEY_S / axis.drive.cycle_s)

    def begin(self) -> None:
        """Sends RPDOs from the next cycle on; earlier frames and encoder motion are not supervised.

        If power is requested, the positions in ``image`` are those of the preparation, and the first ones of
        the cycle must agree with them. After a `Reaction.LATCH`, the axis stays silent unless the latch has
        been released.
        """
        self.flushing = True
        self.pending.clear()
        self._ordered = False
        self.silent = self.supervision.reaction is Reaction.LATCH
        prepared = self.image.power.aim is _ENABLED
        self._last = self._feedback(self.feedback.cycle, self.feedback.time_s, True) if prepared else None
        self._commanded = False
        self._may_run = prepared or self.image.power.state not in OFF
        self.image.forget_channels()
        self.changed()

    def silence(self) -> None:
        """Stops sending RPDOs and judging faults, from the next cycle on."""
        self.silent = True
        self.pending.clear()
        self._commanded = False
        self.changed()

    def quick_stop(self) -> None:
        """Latches a quick stop by command, which is watched like that of a fault; `begin` releases it."""
        self._ordered = True
        self.image.power.quick_stop()

    @property
    def _stop(self) -> Event | bool:
        """Latched stop, by a fault or by command (True); False while the axis may run."""
        return self.supervision.stop or self._ordered

    @property
    def stopping(self) -> bool:
        """True while a quick stop is under way: neither confirmed by the drive nor timed out."""
        if self.silent or not self._stop:
            return False
        return self._stop is not self._handled_stop or not self._over()

    @property
    def confirmed(self) -> bool:
        """True if, after a quick stop, the drive has left 'operation enabled' and the motor stood still."""
        return bool(self._stop) and self._stop is self._handled_stop and self._standstill.reached

    @property
    def outcome(self) -> str:
        """Describes a drive that did not obey or confirm a completed quick stop; otherwise empty."""
        if self.silent or self.stopping:
            return ""
        if not self.confirmed:
            return "; the drive did not confirm it: its own watchdogs have to stop it"
        return "; the drive did not obey it, so its voltage was disabled" * self._disobeyed

    @property
    def stopped(self) -> SafetyStop | None:
        """Stop by a fault as an error, complete once `stopping` is over; None while the axis may run."""
        if self.supervision.stop is None:
            return None
        stop = self.supervision.error()
        return SafetyStop(f"{stop.text}{self.outcome}", stop.hint)

    # ---------------------------------------------------------------- for the bus

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames accepted by `hear`."""
        return self._traffic.identifiers | self._channel_ids

    def route(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Returns the identifiers of the TPDOs that each cycle needs, and of the channel TPDOs.

        Also decides whether the following cycles wait for them.
        """
        self.awaited = not self.silent and (not self._stop or self.stopping)
        self._awaited_channels = self.image.awaited_channels()
        return self.image.tpdo_ids, tuple(self._awaited_channels)

    def start(self, now: float, count: int) -> None:
        """Starts the first cycle after `begin`; ``now`` is the clock time, ``count`` the cycle number."""
        self._traffic.heard_s = self.last_sent_s = now
        self._good_cycle = count

    @property
    def powered(self) -> bool:
        """True if the drive has power or is being switched on."""
        power = self.image.power
        return power.aim is _ENABLED or power.state in _POWERED

    def stop_before_sync(self) -> Frames | None:
        """Returns the frames that stop the drive if a fault noticed before SYNC stops the axis, else None.

        A drive holds the last RPDO until SYNC. If it has stopped on its own in the meantime, the set-point
        in that RPDO would set it in motion again.
        """
        if max(ROWS[fault].first for fault, _ in self.pending) < Reaction.QUICK_STOP:
            return None
        self.image.power.quick_stop()
        return self._stop_frames()

    def check_statusword(self, frame: Frame) -> None:
        """Checks the statusword of a TPDO that came too early or too late to be used."""
        word = self.image.statusword_in(frame.can_id, frame.data)
        if self._commanded and word is not None:
            self.image.power.observe(word)
            if self.image.power.dropped is not None:
                self._changed_state()

    def hear(self, frame: Frame) -> None:
        """Interprets a frame of the axis that the cycle does not wait for, and records its faults."""
        can_id, data, _ = frame
        if can_id not in self._channel_ids:
            faults = list(self._traffic.faults(frame, commanded=self._commanded))
        else:
            faults = []
            try:
                self.image.accept(can_id, data)
            except PdoLengthError:
                faults.append((Fault.DISCARDED_FRAME, f"{can_id:03X}h with {len(data)} bytes"))
        if self.flushing:
            faults = [each for each in faults if each[0] is Fault.BOOT_UP]  # a restart is never out of date
        if not self.silent:
            self.pending += faults

    def run_period(self, now: float, count: int, time_s: float, complete: bool) -> Frames | None:
        """Judges one period of a speaking axis and returns the RPDOs to send, or None.

        ``complete`` states that all required TPDOs have arrived.
        """
        image, supervision = self.image, self.supervision
        self.last_sent_s = now
        stop = self._stop
        if stop is not self._handled_stop:
            self._note(stop)
        if self._channels:
            self._step_channels()
        power = image.power
        enabled = power.state is _ENABLED
        if complete and self._last is not None and (enabled or power.aim is _ENABLED):
            complete = self._believable(self._last, count, enabled=enabled)
        if complete:
            self.feedback = feedback = self._last = self._feedback(count, time_s, True)
            self._good_cycle = count
        else:
            feedback = self.stale(count, time_s)
        if not enabled:
            self._may_run = power.aim is _ENABLED or (self._may_run and power.state not in OFF)
        if (enabled and not self._may_run) or (power.dropped is not None and not stop):
            self._changed_state()
        if now - self._traffic.heard_s > image.heartbeat_timeout_s and not (stop and self._over()):
            silent_ms = 1e3 * (now - self._traffic.heard_s)
            self.pending.append((Fault.HEARTBEAT_LOST, f"for {silent_ms:.0f} ms"))

        data = None
        if enabled and not stop:
            try:
                command = self.command
                target = command(feedback) if callable(command) else command
                data = image.pack_rpdo_held() if target is None else image.pack_rpdo(target)
            except self._refused as error:
                what = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
                self.pending.append((Fault.BAD_TARGET, what))
        if self.pending or stop or not supervision.quiet:
            return self._react(count, data, bool(stop))
        if data is None:
            data = self._idle()
        self._commanded = enabled and power.aim is _ENABLED
        return data

    def listen(self, count: int, time_s: float, complete: bool) -> None:
        """Ends one period of a silent axis."""
        if self._channels:
            self.image.step_channels()
        if complete:
            self.feedback = self._last = self._feedback(count, time_s, True)
        else:
            self.stale(count, time_s)

    def add_fault(self, count: int, fault: Fault, detail: str) -> None:
        """Judges a fault that occurred while or after this cycle's RPDOs were sent."""
        if self.supervision.add_fault(count, fault, detail) is Reaction.LATCH:
            self._latch()

    def bus_down(self, count: int, time_s: float, detail: str) -> None:
        """Judges a failure of the interface during the cycle."""
        if self.pending:
            self._judge(count)
        self.add_fault(count, Fault.BUS_DOWN, detail)
        if self.feedback.cycle != count:
            self.stale(count, time_s)

    def stale(self, count: int, time_s: float) -> Feedback:
        """Returns stale feedback with the last good values, for a cycle without feedback."""
        if self._last is not None:
            self.feedback = self._last._replace(cycle=count, time_s=time_s, fresh=False)
        else:
            self.feedback = self._feedback(count, time_s, False)
        return self.feedback

    # ---------------------------------------------------------------- parts of a cycle

    def _feedback(self, count: int, time_s: float, fresh: bool) -> Feedback:
        """Returns the values of the process image as feedback of a cycle."""
        image = self.image
        return new_tuple(Feedback, (
            count, time_s, image.statusword or 0, image.motor_counts, image.load_counts,
            image.demand_counts, image.torque_permille, fresh, image.readings,
        ))  # fmt: skip

    def _react(self, count: int, data: Frames | None, stopping: bool) -> Frames | None:
        """Completes a cycle with a new fault, with a fault in the cycle before, or with a latched stop."""
        power = self.image.power
        if self._judge(count) is Reaction.LATCH:
            return self._stop_frames()
        if stopping:
            self._count_stop_cycle()
        if self._stop:
            data = None
            self._stop_drive()
        self._commanded = power.state is State.OPERATION_ENABLED and power.aim is State.OPERATION_ENABLED
        return data if data is not None else self._idle()

    def _judge(self, count: int) -> Reaction:
        reaction = self.supervision.judge(count, self.pending)
        self.pending.clear()
        if reaction is Reaction.LATCH:
            self._latch()
        return reaction

    def _stop_frames(self) -> Frames:
        """Returns RPDOs with a quick stop, or an NMT command that ends the PDOs of a drive that restarted."""
        image = self.image
        if self.monitor.watch(image.node_id).restarted:
            return ((COB_NMT, bytes((NmtCommand.PRE_OPERATIONAL, image.node_id))),)
        return image.pack_rpdo_stop()

    def _latch(self) -> None:
        """Stops the set-points of the axis, and withdraws the request to enable it."""
        self.image.power.quick_stop()
        if not self.silent:
            self.silence()

    def _step_channels(self) -> None:
        """Holds missing readings; stops waiting for lost channels and waits for recovered ones again."""
        image = self.image
        faults = image.step_channels()
        if faults or len(self._awaited_channels) < len(self._channel_ids):
            self.pending += faults
            if image.awaited_channels() != self._awaited_channels:
                self.changed()

    def _believable(self, last: Feedback, count: int, *, enabled: bool) -> bool:
        """Returns False if the positions contradict the last ones; records an excessive following error.

        The drive has a demand to follow only once it is ``enabled``.
        """
        image, plausibility = self.image, self._plausibility
        motor = image.motor_counts
        cycles = count - self._good_cycle
        jump = plausibility.jump(motor - last.motor_counts, image.load_counts - last.load_counts, cycles)
        if jump is not None:
            self.pending.append((Fault.ENCODER_JUMP, jump))
            return False
        lag = plausibility.lag(image.demand_counts - motor) if enabled else None
        if lag is not None:
            self.pending.append((Fault.FOLLOWING_ERROR, lag))
        return True

    def _changed_state(self) -> None:
        power = self.image.power
        state = power.dropped or power.state
        fault = state in FAULTS
        detail = f"it went to '{state.value}'"
        self.pending.append((Fault.DRIVE_FAULT if fault else Fault.DROPPED_OUT, detail))

    def _idle(self) -> Frames:
        """Returns the RPDOs with the last plausible position as target."""
        try:
            return self.image.pack_rpdo_idle(self.feedback.motor_counts)
        except InputError:
            # The position does not fit the target object. The drive ignores the target in any case, because
            # it is not enabled or is being stopped.
            return self.image.pack_rpdo_held()

    # ---------------------------------------------------------------- quick stop, cycle by cycle

    def _over(self) -> bool:
        """Returns True if the latched quick stop is confirmed or timed out."""
        return self._standstill.reached or self._left == 0

    def _note(self, stop: Event | bool) -> None:
        """Handles a stop that was latched or released since the last cycle."""
        self._handled_stop = stop
        self._standstill.restart()
        self._left, self._disobeyed = self._stop_cycles, False
        self.changed()

    def _count_stop_cycle(self) -> None:
        """Counts one cycle of the quick stop."""
        if self._over():
            return
        feedback = self.feedback
        self._left -= 1
        if feedback.fresh and self.image.power.state not in _STILL_DRIVEN:
            self._standstill.take(feedback.motor_counts, feedback.time_s)
        else:
            self._standstill.restart()
        waited = self._stop_cycles - self._left
        if feedback.fresh and waited >= self._obey_cycles and self.image.power.state in _NOT_STOPPED:
            self._disobeyed = True
        if self._over():
            self.changed()

    def _stop_drive(self) -> None:
        """Commands the quick stop, or power off if the drive has not obeyed it."""
        power = self.image.power
        if self._disobeyed:
            power.power_off()
        else:
            power.quick_stop()


def _nobody() -> None:
    """Does nothing, because the axis is not on a bus yet."""
