"""The CiA-402 firmware of the simulated drive: power states, stopping, supervision, and the objects of 6000h.

The node calls ``advance`` once per period, and ``control`` through the controlword object; everything else
goes through the dictionary. The firmware does not read a clock but adds up the periods.
"""

from typing import Final

from hdbridge.cia301 import wrap_int32
from hdbridge.device.behaviour import Behaviour, Controlword
from hdbridge.device.dictionary import Abort, Dictionary, only, refusing
from hdbridge.device.emergency import Emergency, ErrorCode
from hdbridge.device.faults import Faults
from hdbridge.device.modes import (
    CyclicSynchronousPosition,
    Homing,
    InterpolatedPosition,
    Mode,
    ProfilePosition,
)
from hdbridge.device.motion import Machine, Motion
from hdbridge.device.powerstate import POWERED, Control, PowerStage, State, Status, next_state
from hdbridge.device.profile import Profile, stop

SLOW_DOWN_RAMP: Final = (1, 5)
QUICK_STOP_RAMP: Final = (2, 6)
STAY_STOPPED: Final = 5
"""Lowest option code of 605Ah that stays in QUICK STOP ACTIVE."""
WINDOW_OFF: Final = 0xFFFFFFFF

# The cyclic path uses module names because looking up an enum member in its class takes five times as long.
_ENABLED: Final = State.OPERATION_ENABLED
_QUICK_STOP_ACTIVE: Final = State.QUICK_STOP_ACTIVE
_HALT: Final = int(Control.HALT)
_FAULT_RESET: Final = int(Control.FAULT_RESET)
_ALWAYS: Final = Status.VOLTAGE_ENABLED | Status.REMOTE
_LIMIT: Final = int(Status.INTERNAL_LIMIT)
_REACHED: Final = int(Status.TARGET_REACHED)
_FOLLOWING_ERROR: Final = int(Status.MODE_13)
_REFERENCED: Final = int(Status.REFERENCED)


class _Braking:
    """Stop in progress: its ramp, and the state (None: unchanged) or mode that follows."""

    def __init__(self, ramp: Profile, then: State | None) -> None:
        self.ramp = ramp
        self.then = then
        self.begins_mode = False
        self.elapsed_s = 0.0

    @property
    def is_done(self) -> bool:
        return self.elapsed_s >= self.ramp.duration_s


class Firmware:
    """Firmware of one drive. ``state`` is its power state, ``motion`` the position of its axis."""

    def __init__(
        self,
        dictionary: Dictionary,
        machine: Machine,
        emergency: Emergency,
        faults: Faults | None = None,
        behaviour: Behaviour | None = None,
        stage: PowerStage | None = None,
    ) -> None:
        self._faults = faults or Faults()
        self._stage = stage or PowerStage()
        behaviour = behaviour or Behaviour()
        self._by_level = behaviour.controlword is Controlword.LEVEL
        self._status_delay_s = behaviour.status_delay_ms / 1000.0
        self._dictionary = dictionary
        self._emergency = emergency
        self.motion = Motion(dictionary, machine)
        self._homing = Homing(self.motion)
        modes: tuple[Mode, ...] = (
            Mode(self.motion),
            ProfilePosition(self.motion),
            self._homing,
            InterpolatedPosition(self.motion),
            CyclicSynchronousPosition(self.motion),
        )
        self._modes = {mode.number: mode for mode in modes}
        self._window = dictionary[0x6065, 0]
        self._window_time = dictionary[0x6066, 0]
        self._bind()
        self.reset()

    def reset(self) -> None:
        """Returns to the state after power-on; encoder positions and the home reference are kept."""
        self._braking: _Braking | None = None
        self._halted = False
        self._word = 0
        self._waits_for_rest = False
        self._awaits_power = False
        self._resetting = False
        self._stopped_itself = False
        """True in QUICK STOP ACTIVE without a command. A repeated controlword then ends this state only if
        the drive evaluates levels."""
        self._beyond_window_s = 0.0
        self._following_error = False
        self._error_code = 0
        self._mode = self._modes[0]
        self._old_status_s = 0.0
        """Time for which 6041h and 6061h still show the values from before a command."""
        self._old_statusword = self._old_mode = 0
        self.motion.limited = False
        self.motion.take_parameters()
        self.motion.take_actual_as_demand()
        self._limit_torque(self._dictionary.value(0x6072))
        self._power_off(State.SWITCH_ON_DISABLED)

    # ---------------------------------------------------------------- objects

    def _bind(self) -> None:
        motion, entry = self.motion, self._dictionary
        for key, read in {
            0x603F: lambda: self._error_code,
            0x6041: self.statusword,
            0x6061: lambda: self._old_mode if self._old_status_s > 0.0 else self._mode.number,
            0x6062: motion.demand_position,
            0x6063: lambda: wrap_int32(motion.motor_counts),
            0x6064: motion.actual_position,
            0x606B: lambda: self._velocity_sign() * round(motion.velocity_counts_s),
            0x606C: lambda: self._velocity_sign() * round(motion.machine.velocity_counts_s),
            0x6077: lambda: motion.machine.torque_permille,
            0x60F4: lambda: wrap_int32(motion.user(motion.demand_counts) - motion.user(motion.motor_counts)),
            0x60FC: lambda: wrap_int32(round(motion.demand_counts)),
            0x2100: lambda: round(10.0 * motion.machine.temperature_c),
            0x2101: lambda: round(1000.0 * motion.machine.load_torque_nm),
        }.items():
            if entry[key, 0].is_known:
                entry[key, 0].bind(read)
        entry[0x60E4, 1].bind(motion.load_position)
        entry[0x60E5, 1].bind(lambda: round(motion.load_velocity_counts_s))
        entry[0x6040, 0].follower = self.control
        entry[0x6072, 0].follower = self._limit_torque
        entry[0x6086, 0].guard = only(0)  # trapezoidal profiles
        entry[0x6060, 0].guard = refusing(self._lacks_mode)
        entry[0x6060, 0].follower = self._change_mode
        for index, sub in ((0x60C2, 1), (0x60C2, 2), (0x607E, 0)):
            entry[index, sub].guard = refusing(lambda _: self.state in POWERED, Abort.STATE)

    def _limit_torque(self, permille: int) -> None:
        self.motion.machine.torque_limit_permille = permille

    def _velocity_sign(self) -> int:
        return -1 if self._dictionary.value(0x607E) & 0x40 else 1

    def statusword(self) -> int:
        """Returns object 6041h."""
        return self._old_statusword if self._old_status_s > 0.0 else self._statusword()

    def _statusword(self) -> int:
        word = self._state_bits
        machine = self.motion.machine
        if self.motion.limited or abs(machine.torque_permille) >= machine.torque_limit_permille > 0.0:
            word |= _LIMIT
        if self._following_error:
            word |= _FOLLOWING_ERROR
        if self._homing.referenced:
            word |= _REFERENCED
        if self._braking is not None:
            return word
        if self.state is _ENABLED and not self._halted:
            return word | self._mode.status()
        if self._halted or self.state is State.QUICK_STOP_ACTIVE:
            word |= _REACHED  # stopped, as commanded
        return word

    def _delay_status(self) -> None:
        """Keeps 6041h and 6061h at their current values for the delay after a command."""
        if self._status_delay_s:
            if self._old_status_s <= 0.0:
                self._old_statusword, self._old_mode = self._statusword(), self._mode.number
            self._old_status_s = self._status_delay_s

    def _lacks_mode(self, mode: int) -> bool:
        has = self._dictionary.value(0x6502)
        return mode not in self._modes or bool(mode and has and not has >> mode - 1 & 1)

    def _change_mode(self, number: int) -> None:
        if self._mode.number == number:
            return
        self._delay_status()
        self._mode = self._modes[number]
        if self.state is State.OPERATION_ENABLED and self._braking is None and self.motion.velocity_counts_s:
            self._brake(SLOW_DOWN_RAMP[0], None)
        if self._braking is None:
            self._enter_mode()
        else:
            self._braking.begins_mode = True

    def _enter_mode(self) -> None:
        self.motion.limited = False
        self.motion.preload_target()
        self._mode.enter()

    # ---------------------------------------------------------------- power states

    def _set_state(self, state: State) -> None:
        self.state = state
        self._state_bits = state.value | _ALWAYS

    def control(self, word: int) -> None:
        """Evaluates a controlword; a repeated controlword is ignored unless the drive evaluates levels."""
        if word == self._word and not self._waits_for_rest and not self._by_level:
            return
        if word != self._word:
            self._delay_status()
        elif self._stopped_itself and not self._by_level:
            return
        rising = word & ~self._word
        self._word = word
        self._waits_for_rest = self._stopped_itself = False
        if self.state is State.FAULT:
            if rising & _FAULT_RESET:
                self._resetting = True
                self._stage.reset()
                self._finish_reset()
            return
        wanted = next_state(self.state, word)
        if self._awaits_power and wanted is not State.OPERATION_ENABLED:
            self._power_off(self.state)
        if wanted is not self.state:
            self._transition(wanted)
        elif self.state is State.OPERATION_ENABLED and self._braking is not None and self._braking.then:
            self._waits_for_rest = True  # leaving: the same word is evaluated again at standstill
        elif self.state is State.OPERATION_ENABLED:
            self._halt_or_go(bool(word & _HALT))
            if not word & _HALT:
                self._mode.control(word, rising)

    def _transition(self, wanted: State) -> None:
        option = self._dictionary.value
        leaving = self.state
        if leaving is State.OPERATION_ENABLED:
            if wanted is State.QUICK_STOP_ACTIVE:
                self._quick_stop()
            elif wanted is State.SWITCHED_ON:
                self._ramp_down_to(wanted, option(0x605C))
            elif wanted is State.READY_TO_SWITCH_ON:
                self._ramp_down_to(wanted, option(0x605B))
            else:
                self._power_off(wanted)
        elif wanted is State.OPERATION_ENABLED:
            if leaving is State.QUICK_STOP_ACTIVE:
                self._leave_quick_stop()
            elif not self._awaits_power:
                self._set_state(State.SWITCHED_ON)
                self._awaits_power = True
                self._stage.switch(True)
                self._finish_power_up()
        else:
            self._power_off(wanted)

    def _finish_power_up(self) -> None:
        if self._stage.is_on:
            self._awaits_power = False
            self.motion.take_actual_as_demand()
            self._operate()

    def _operate(self) -> None:
        self._set_state(State.OPERATION_ENABLED)
        self._halted = bool(self._word & _HALT)
        self._following_error = False
        self._beyond_window_s = 0.0
        self._enter_mode()

    def _power_off(self, state: State) -> None:
        self._stage.switch(False)
        self._braking = None
        self._halted = self._awaits_power = self._stopped_itself = False
        self._set_state(state)

    def _leave_quick_stop(self) -> None:
        if self._dictionary.value(0x605A) < STAY_STOPPED:
            return
        if self._braking is not None and not self._by_level:
            self._waits_for_rest = True  # the same word is evaluated again at standstill
            return
        self._braking = None
        self._operate()

    def _quick_stop(self) -> None:
        option = self._dictionary.value(0x605A)
        if option == 0:
            self._power_off(State.SWITCH_ON_DISABLED)
            return
        self._set_state(State.QUICK_STOP_ACTIVE)
        self._brake(option, None if option >= STAY_STOPPED else State.SWITCH_ON_DISABLED)

    def _ramp_down_to(self, state: State, option: int) -> None:
        if option == 0:
            self._power_off(state)
        elif self._braking is None or self._braking.then is None:
            self._brake(option, state)

    def _halt_or_go(self, halt: bool) -> None:
        if halt and not self._halted:
            self._halted = True
            self._brake(self._dictionary.value(0x605D), None)
        elif self._halted and not halt:
            self._halted = False
            self._braking = None
            self._mode.resume()

    def _brake(self, option: int, then: State | None) -> None:
        """Stops on the ramp selected by an option code of 605Ah to 605Eh, then enters ``then``."""
        value = self._dictionary.value
        deceleration: float = value(0x60C6)  # 'current limit' and 'voltage limit' brake with maximum torque
        if option in SLOW_DOWN_RAMP:
            deceleration = min(value(0x6084), deceleration)
        elif option in QUICK_STOP_RAMP:
            deceleration = min(value(0x6085), deceleration)
        if self._faults.deceleration_counts_s2 is not None:
            deceleration = self._faults.deceleration_counts_s2
        motion = self.motion
        self._braking = _Braking(stop(motion.demand_counts, motion.velocity_counts_s, deceleration), then)
        self._finish_braking()

    def _finish_braking(self) -> None:
        braking = self._braking
        if braking is not None and braking.is_done:
            self._braking = None
            self.motion.velocity_counts_s = 0.0
            if braking.then is not None:
                self._power_off(braking.then)
            elif braking.begins_mode:
                self._enter_mode()

    # ---------------------------------------------------------------- errors

    def fault(self, code: int, additional: bytes = b"") -> None:
        """Reports a malfunction, stops the axis as selected by 605Eh, and ends in FAULT."""
        self._emergency.occur(code, additional)
        self._error_code = code
        if self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            return
        option = self._dictionary.value(0x605E)
        if self.state not in POWERED or option == 0:
            self._power_off(State.FAULT)
            return
        self._halted = False
        self._set_state(State.FAULT_REACTION_ACTIVE)
        self._brake(option, State.FAULT)

    def power_cut(self) -> None:
        """Switches the power stage off, as by an opening enable input. An active fault stays active."""
        in_fault = self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
        self._power_off(State.FAULT if in_fault else State.SWITCH_ON_DISABLED)

    def connection_lost(self, code: int) -> None:
        """Reacts to the loss of the master as selected by 6007h; ``code`` is the EMCY code of the loss."""
        option = self._dictionary.value(0x6007)
        is_powered = self.state in POWERED or self._awaits_power
        if option == 1 and is_powered:
            self.fault(code)
        elif (option == 2 and is_powered) or (option == 3 and self._awaits_power):
            self.power_cut()
        elif option == 3 and self.state is State.OPERATION_ENABLED:
            self._stopped_itself = True
            self._quick_stop()

    @property
    def follows_the_bus(self) -> bool:
        """True if the axis needs cyclic set-points: enabled, or about to be, in a cyclic mode."""
        enabled = self.state is State.OPERATION_ENABLED or self._awaits_power
        return enabled and isinstance(self._mode, CyclicSynchronousPosition)

    def _judge_stage(self) -> None:
        """Reacts without a ramp to a failure of the power stage, or completes a pending request."""
        stage = self._stage
        if stage.error_code and self.state is not State.FAULT:
            self._emergency.occur(stage.error_code, stage.error_details)
            self._error_code = stage.error_code
            self._power_off(State.FAULT)
        elif self._resetting:
            self._finish_reset()
        elif self._awaits_power:
            self._finish_power_up()

    def _finish_reset(self) -> None:
        if self._stage.is_resetting:
            return
        self._resetting = False
        if self._stage.error_code:
            return  # the cause persists
        self._error_code = 0
        self._following_error = False
        self._emergency.clear_all()
        self._power_off(State.SWITCH_ON_DISABLED)

    # ---------------------------------------------------------------- time

    def advance(self, period_s: float) -> None:
        """Runs the axis for one period."""
        if self._old_status_s > 0.0:
            self._old_status_s -= period_s
        stage = self._stage
        if stage.error_code or self._resetting or self._awaits_power:
            self._judge_stage()
        motion, braking = self.motion, self._braking
        if self.state not in POWERED:
            motion.coast(period_s)
            return
        if braking is not None:
            braking.elapsed_s += period_s
            demand, velocity = braking.ramp.at(braking.elapsed_s)
        elif self.state is _ENABLED and not self._halted:
            demand, velocity = self._mode.step(period_s)
        else:
            demand, velocity = motion.demand_counts, 0.0
        motion.follow(demand, velocity, period_s)
        if braking is not None:
            self._finish_braking()
        else:
            self._mode.observe(period_s)
        self._watch_following_error(period_s)

    def _watch_following_error(self, period_s: float) -> None:
        if self.state is not _ENABLED and self.state is not _QUICK_STOP_ACTIVE:
            return
        window = self._window.value
        error = abs(self.motion.demand_counts - self.motion.motor_counts)
        if window == WINDOW_OFF or error <= window:
            self._beyond_window_s = 0.0
            return
        self._beyond_window_s += period_s
        if self._beyond_window_s * 1000.0 > self._window_time.value:
            self._following_error = True
            self.fault(ErrorCode.FOLLOWING_ERROR)
