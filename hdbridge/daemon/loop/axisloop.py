"""One axis in the control loop: its state, the commands it accepts and the events it reports.

`AxisLoop.command` takes the service's commands between two cycles. `AxisCycle` requests a target in each
cycle in which the drive is enabled. The state determines which function provides the target (`_enabling`,
`Follower.follow` or `_follow_gateway`), so the cycle itself makes no decision. `AxisLoop.after` evaluates the
result of the cycle.
"""

import math
from collections.abc import Callable
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.daemon.loop.faultlog import FAULT_INDEX, FaultLog, Report
from hdbridge.daemon.loop.feeds import KnotFeed, OuterFeed
from hdbridge.daemon.loop.follower import Follower
from hdbridge.daemon.loop.states import MAY_MOVE, STOPPED, AxisState, Cause, Trigger, refusal, target_of
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.memory import NO_FAULT, Command, CommandKind, EventKind, Memory, SampleFlag
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.drive.feedback import ENABLE_TIMEOUT_S, STOP_TIMEOUT_S, Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.states import State, decode
from hdbridge.drive.supervision import EXPLAINED_HINT, Reaction, Supervision
from hdbridge.errors import RESET, HdbridgeError, InputError, TransitionError
from hdbridge.motion import MotionMode

_OFF: Final = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)
_FOLLOW: Final = MotionMode.FOLLOW
_MULTI_TURN_COMMANDS: Final = {
    CommandKind.ENABLE: (AxisState.ENABLING, AxisState.ENABLED),
    CommandKind.DISABLE: (AxisState.STOPPING, AxisState.DISABLED),
}
"""State while a command that takes several cycles is pending, and the state that completes it."""
_POWER_INDEX: Final = {state: place for place, state in enumerate(State)}
# Plain integers: combining enum flags would cost more than the rest of the sample.
_FRESH, _COMPENSATING, _LIMITED, _MEMORY_KNOWN, _CHANGING, _AT_REST, _UNDERRUN, _DOUBTED, _KNOWN0, _KNOWN1 = (
    map(int, SampleFlag)
)


class AxisLoop:
    """One axis. It is unverified and sends nothing until the service reports that its drive is verified."""

    def __init__(
        self,
        index: int,
        config: AxisConfig,
        load_loop: LoadLoopSettings | None,
        memory: Memory,
        report: Report,
        due_s: Callable[[], float],
    ) -> None:
        """``index`` is its index in ``memory``; ``due_s`` returns the due time of the current cycle."""
        self.index = index
        self.config = config
        self.state = AxisState.UNVERIFIED
        self.image = ProcessImage(config)
        self.supervision = Supervision()
        self.cycle = AxisCycle(self.image, self.supervision, name=config.name)
        self.follower = Follower(config, load_loop, self.image)
        self.set_point = self.follower.set_point
        self.group: frozenset[int] = frozenset()
        """Indices of the axes that began the same stream, which stop together with this axis."""
        self.left_group: frozenset[int] = frozenset()
        """Group whose stream this axis left before its end; the controller stops the others."""

        self._slot, self._report = memory.settings[index], report
        self._slot.use(0)
        self._feed = KnotFeed(memory.knots[index], self.set_point)
        self._outer, self._due_s = OuterFeed(memory.followed[index]), due_s
        self._faults = FaultLog(self.supervision, report, config.drive.cycle_s)
        self._period_s = config.drive.cycle_s
        self._follow = self.follower.follow
        self._outer_cells = memory.outer[index]
        self._motor_deg = config.motor_encoder.degrees(1)
        encoder = config.load_encoder
        self._load_deg = math.nan if encoder.is_motor_encoder else encoder.degrees(1)
        self._limited = 0
        """Number of cycles with a limited correction when the last sample was taken."""
        self._changing = self._underrun = self._unfed = False
        self._doubt = ""
        """Last reported states of the compensation change, the stream underrun and the load loop."""
        self._pending: dict[CommandKind, int] = {}
        """Ids of the pending commands of `_MULTI_TURN_COMMANDS`."""
        self._motion_id = 0
        self._mode = MotionMode.HOLD
        self._turns_left = 0
        """Number of cycles left before the drive's time-out."""
        self._why = ""
        """Reason for stopping, if the supervision did not report one."""
        self.stop_reported = True
        """True if the axis is at rest and its stop was reported; False only in QUICK_STOPPED and LATCHED."""
        self._handlers: dict[CommandKind, Callable[[Command], None]] = {
            CommandKind.VERIFIED: self._verified,
            CommandKind.RELEASE: self._silence,
            CommandKind.HOME: self._silence,
            CommandKind.HOMED: self._verified,
            CommandKind.ENABLE: self._enable,
            CommandKind.DISABLE: self._disable,
            CommandKind.QUICK_STOP: self._quick_stop,
            CommandKind.RESET: self._reset,
            CommandKind.MOVE: self._move,
            CommandKind.JOG: self._jog,
            CommandKind.STOP: self._stop,
            CommandKind.STREAM_END: lambda _: self._feed.end(),
            CommandKind.CHANGE: self._change,
            CommandKind.FOLLOW: self._follow_outer,
            CommandKind.DRIVE_FAULT_RESET: lambda _: self.image.power.reset_fault(),
        }

    # ---------------------------------------------------------------- commands, between two cycles

    def command(self, command: Command) -> None:
        """Carries out a command, or refuses it and changes nothing; reports either to the service."""
        try:
            kind = CommandKind(command.kind)
            self.check(kind)
            self._handlers[kind](command)
        except HdbridgeError as error:
            self._report(EventKind.REFUSED, command.id, command.kind, str(error))
            return
        target = target_of(self.state, kind)
        assert target is not None
        if kind is CommandKind.DISABLE and target is AxisState.STOPPING:
            self._refuse_pending(kind, "another disable command has replaced it")
            self._pending[kind] = command.id
        elif kind is not CommandKind.ENABLE:
            self._done(command.id)
        self._enter(target)

    def check(self, kind: CommandKind) -> None:
        """Raises TransitionError if a command is not possible in the current state."""
        if target_of(self.state, kind) is None:
            raise TransitionError(refusal(self.config.name, self.state, kind))

    def begin_stream(self, command: Command, group: frozenset[int]) -> None:
        """Follows knots from the next cycle on, together with the other axes of ``group``.

        Raises InputError if the axis is in motion or the time-out is invalid.
        """
        self._feed.begin(command.j, command.a)
        self._motion_id = command.id
        self.group = group

    def stop(self) -> None:
        """Brakes to rest within the limits."""
        self.set_point.stop()

    def verification_lost(self) -> None:
        """Handles a bus failure, after which the drive must be verified again, even if lent."""
        self._why = "the bus went down while the axis was lent"
        self._transition(Trigger.VERIFICATION_LOST)

    def _done(self, id_: int) -> None:
        if id_:
            self._report(EventKind.DONE, id_, 0)

    def _transition(self, cause: Cause) -> None:
        """Makes the transition for ``cause``, if there is one in this state."""
        if (target := target_of(self.state, cause)) is not None:
            self._enter(target)

    def _enter(self, state: AxisState) -> None:
        """Enters a state: switches power off, quick-stops or ends motion, and answers waiting commands."""
        before = self.state
        if state is before:
            return
        self.state = state
        if state is AxisState.STOPPING and before is not AxisState.ENABLED:
            self._power_off()
        if state not in MAY_MOVE:
            self._end_motion()
        if state in STOPPED:
            self.cycle.quick_stop()
            self.stop_reported = False
        self._report(EventKind.STATE, 0, state)
        for kind, (during, done) in _MULTI_TURN_COMMANDS.items():
            if state is done:
                self._done(self._pending.pop(kind, 0))
            elif state is not during:
                stop = self.cycle.stopped
                self._refuse_pending(kind, str(stop) if stop is not None else self._why)

    def _refuse_pending(self, kind: CommandKind, why: str) -> None:
        if id_ := self._pending.pop(kind, 0):
            self._report(EventKind.REFUSED, id_, kind, why)

    def _end_motion(self) -> None:
        """Ends the motion: stops following set-points, and leaves the stream and its group."""
        self.cycle.command = None
        self._mode = MotionMode.HOLD
        self._break_group()
        self.set_point.reset(self.set_point.position_deg)

    def _break_group(self) -> None:
        """Leaves the group of a coordinated move, which the controller then stops."""
        if self.group:
            self.left_group, self.group = self.group, frozenset()

    def _turns(self, time_s: float) -> int:
        return math.ceil(time_s / self._period_s)

    # ---------------------------------------------------------------- command handlers

    def _verified(self, command: Command) -> None:
        self._seed(command)
        self.image.power.power_off()
        self.cycle.begin()

    def _seed(self, command: Command) -> None:
        if (node_id := self.cycle.monitor.restarted) is not None:
            raise TransitionError(
                f"{self.config.name}: node {node_id} has restarted since it was verified; verify it again: "
                f"{RESET}"
            )
        if not 0 <= command.k <= 0xFFFF:
            raise InputError(f"{self.config.name}: invalid statusword {command.k}; expected 16 bits")
        self.image.seed(command.i, command.j, command.k)

    def _silence(self, _: Command) -> None:
        self.cycle.silence()

    def _enable(self, command: Command) -> None:
        state = decode(command.k)
        if state is not State.SWITCH_ON_DISABLED:
            raise TransitionError(
                f"{self.config.name}: the drive is in '{state.value}', but it is enabled from 'switch on "
                f"disabled'; reset its fault ({RESET}), or disable it first"
            )
        self.image.check_target(command.i)
        self._seed(command)
        self.image.halt = False
        self.image.power.go(State.OPERATION_ENABLED)
        self._why = ""
        self._pending[CommandKind.ENABLE] = command.id
        rarest = max((each.every_cycles for each in self.config.channels.values()), default=0)
        self._turns_left = self._turns(2 * ENABLE_TIMEOUT_S) + 2 * rarest
        self.cycle.command = self._enabling
        self.cycle.begin()

    def _disable(self, _: Command) -> None:
        if self.state is AxisState.ENABLED:
            self.set_point.stop()
        elif self.state is AxisState.ENABLING:
            self._why = "it was disabled before it was enabled"

    def _quick_stop(self, _: Command) -> None:
        if self.state in (*MAY_MOVE, AxisState.LENT):
            self._why = "quick stop by command: latched"
        if self.state is AxisState.LENT:
            self.cycle.begin()  # the next RPDO overrides the controlword that the service sends by SDO

    def _reset(self, command: Command) -> None:
        quick_stopped = self.state is AxisState.QUICK_STOPPED
        if quick_stopped and not self.stop_reported:
            raise TransitionError(f"{self.config.name}: the axis is still stopping; wait until it is at rest")
        if self.state is AxisState.LATCHED and not command.i:
            raise TransitionError(
                f"{self.config.name}: boot and verify the drive again before this latch is released"
            )
        self.supervision.reset(verified=bool(command.i))
        if quick_stopped:
            self.cycle.begin()

    def _move(self, command: Command) -> None:
        velocity = None if math.isnan(command.b) else command.b
        acceleration = None if math.isnan(command.c) else command.c
        self.set_point.goto(command.a, velocity, acceleration)
        # A move to the current position ends within one cycle; its end is reported as well.
        self._motion_id, self._mode = command.id, MotionMode.GOTO

    def _jog(self, command: Command) -> None:
        self.set_point.jog(command.a, command.b)
        self._motion_id = command.id

    def _follow_outer(self, command: Command) -> None:
        self.set_point.follow()
        self._outer.begin(command.j, command.a, self._due_s(), self.set_point.position_deg)
        self._motion_id, self._mode = command.id, MotionMode.FOLLOW
        self.cycle.command = self._follow_gateway

    def _follow_gateway(self, feedback: Feedback) -> int | None:
        """Follows the gateway's set-points one period delayed, because the newest may not have arrived."""
        if self.set_point.mode is MotionMode.FOLLOW:
            aim = self._outer.at(self._due_s() - self._period_s)
            if aim is None:
                self._unfed = True
                self.set_point.stop()
            else:
                self.set_point.aim(aim, self._outer.spacing_s)
        return self._follow(feedback)

    def _stop(self, _: Command) -> None:
        if self.state is AxisState.ENABLED:
            self.set_point.stop()
        elif self.state is AxisState.ENABLING:
            self._why = "it was stopped before it was enabled"

    def _change(self, command: Command) -> None:
        setting = CompensationSetting.from_json(self._slot.get(command.i))
        self.follower.use(setting, moving=self.state in (AxisState.ENABLED, AxisState.STOPPING))
        self._slot.use(command.i)
        self._changing = self.follower.correction.changing
        if not self._changing:
            self._report(EventKind.CHANGED, command.id, 0)

    # ---------------------------------------------------------------- power

    def _power_off(self) -> None:
        self.cycle.command = None
        self._turns_left = self._turns(STOP_TIMEOUT_S)
        self.image.power.power_off()

    def _enabling(self, feedback: Feedback) -> int | None:
        """Holds position until every channel has a value, then follows from the actual position."""
        waiting = [each for each in self.image.channels if each.value is None]
        if waiting and waiting[0].lost:
            self._why = (
                f"{self.config.where(waiting[0].key)}: no plausible reading arrived "
                f"({waiting[0].why}); check the sensor, or leave the key out"
            )
            self._turns_left = 0
        if not waiting and feedback.fresh:
            self.follower.begin(feedback)
            self._underrun = False
            self.cycle.command = self._follow
        return None

    # ---------------------------------------------------------------- before and after each cycle

    def before(self) -> None:
        """Prepares the next cycle: feeds the next knots of a stream to the set-point."""
        refusal_ = self._feed.feed()
        if refusal_ is not None:
            self._report(EventKind.STREAM_REFUSED, self._motion_id, 0, refusal_)
            self._break_group()

    def after(self) -> None:
        """Evaluates the last cycle: reports faults and ended motions, and makes the resulting transitions."""
        self._faults.report()
        supervision = self.supervision
        if supervision.stop is not None:
            latched = supervision.reaction is Reaction.LATCH
            self._transition(Trigger.VERIFICATION_LOST if latched else Trigger.STOP_LATCHED)
        state = self.state
        if state is AxisState.ENABLED:
            self._after_motion()
        elif state is AxisState.ENABLING:
            if self.cycle.command is self._follow:
                self._transition(Trigger.POWERED)
            else:
                self._overdue(f"it did not reach 'operation enabled' within {2 * ENABLE_TIMEOUT_S:g} s")
        elif state is AxisState.STOPPING:
            self._after_stopping()
        elif not self.stop_reported:
            self._after_stop()

    def _after_motion(self) -> None:
        set_point = self.set_point
        mode = set_point.mode
        if mode is not self._mode:
            if mode is MotionMode.HOLD:
                self._report(EventKind.MOTION_ENDED, self._motion_id, self._mode)
            if self._mode is MotionMode.FOLLOW:
                self.cycle.command = self._follow
            if mode is not MotionMode.STREAM:
                if mode is not MotionMode.HOLD:
                    self._break_group()
                self.group = frozenset()
            self._mode = mode
        if self._unfed:
            self._unfed = False
            if not set_point.at_rest:
                words = "the set-points of the gateway ended in motion; it loses its power"
                self._report(EventKind.UNDERRUN, self._motion_id, 0, words)
            self._transition(Trigger.UNFED)
        if set_point.underrun is not self._underrun:
            self._underrun = set_point.underrun
            if self._underrun:
                self._report(EventKind.UNDERRUN, self._motion_id, 0)
        doubt = self.follower.loop_doubt
        if doubt != self._doubt:
            self._doubt = doubt
            self._report(EventKind.LOAD_LOOP, 0, int(bool(doubt)), doubt or "it acts again")
        if self._changing and not self.follower.correction.changing:
            self._changing = False
            self.follower.changed()
            self._report(EventKind.CHANGED, 0, 0)

    def _after_stopping(self) -> None:
        if self.cycle.command is not None:  # it brakes, and still has its power
            self._after_motion()
            if self.set_point.at_rest:
                self._power_off()
        elif self.image.power.state in _OFF:
            self._transition(Trigger.POWER_OFF)
        else:
            self._overdue(f"it did not switch power off within {STOP_TIMEOUT_S:g} s")

    def _overdue(self, what: str) -> None:
        self._turns_left -= 1
        if self._turns_left > 0:
            return
        if not self._why:
            state = self.image.power.state.value
            self._why = (
                f"{self.config.name}: the drive takes too long: {what}, it is in '{state}'; look at its "
                "enable input, its supply and its fault history"
            )
        self._transition(Trigger.OVERDUE)

    def _after_stop(self) -> None:
        """Reports a stop once the axis is at rest or the time-out has passed."""
        if self.cycle.stopping:
            return
        self.stop_reported = True
        stop = self.supervision.stop
        code = FAULT_INDEX[stop.fault] if stop is not None else NO_FAULT
        error = self.cycle.stopped
        explained = error is not None and error.hint == EXPLAINED_HINT
        text = error.text if error is not None else f"{self._why}{self.cycle.outcome}"
        self._report(EventKind.STOPPED, int(explained), code, text)

    # ---------------------------------------------------------------- the sample of a cycle

    def sample(self) -> tuple[float, ...]:
        """Returns the fields of `layout.Axis` for the cycle that has just ended."""
        image, feedback, follower = self.image, self.cycle.feedback, self.follower
        state, set_point, motor_deg = self.state, self.set_point, self._motor_deg
        position_deg = motor_deg * feedback.motor_counts
        stop = self.supervision.stop
        flags = _FRESH if feedback.fresh else 0
        reading0 = reading1 = received_s = math.nan
        if feedback.readings:
            flags, reading0, reading1 = _readings(flags, feedback.readings)
        if state is AxisState.ENABLED or state is AxisState.STOPPING:
            correction = follower.correction
            correction_arcsec, predicted_arcsec = correction.correction_arcsec, correction.predicted_arcsec
            target_deg, weight, loop_arcsec = follower.target_deg, correction.weight, follower.loop_arcsec
            limited = correction.limited
            if limited != self._limited:
                self._limited = limited
                flags |= _LIMITED
            if follower.compensating:
                flags |= _COMPENSATING
            if correction.memory_known:
                flags |= _MEMORY_KNOWN
            if set_point.at_rest:
                flags |= _AT_REST
            if self._changing:
                flags |= _CHANGING
            if self._underrun:
                flags |= _UNDERRUN
            if follower.loop_doubt:
                flags |= _DOUBTED
            if set_point.mode is _FOLLOW:
                received_s = self._outer.received_s
        else:
            flags |= _AT_REST
            target_deg = position_deg / self.config.gear.ratio
            correction_arcsec = predicted_arcsec = weight = loop_arcsec = 0.0
        return (
            state, set_point.mode, _POWER_INDEX[image.power.state],
            NO_FAULT if stop is None else FAULT_INDEX[stop.fault],
            feedback.statusword, flags,
            target_deg, motor_deg * feedback.demand_counts, position_deg,
            self._load_deg * feedback.load_counts,
            feedback.torque_permille * follower.sensed.torque_nm, set_point.velocity_deg_s,
            correction_arcsec, predicted_arcsec, loop_arcsec, weight, reading0, reading1,
            math.nan if self.cycle.silent else motor_deg * image.target_counts,
            received_s, *self._outer_cells.values(),
        )  # fmt: skip


def _readings(flags: int, readings: tuple[float | None, ...]) -> tuple[int, float, float]:
    """Returns the flags including those of the known channels, and both readings (NaN if unknown)."""
    known = [each if each is not None else math.nan for each in (*readings, None)[:2]]
    for value, bit in zip(known, (_KNOWN0, _KNOWN1), strict=True):
        if not math.isnan(value):
            flags |= bit
    return flags, known[0], known[1]
