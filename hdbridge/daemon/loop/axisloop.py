"""One axis in the control loop: its state, its set-point, what compensates it, what it tells.

`AxisLoop.command` takes the service's commands, between two turns. `AxisCycle` asks for a target in each
turn in which the drive is enabled; whom it asks (`_enabling`, `_follow` or nobody) changes with the state, so
that the turn itself decides nothing. `AxisLoop.after` looks at what the turn has left behind.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from hdbridge.axis import AxisConfig
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.control.bench import axis_view
from hdbridge.control.compensation import Compensation
from hdbridge.control.loadloop import LoadLoop
from hdbridge.control.sensed import Sensed
from hdbridge.control.switchover import Correction
from hdbridge.daemon.loop.states import AxisState, Cause, Happening, refusal, target_of
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.memory.blob import Blob
from hdbridge.daemon.memory.knots import KnotQueue
from hdbridge.daemon.memory.layout import NO_FAULT, Command, CommandKind, EventKind, SampleFlag
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.states import State, decode
from hdbridge.drive.supervision import Fault, Reaction, Supervision
from hdbridge.drive.switching import ENABLE_TIMEOUT_S, STOP_TIMEOUT_S
from hdbridge.effects import Moment, Observer
from hdbridge.errors import HdbridgeError, InputError, TransitionError
from hdbridge.motion import MotionMode, SetPoint
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

KNOTS_A_TURN: Final = 4
"""Knots handed to the set-point before each turn."""
STALE_KNOTS_A_TURN: Final = 64
"""Knots of another stream thrown away before each turn."""
TOLD_EVERY_S: Final = 1.0
"""A fault that changes nothing is told no more often than this."""
ROUNDING_COUNTS: Final = 2
"""By which a target may exceed the fastest motion: both ends of a step are rounded."""

_AT_REST: Final = Moment()
_OFF: Final = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)
_POWER_INDEX: Final = {state: place for place, state in enumerate(State)}
FAULT_INDEX: Final = {fault: place for place, fault in enumerate(Fault)}
"""The numbers of faults in events and samples."""


class Tell(Protocol):
    """How an axis tells the service something."""

    def __call__(
        self,
        axis: int,
        kind: EventKind,
        id: int = 0,  # noqa: A002
        code: int = 0,
        text: str = "",
    ) -> None: ...


@dataclass(frozen=True, slots=True)
class AxisSetup:
    """What an axis begins with."""

    config: AxisConfig
    compensation: Compensation
    compensating: bool = True
    """Whether the correction is faded in when the axis is enabled."""
    load_loop: LoadLoopSettings | None = None


class AxisLoop:
    """One axis; silent and unverified until the service says that its drive is verified."""

    def __init__(self, index: int, setup: AxisSetup, knots: KnotQueue, blobs: Blob, tell: Tell) -> None:
        config = setup.config
        view = axis_view(config)
        self.index = index
        self.config = config
        self.state = AxisState.UNVERIFIED
        self.image = ProcessImage(config)
        self.supervision = Supervision()
        self.cycle = AxisCycle(self.image, self.supervision, name=config.name)
        self.set_point = SetPoint(view.limits, config.drive.cycle_s)
        self.correction = Correction(setup.compensation)
        self.group: frozenset[int] = frozenset()
        """The axes (indices) that its stream began with; they stop when it does."""

        self._knots, self._blobs, self._tell = knots, blobs, tell
        self._ratio, self._limits = view.ratio, view.limits
        self._period_s = config.drive.cycle_s
        self._sensed = Sensed(config)
        self._observer = Observer()
        self._needs = bool(self.correction.needs)
        self._compensating = setup.compensating
        self._load_loop = self._made(setup.load_loop)
        self._load_loop_on = setup.load_loop is not None
        self._target_deg = 0.0
        self._loop_arcsec = 0.0
        self._issued = 0
        self._most = self._fastest_counts(setup)
        self._limited = self._limited_before = 0

        self._enable_id = self._disable_id = self._motion_id = 0
        self._mode = MotionMode.HOLD
        self._stream = 0
        self._stream_ending = False
        self._underrun = self._changing = False
        self._powering_off = False
        self._left = 0
        """Turns until the drive has taken too long."""
        self._why = ""
        """Why the axis stops, where that is no fault of the supervision's."""
        self._stop_told = True
        self._noted = self.supervision.noted
        self._told: dict[Fault, int] = {}
        self._handlers: dict[int, Callable[[Command], None]] = {
            CommandKind.VERIFIED: self._verified,
            CommandKind.RELEASE: self._silence,
            CommandKind.LEND: self._silence,
            CommandKind.UNLEND: self._verified,
            CommandKind.ENABLE: self._enable,
            CommandKind.DISABLE: self._disable,
            CommandKind.QUICK_STOP: self._quick_stop,
            CommandKind.RESET: self._reset,
            CommandKind.MOVE: self._move,
            CommandKind.JOG: self._jog,
            CommandKind.STOP: self._stop,
            CommandKind.STREAM_END: self._end_stream,
            CommandKind.COMPENSATE: self._compensate,
            CommandKind.CHANGE: self._change,
            CommandKind.LOAD_LOOP: self._switch_load_loop,
            CommandKind.DRIVE_FAULT_RESET: self._reset_drive_fault,
        }

    def _made(self, settings: LoadLoopSettings | None) -> LoadLoop | None:
        if settings is None:
            return None
        return LoadLoop(settings.gain_1_s, settings.maximum_arcsec, settings.slew_arcsec_s, self._period_s)

    def _fastest_counts(self, setup: AxisSetup) -> int:
        """Most that a target may differ from the last one: what velocity and slew limits allow together."""
        config = self.config
        slew_arcsec_s = config.compensation.slew_arcsec_s
        if setup.load_loop is not None:
            slew_arcsec_s += setup.load_loop.slew_arcsec_s
        load_deg = (config.limits.velocity_deg_s + slew_arcsec_s / ARCSEC_PER_DEG) * self._period_s
        counts = load_deg * self._ratio * config.motor_encoder.counts_per_turn / DEG_PER_TURN
        return math.ceil(1.000_01 * counts) + ROUNDING_COUNTS

    # ---------------------------------------------------------------- commands, between two turns

    def command(self, command: Command) -> None:
        """Carry a command out, or refuse it and change nothing; either is told."""
        try:
            kind = CommandKind(command.kind)
            self.check(kind)
            self._handlers[kind](command)
        except HdbridgeError as error:
            self._tell(self.index, EventKind.REFUSED, command.id, command.kind, str(error))
            return
        target = target_of(self.state, kind)
        assert target is not None
        if kind is CommandKind.DISABLE and target is AxisState.STOPPING:
            self._disable_id = command.id
        elif kind is not CommandKind.ENABLE:
            self._done(command.id)
        self._enter(target)

    def check(self, kind: CommandKind) -> None:
        """TransitionError where a command is not possible in the present state."""
        if target_of(self.state, kind) is None:
            raise TransitionError(f"{self.config.name}: {refusal(self.state, kind)}")

    def begin_stream(self, command: Command, group: frozenset[int]) -> None:
        """Follow knots from the next turn on, together with the other axes of ``group``.

        InputError in motion, or for a bad time-out.
        """
        self.set_point.stream(command.a)
        self.set_point.begin_stream()
        self._stream, self._stream_ending = command.j, False
        self._motion_id = command.id
        self.group = group

    def stop(self) -> None:
        """Brake to rest within the limits."""
        self.set_point.stop()

    def _done(self, id_: int) -> None:
        if id_:
            self._tell(self.index, EventKind.DONE, id_)

    def _happened(self, cause: Cause) -> bool:
        """Go where ``cause`` leads; whether that is somewhere else."""
        target = target_of(self.state, cause)
        if target is None or target is self.state:
            return False
        self._enter(target)
        return True

    def _enter(self, state: AxisState) -> None:
        """What is always true of a state when it is entered."""
        before = self.state
        if state is before:
            return
        self.state = state
        if state is AxisState.STOPPING and before is not AxisState.ENABLED:
            self._power_off()
        if state not in (AxisState.ENABLING, AxisState.ENABLED, AxisState.STOPPING):
            self._stand()
        if state in (AxisState.QUICK_STOPPED, AxisState.LATCHED):
            self.image.power.quick_stop()  # whatever it aimed at: nothing leads back to power but ENABLE
            self._stop_told = False
            self._left = self._turns(STOP_TIMEOUT_S)
        self._tell(self.index, EventKind.STATE, 0, state)
        self._answer_waiting(state)

    def _answer_waiting(self, state: AxisState) -> None:
        """Who waits for power on or off learns what came of it."""
        if self._enable_id and state is not AxisState.ENABLING:
            id_, self._enable_id = self._enable_id, 0
            if state is AxisState.ENABLED:
                self._done(id_)
            else:
                self._tell(self.index, EventKind.REFUSED, id_, CommandKind.ENABLE, self._stop_words())
        if self._disable_id and state is not AxisState.STOPPING:
            id_, self._disable_id = self._disable_id, 0
            if state is AxisState.DISABLED:
                self._done(id_)
            else:
                self._tell(self.index, EventKind.REFUSED, id_, CommandKind.DISABLE, self._stop_words())

    def _stand(self) -> None:
        """Nothing is followed any more."""
        self.cycle.command = None
        self._powering_off = False
        self._mode = MotionMode.HOLD
        self._leave_stream()
        self.set_point.reset(self.set_point.position_deg)

    def _leave_stream(self) -> None:
        if self._stream:
            self._stream = 0
            self._knots.clear()

    def _turns(self, time_s: float) -> int:
        return math.ceil(time_s / self._period_s)

    # ---------------------------------------------------------------- what each command does

    def _verified(self, command: Command) -> None:
        self._seed(command)
        self._aim_off()
        self.cycle.begin()

    def _seed(self, command: Command) -> None:
        if not 0 <= command.k <= 0xFFFF:
            raise InputError(f"{self.config.name}: statusword {command.k} is none; expected 16 bits")
        self.image.seed(command.i, command.j, command.k)

    def _silence(self, _: Command) -> None:
        self.cycle.silence()

    def _enable(self, command: Command) -> None:
        state = decode(command.k)
        if state is not State.SWITCH_ON_DISABLED:
            raise TransitionError(
                f"{self.config.name}: the drive is in '{state.value}', but it is enabled from 'switch on "
                "disabled'; reset its fault, or disable it first"
            )
        self.image.check_target(command.i)
        self._seed(command)
        self.image.halt = False
        self.image.power.go(State.OPERATION_ENABLED)
        self._why = ""
        self._enable_id = command.id
        rarest = max((each.every_cycles for each in self.config.channels.values()), default=0)
        self._left = self._turns(2 * ENABLE_TIMEOUT_S) + 2 * rarest
        self.cycle.command = self._enabling
        self.cycle.begin()

    def _disable(self, _: Command) -> None:
        if self.state is AxisState.ENABLED:
            self.set_point.stop()
        elif self.state is AxisState.ENABLING:
            self._why = "it was disabled before it was enabled"

    def _quick_stop(self, _: Command) -> None:
        if self.state in (AxisState.ENABLING, AxisState.ENABLED, AxisState.STOPPING, AxisState.LENT):
            self._why = "quick stop by command: latched; reset it when the axis may move again"
        if self.state is AxisState.LENT:
            # What the service does by SDO is overruled by the next RPDO.
            self.image.power.quick_stop()
            self.cycle.begin()

    def _reset(self, command: Command) -> None:
        if self.state is AxisState.QUICK_STOPPED:
            self._check_standing()
        elif self.state is AxisState.LATCHED and not command.i:
            raise TransitionError(
                f"{self.config.name}: boot and verify the drive again before this latch is released"
            )
        self.cycle.reset(verified=bool(command.i))
        if self.state is AxisState.QUICK_STOPPED:
            self.cycle.begin()

    def _check_standing(self) -> None:
        if self.cycle.riding or self.image.power.state is State.OPERATION_ENABLED:
            raise TransitionError(f"{self.config.name}: the axis is still stopping; wait until it stands")

    def _move(self, command: Command) -> None:
        velocity = None if math.isnan(command.b) else command.b
        acceleration = None if math.isnan(command.c) else command.c
        self.set_point.goto(command.a, velocity, acceleration)
        self._motion_id, self._mode = command.id, MotionMode.GOTO

    def _jog(self, command: Command) -> None:
        self.set_point.jog(command.a, command.b)
        self._motion_id = command.id

    def _stop(self, _: Command) -> None:
        if self.state is AxisState.ENABLED:
            self.set_point.stop()

    def _end_stream(self, _: Command) -> None:
        self._stream_ending = True

    def _compensate(self, command: Command) -> None:
        self._compensating = bool(command.i)
        self._engage()

    def _engage(self) -> None:
        if self._compensating:
            self.correction.engage()
        else:
            self.correction.disengage()

    def _change(self, command: Command) -> None:
        new = pickle.loads(self._blobs.get(command.i))
        if not isinstance(new, Compensation):
            raise InputError(f"{self.config.name}: {type(new).__name__} is no compensation")
        new.model.check_bound_to(self.config)
        if self.state in (AxisState.ENABLED, AxisState.STOPPING):
            self.correction.change(new)
            self._changing = True
        else:
            self.correction = Correction(new)
            self._changing = False
            self._tell(self.index, EventKind.CHANGED)
        self._needs = bool(self.correction.needs)

    def _switch_load_loop(self, command: Command) -> None:
        if self._load_loop is None:
            raise InputError(f"{self.config.name}: has no load loop; give the axis one in the machine file")
        self._load_loop_on = bool(command.i)

    def _reset_drive_fault(self, _: Command) -> None:
        self.image.power.reset_fault()

    # ---------------------------------------------------------------- power

    def _aim_off(self) -> None:
        power = self.image.power
        try:
            power.go(State.SWITCH_ON_DISABLED)
        except TransitionError:
            power.quick_stop()  # out of a fault nothing leads but a reset; at least it aims at no power

    def _power_off(self) -> None:
        self.cycle.command = None
        self._powering_off = True
        self._left = self._turns(STOP_TIMEOUT_S)
        self._aim_off()

    def _enabling(self, feedback: Feedback) -> int | None:
        """Operation is enabled: stand until every channel has told something, then begin from here."""
        waiting = [each for each in self.image.channels if each.value is None]
        if waiting or not feedback.fresh:
            if waiting and waiting[0].lost:
                self._why = (
                    f"{self.config.where(waiting[0].key)}: no reading came that can be believed "
                    f"({waiting[0].why}); check the sensor, or leave the key out"
                )
                self._left = 0
            return None
        self.image.check_target(feedback.motor_counts)
        motor_deg = self.image.motor_deg(feedback.motor_counts)
        place_deg = motor_deg / self._ratio
        self.set_point.reset(place_deg)
        self._target_deg = place_deg
        self._issued = self.image.target_counts
        self._observer = Observer()
        self._sensed.reset()
        self._sensed.take(feedback)
        self.correction.know(self._sensed.known)
        self.correction.reset(
            motor_deg,
            Moment(time_s=feedback.time_s, measured=self._sensed.measured(feedback), load_deg=place_deg),
        )
        self._engage()
        self._needs = bool(self.correction.needs)
        if self._load_loop is not None:
            self._load_loop.reset()
        self._loop_arcsec = 0.0
        self._limited = self.correction.limited
        self._underrun = False
        self.cycle.command = self._follow
        return None

    # ---------------------------------------------------------------- the target of each turn

    def _follow(self, feedback: Feedback) -> int:
        """One step of the set-point, compensated: motor counts."""
        target_deg = self._target_deg = self.set_point.step()
        if self._load_loop is not None:
            target_deg = self._trimmed(target_deg, feedback)
        correction = self.correction
        if self._needs:
            sensed = self._sensed
            if self.image.channels and sensed.take(feedback):
                correction.know(sensed.known)
            moment = self._observer.moment(
                self._ratio * target_deg,
                feedback.time_s,
                measured=sensed.measured(feedback),
                load_deg=target_deg,
            )
        else:
            moment = _AT_REST
        if feedback.fresh:
            motor_deg = correction.command(target_deg, moment)
        else:
            motor_deg = correction.hold(target_deg, moment)
        counts = self.image.target_counts_for(motor_deg)
        if not -self._most <= counts - self._issued <= self._most:
            raise InputError(
                f"target of {counts} motor counts after {self._issued}: more than the {self._most} that the "
                "limits of velocity and slew allow in a cycle; the target was not sent"
            )
        self._issued = counts
        return counts

    def _trimmed(self, target_deg: float, feedback: Feedback) -> float:
        """The load target with the slow integral of the measured error; within the limits."""
        assert self._load_loop is not None
        error: float | None = None
        if self._load_loop_on and feedback.fresh:
            error = ARCSEC_PER_DEG * (target_deg - self.image.load_deg(feedback.load_counts))
        self._loop_arcsec = self._load_loop.step(error, not self.set_point.at_rest)
        least, greatest = self._limits.position_min_deg, self._limits.position_max_deg
        trimmed = target_deg + self._loop_arcsec / ARCSEC_PER_DEG
        # Where the axis stands outside of its limits the target says so; the loop adds nothing to that.
        return min(max(trimmed, min(least, target_deg)), max(greatest, target_deg))

    # ---------------------------------------------------------------- before and after each turn

    def before(self) -> None:
        """What is to be ready when the turn begins: the next knots of a stream."""
        if self._stream:
            self._feed()

    def _feed(self) -> None:
        set_point, knots = self.set_point, self._knots
        taken = 0
        for _ in range(STALE_KNOTS_A_TURN):
            if taken == KNOTS_A_TURN or not set_point.room:
                return
            knot = knots.take()
            if knot is None:
                break
            if knot.stream != self._stream:
                continue
            taken += 1
            try:
                set_point.knot(knot.time_s, knot.position_deg, knot.velocity_deg_s)
            except InputError as error:
                self._tell(self.index, EventKind.STREAM_REFUSED, self._motion_id, 0, str(error))
                self._leave_stream()
                set_point.stop()
                return
        if self._stream_ending and not taken and set_point.at_rest:
            set_point.stop()

    def after(self) -> bool:
        """Look at what the turn has left behind; whether the axis has just been stopped by a fault."""
        supervision = self.supervision
        if supervision.noted != self._noted:
            self._tell_faults()
        stopped = False
        if supervision.stop is not None:
            latched = supervision.reaction is Reaction.LATCH
            stopped = self._happened(Happening.VERIFICATION_LOST if latched else Happening.STOP_LATCHED)
        state = self.state
        if state is AxisState.ENABLED:
            self._after_motion()
        elif state is AxisState.ENABLING:
            if self.cycle.command == self._follow:
                self._happened(Happening.POWERED)
            else:
                self._overdue(
                    f"the drive did not reach 'operation enabled' within {2 * ENABLE_TIMEOUT_S:g} s"
                )
        elif state is AxisState.STOPPING:
            self._after_stopping()
        elif not self._stop_told:
            self._after_stop()
        return stopped

    def verification_lost(self) -> None:
        """The bus is down: an axis that is lent has to be verified again, too."""
        self._why = "the bus went down while the axis was lent"
        self._happened(Happening.VERIFICATION_LOST)

    def _after_motion(self) -> None:
        set_point = self.set_point
        mode = set_point.mode
        if mode is not self._mode:
            if mode is MotionMode.HOLD:
                self._tell(self.index, EventKind.MOTION_ENDED, self._motion_id, self._mode)
            if mode is not MotionMode.STREAM:
                self._leave_stream()
            self._mode = mode
        if set_point.underrun is not self._underrun:
            self._underrun = set_point.underrun
            if self._underrun:
                self._tell(self.index, EventKind.UNDERRUN, self._motion_id)
        if self._changing and not self.correction.changing:
            self._changing = False
            self._needs = bool(self.correction.needs)
            self._tell(self.index, EventKind.CHANGED)

    def _after_stopping(self) -> None:
        if not self._powering_off:
            self._after_motion()
            if self.set_point.at_rest:
                self._power_off()
        elif self.image.power.state in _OFF:
            self._happened(Happening.POWER_OFF)
        else:
            self._overdue(f"the drive did not switch power off within {STOP_TIMEOUT_S:g} s")

    def _overdue(self, what: str) -> None:
        self._left -= 1
        if self._left > 0:
            return
        state = self.image.power.state.value
        self._why = (
            self._why or f"{what}, it is in '{state}'; look at its enable input, its supply, its faults"
        )
        self._happened(Happening.OVERDUE)

    def _after_stop(self) -> None:
        """A stop is told in full when the axis stands, or when the time for that is over."""
        if self.supervision.stop is None and self.state is AxisState.QUICK_STOPPED:
            self._left -= 1
            if self.image.power.state is State.OPERATION_ENABLED:
                if self._left > 0:
                    return
                self._why += "; the drive did not obey it, so its voltage is disabled"
                self._aim_off()
        elif self.cycle.riding:
            return
        self._stop_told = True
        stop = self.supervision.stop
        code = FAULT_INDEX[stop.fault] if stop is not None else NO_FAULT
        self._tell(self.index, EventKind.STOPPED, 0, code, self._stop_words())

    def _stop_words(self) -> str:
        """Why the axis stopped."""
        stop = self.cycle.stopped
        return str(stop) if stop is not None else self._why

    def _tell_faults(self) -> None:
        """Each fault that has a reaction, and of the others not too many."""
        supervision, told = self.supervision, self._told
        every = self._turns(TOLD_EVERY_S)
        for event in supervision.since(self._noted):
            last = told.get(event.fault)
            if event.reaction is Reaction.GO and last is not None and event.cycle - last < every:
                continue
            told[event.fault] = event.cycle
            self._tell(self.index, EventKind.FAULT, event.reaction, FAULT_INDEX[event.fault], event.detail)
        self._noted = supervision.noted

    # ---------------------------------------------------------------- the sample

    def sample(self) -> tuple[float, ...]:
        """The fields of `layout.Axis` for the turn that is over."""
        image, feedback, correction, set_point = (
            self.image,
            self.cycle.feedback,
            self.correction,
            self.set_point,
        )
        driven = self.state is AxisState.ENABLED or self.state is AxisState.STOPPING
        flags = int(SampleFlag.FRESH) if feedback.fresh else 0
        reading0 = reading1 = math.nan
        readings = feedback.readings
        if readings:
            if readings[0] is not None:
                reading0 = readings[0]
                flags |= 256
            if len(readings) > 1 and readings[1] is not None:
                reading1 = readings[1]
                flags |= 512
        motor_deg, load_deg = image.motor_deg, image.load_deg
        position_deg = motor_deg(feedback.motor_counts)
        stop = self.supervision.stop
        if driven:
            if self._compensating:
                flags |= 2
            limited = correction.limited
            if limited != self._limited:
                self._limited = limited
                flags |= 4
            if correction.memory_known:
                flags |= 8
            if self._changing:
                flags |= 16
            if set_point.at_rest:
                flags |= 32
            if self._underrun:
                flags |= 64
            target_deg = self._target_deg
            corrections = (correction.correction_arcsec, correction.predicted_arcsec, self._loop_arcsec)
            weight = correction.weight
        else:
            flags |= 32
            target_deg = position_deg / self._ratio
            corrections = (0.0, 0.0, 0.0)
            weight = 0.0
        return (
            self.state, set_point.mode, _POWER_INDEX[image.power.state],
            NO_FAULT if stop is None else FAULT_INDEX[stop.fault],
            feedback.statusword, flags,
            target_deg, motor_deg(feedback.demand_counts), position_deg, load_deg(feedback.load_counts),
            feedback.torque_permille * self._sensed.torque_nm, set_point.velocity_deg_s,
            *corrections, weight, reading0, reading1,
            math.nan if self.cycle.silent else motor_deg(image.target_counts),
        )  # fmt: skip
