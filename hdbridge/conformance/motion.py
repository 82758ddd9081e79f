"""Checks of CiA 402 that need power and small motions: states, option codes, moves, cyclic targets,
homing.
"""

import struct
from collections.abc import Callable
from typing import Final, Self

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.drive import MODES
from hdbridge.conformance.steps import control, has_bits, holds, parametrised, reads, reset_node, stays, waits
from hdbridge.conformance.tester import (
    ENABLING,
    Decorator,
    NodeTester,
    NotApplicableError,
    Table,
    expedited,
    pack,
    state_name,
)
from hdbridge.drive.states import State, decode

CHECKS: Final = Table(drives=True, moves=True)
check: Final = CHECKS.check
_STATES: Final = "CiA 402-2, finite state automaton"
_OPTIONS: Final = "CiA 402-2, objects 605Ah to 605Eh, 6007h"
_PP: Final = "CiA 402-2, profile position mode"
_CSP: Final = "CiA 402-2, cyclic synchronous position mode"
_HM: Final = "CiA 402-2, homing mode"
_REACHED: Final = 1 << 10
_LIMIT: Final = 1 << 11
_BIT_12: Final = 1 << 12
_BIT_13: Final = 1 << 13
_DISABLED: Final = State.SWITCH_ON_DISABLED
_READY: Final = State.READY_TO_SWITCH_ON
_SWITCHED_ON: Final = State.SWITCHED_ON
_ENABLED: Final = State.OPERATION_ENABLED
_STOPPED: Final = State.QUICK_STOP_ACTIVE
_FAULT: Final = State.FAULT
_CYCLE_S: Final = 0.01
_STOP_S: Final = 0.5
"""Maximum time from a stop command to standstill."""


# ---------------------------------------------------------------- position and power state


def _position(t: NodeTester) -> int:
    return t.read(0x6064, signed=True)


def _stands(t: NodeTester, duration_s: float = 0.1) -> None:
    """Fails if the axis moves by more than a tenth of the test distance."""
    start, end_s = _position(t), t.now + duration_s
    while t.now < end_s:
        t.wait(0.01)
        moved = abs(_position(t) - start)
        t.true(moved <= max(2.0, 0.1 * t.travel), f"the axis moves: {moved} units", "standstill")


def _moved_at_most(t: NodeTester, before: int, most: float, now: int | None = None) -> None:
    """Fails if the axis is further than ``most`` from ``before``; ``now`` is its position, if known."""
    moved = abs((_position(t) if now is None else now) - before)
    t.true(moved <= most, f"the axis moved by {moved}", "standstill")


def _select(t: NodeTester, mode: int) -> None:
    t.need(t.read(0x6502) >> mode - 1 & 1, f"the drive has no {MODES[mode]} mode (6502h)")
    t.write(0x6060, 0, mode, 1)
    end_s = t.now + t.timing.power_s
    while t.read(0x6061, signed=True) != mode:
        t.true(t.now < end_s, f"6061h = {t.read(0x6061, signed=True)}", mode)
        t.wait(0.01)


def _some_mode(t: NodeTester) -> int:
    has = t.read(0x6502)
    for mode in (1, 8, 7, 6):
        if has >> mode - 1 & 1:
            return mode
    raise NotApplicableError("the drive has no position mode (6502h)")


def _bring(t: NodeTester, state: State, mode: int | None = None) -> None:
    """Brings the drive to a power state, at rest."""
    mode = _some_mode(t) if mode is None else mode
    t.disable()
    _select(t, mode)
    if state is _STOPPED:
        t.require(0x605A)
        t.write(0x605A, 0, 6, 2)
    if state is _FAULT:
        _fault_when_lost(t)
        t.be_supervised(300)
        _enable_and_beat(t)
        _lose_master(t)
        return
    words = (*ENABLING, (_STOPPED, 0x02))
    for reached, word in words if state is not _DISABLED else ():
        t.control(word)
        t.reaches(reached)
        if reached is state:
            return


def _fault_when_lost(t: NodeTester) -> None:
    """Makes the loss of the master a fault (6007h = 1)."""
    t.require(0x6007)
    t.write(0x6007, 0, 1, 2)


def _enable_and_beat(t: NodeTester) -> None:
    """Enables the drive, and begins its supervision of the tester with a heartbeat."""
    t.walk()
    t.beat()


def _lose_master(t: NodeTester, *states: State) -> None:
    """Waits until the drive has lost the tester's heartbeat and reached one of the states, a fault by
    default.
    """
    t.wait(0.35)
    t.reaches(*(states or (_FAULT,)))


def _reset_fault(t: NodeTester, word: int = 0x80) -> None:
    t.control(word)
    t.reaches(_DISABLED)


# ---------------------------------------------------------------- transitions


_in = parametrised(_bring)


@parametrised
def _leads(t: NodeTester, word: int, state: State) -> None:
    """A controlword leads to a state without motion."""
    before = _position(t)
    t.control(word)
    t.reaches(state)
    _moved_at_most(t, before, t.travel)


CHECKS.rows(
    _STATES,
    *((f"402.transition.{number}",
       f"Transition {number.split('.')[0]}: {command} leads from {state.value} to {then.value}",
       _in(state), _leads(word, then))
      for number, state, word, command, then in (
          ("2", _DISABLED, 0x06, "Shutdown", _READY),
          ("3", _READY, 0x07, "Switch on", _SWITCHED_ON),
          ("3+4", _READY, 0x0F, "Switch on and enable operation", _ENABLED),
          ("4", _SWITCHED_ON, 0x0F, "Enable operation", _ENABLED),
          ("5", _ENABLED, 0x07, "Disable operation", _SWITCHED_ON),
          ("6", _SWITCHED_ON, 0x06, "Shutdown", _READY),
          ("8", _ENABLED, 0x06, "Shutdown", _READY),
          ("9", _ENABLED, 0x00, "Disable voltage", _DISABLED),
          ("10", _SWITCHED_ON, 0x00, "Disable voltage", _DISABLED),
          ("10.quick-stop", _SWITCHED_ON, 0x02, "Quick stop", _DISABLED),
          ("12", _STOPPED, 0x00, "Disable voltage", _DISABLED),
          ("16", _STOPPED, 0x0F, "Enable operation", _ENABLED),
          ("15", _FAULT, 0x80, "Fault reset", _DISABLED))),
    *((f"402.no-transition.{name}", f"{command} changes nothing in {state.value}", _in(state), control(word),
       stays(state))
      for name, state, word, command in (
          ("disabled.switch-on", _DISABLED, 0x07, "Switch on"),
          ("disabled.enable", _DISABLED, 0x0F, "Enable operation"),
          ("switched-on.repeated", _SWITCHED_ON, 0x07, "Repeated switch on"),
          ("enabled.repeated", _ENABLED, 0x0F, "Repeated enable operation"),
          ("stopped.shutdown", _STOPPED, 0x06, "Shutdown"),
          ("stopped.repeated", _STOPPED, 0x02, "Repeated quick stop"),
          ("fault.disable-voltage", _FAULT, 0x00, "Disable voltage"),
          ("fault.shutdown", _FAULT, 0x06, "Shutdown"),
          ("fault.switch-on", _FAULT, 0x07, "Switch on"),
          ("fault.enable", _FAULT, 0x0F, "Enable operation"),
          ("fault.quick-stop", _FAULT, 0x02, "Quick stop"))),
)  # fmt: skip


@check(
    "402.fault.reset.edge",
    "A fault is reset by a rising edge of bit 7, not while bit 7 is held", _STATES,
    _in(_FAULT), control(0x00),
)  # fmt: skip
def _(t: NodeTester) -> None:
    _reset_fault(t)
    # The last controlword before the second fault already sets bit 7, so no rising edge follows the fault.
    t.control(0x06)
    t.reaches(_READY)
    t.control(0x0F)
    t.reaches(_ENABLED)
    t.beat()
    t.control(0x8F)
    t.stays(_ENABLED, 0.0)
    _lose_master(t)
    t.control(0x8F)
    t.stays(_FAULT, 0.1)


CHECKS.rows(
    _STATES,
    ("402.fault.reset.again", "A second fault is reset by another rising edge of bit 7", _in(_FAULT),
     _reset_fault, _enable_and_beat, _lose_master, lambda t: _reset_fault(t, 0x8F)),
    ("402.fault.reset.enables-nothing", "A fault reset with the bits of enable operation does not enable",
     _in(_FAULT), lambda t: _reset_fault(t, 0x8F), control(0x0F), stays(_DISABLED, 0.1)),
    ("402.fault.emergency", "A fault is reported by EMCY with its code", _in(_FAULT),
     lambda t: t.true(0x8130 in t.emergencies(), f"EMCY codes {t.emergencies()}", "8130h")),
    ("402.fault.emergency.reset", "The fault reset is reported by EMCY 0000h", _in(_FAULT),
     lambda t: t.equal(t.emergencies_after(0.05, lambda: _reset_fault(t))[-1:], [0], "last EMCY code")),
    ("402.fault.register", "1001h is not 0 during a fault, and 0 after its reset", _in(_FAULT),
     reads(0x1001, 0, bool, "bit 0 during the fault"), _reset_fault, waits(0.05), holds(0x1001, 0, 0)),
)  # fmt: skip
CHECKS.rows(
    "CiA 402-2, object 603Fh",
    ("402.fault.code", "603Fh is the code of the fault", 0x603F, _in(_FAULT), holds(0x603F, 0, 0x8130, 4)),
    ("402.fault.code.reset", "603Fh is 0 after the fault reset", 0x603F, _in(_FAULT), _reset_fault,
     holds(0x603F, 0, 0)),
)  # fmt: skip


# ---------------------------------------------------------------- option codes


@parametrised
def _lost_master(t: NodeTester, code: int, *states: State) -> None:
    mode = _some_mode(t)
    t.disable()
    _select(t, mode)
    t.write(0x6007, 0, code, 2)
    t.write(0x1029, 1, 1, 1) if t.has(0x1029, 1) else None
    t.be_supervised(300)
    _enable_and_beat(t)
    _lose_master(t, *states)
    if not code:
        t.stays(_ENABLED, 0.1)


CHECKS.rows(
    _OPTIONS,
    *((f"402.option.6007.{code}", f"6007h = {code}: a lost heartbeat {text}", 0x6007,
       _lost_master(code, *states))
      for code, text, *states in (
          (0, "changes nothing", _ENABLED), (1, "leads to a fault", _FAULT),
          (2, "disables the voltage", _DISABLED), (3, "leads to a quick stop", _STOPPED, _DISABLED))),
)  # fmt: skip


def _stopping(index: int, code: int, word: int, state: State, name: str) -> None:
    text = f"{index:04X}h = {code}: {name} during a move leads to {state.value}"

    @check(f"402.option.{index:04X}.{code}", text, _OPTIONS, index)
    def _(t: NodeTester) -> None:
        before = t.read(index, signed=True)
        _enable_slowly(t)
        _set_if_supported(t, index, code, before, 2)
        target = _begin_move(t, 4)
        t.control(word)
        t.reaches(state)
        t.wait(_STOP_S)
        _stands(t)
        t.true(_position(t) != target, "the move was completed", "a stop before the target")
        t.stays(state)


def _set_if_supported(t: NodeTester, index: int, value: int, before: int, size: int) -> None:
    """Sets an object whose values are optional; ends the check as not applicable if the node refuses."""
    if value != before:
        answer = t.answer(expedited(index, 0, pack(value, size)))
        t.need(answer[0] != 0x80, f"{index:04X}h = {value} is not supported")
        t.put(index, 0, before, size)
        t.write(index, 0, value, size)


for _index, _codes, _word, _state, _name in (
    (0x605A, (0, 1, 2), 0x02, _DISABLED, "quick stop"),
    (0x605A, (5, 6), 0x02, _STOPPED, "quick stop"),
    (0x605B, (0, 1), 0x06, _READY, "shutdown"),
    (0x605C, (0, 1), 0x07, _SWITCHED_ON, "disable operation"),
    (0x605D, (1, 2), 0x10F, _ENABLED, "halt"),
):
    for _code in _codes:
        _stopping(_index, _code, _word, _state, _name)


def _reaction(code: int) -> None:
    text = f"605Eh = {code}: a fault during a move leads to fault, at rest"

    @check(f"402.option.605E.{code}", text, _OPTIONS, 0x605E, 0x6007)
    def _(t: NodeTester) -> None:
        before = t.read(0x605E, signed=True)
        _select_slowly(t)
        _fault_when_lost(t)
        _set_if_supported(t, 0x605E, code, before, 2)
        t.be_supervised(300)
        _enable_and_beat(t)
        _begin_move(t, 8)
        _lose_master(t)
        t.wait(_STOP_S)
        _stands(t)


for _code in (0, 1, 2):
    _reaction(_code)

# ---------------------------------------------------------------- profile position


def _select_slowly(t: NodeTester) -> None:
    """Selects profile position mode, at a velocity of at most one test distance in 0.2 s."""
    t.disable()
    _select(t, 1)
    t.require(0x6081)
    t.write(0x6081, 0, min(5 * t.travel, t.read(0x6081)), 4)


def _enable_slowly(t: NodeTester) -> None:
    _select_slowly(t)
    t.walk()


def _pp(name: str, text: str) -> Decorator:
    """Decorates a check that begins with the drive enabled in profile position mode."""
    return check(f"402.pp.{name}", text, _PP, _enable_slowly)


def _direction(t: NodeTester, distances: int) -> int:
    """Returns 1 or -1, the direction in which the software limits leave room for this many test distances."""
    if not t.has(0x607D, 1):
        return 1
    low, high = (t.read(0x607D, sub, signed=True) for sub in (1, 2))
    reach = _position(t) + distances * t.travel
    return 1 if not low < high or reach < high else -1


def _set_point(t: NodeTester, target: int, extra: int = 0) -> None:
    t.put(0x607A, 0, target, 4)
    t.control(0x0F)
    t.control(0x1F | extra)


def _ahead(t: NodeTester, distances: int) -> int:
    """Returns the position that is this many test distances away, in the direction with room."""
    return _position(t) + _direction(t, distances) * distances * t.travel


def _begin_move(t: NodeTester, distances: int) -> int:
    """Begins a move of ``distances`` test distances; returns its target once the axis moves."""
    start, target = _position(t), _ahead(t, distances)
    _set_point(t, target)
    end_s = t.now + 2.0
    while abs(_position(t) - start) < 0.2 * t.travel:
        t.true(t.now < end_s, "the axis does not move", "a move to the new set-point")
        t.wait(0.005)
    t.need(abs(_position(t) - target) > 0.5 * t.travel, "the move is over before anything can be done")
    return target


def _window(t: NodeTester) -> float:
    return max(t.read(0x6067) if t.has(0x6067) else 0, 0.05 * t.travel, 3)


def _short_of(t: NodeTester, target: int) -> None:
    """Fails if the axis is at the target."""
    t.true(abs(_position(t) - target) > _window(t), "the move was completed", "a stop before the target")


def _limited(t: NodeTester, here: int, side: int, distance: int) -> Callable[[int], None]:
    """Sets the software limits (607Dh) to ``distance`` ahead of ``here`` and three test distances behind it.

    Returns a function that fails for a position beyond the limit.
    """
    edge = here + side * distance
    for sub, limit in enumerate(sorted((here - side * 3 * t.travel, edge)), start=1):
        t.write(0x607D, sub, limit, 4)

    def within(position: int) -> None:
        beyond = side * (position - edge)
        t.true(beyond <= _window(t), f"{beyond} units beyond the limit", "the limit")

    return within


def _arrives(t: NodeTester, target: int) -> None:
    """Waits until the drive reports target reached and the axis is at the target; fails on time-out."""
    end_s = t.now + 10.0
    while not t.read(0x6041) & _REACHED or abs(_position(t) - target) > _window(t):
        if t.now > end_s:
            t.fail(f"position {_position(t)}, statusword {t.read(0x6041):04X}h", f"{target}, target reached")
        t.wait(0.01)


@check("402.enable.still", "Enabling does not move the axis", _STATES)
def _(t: NodeTester) -> None:
    mode = _some_mode(t)
    t.disable()
    before = _position(t)
    _bring(t, _ENABLED, mode)
    _stands(t, 0.3)
    _moved_at_most(t, before, 0.5 * t.travel)


_begins = parametrised(_begin_move)


def _put_target(t: NodeTester) -> None:
    t.put(0x607A, 0, _ahead(t, 3), 4)


_stands_long = parametrised(_stands)(0.3)
CHECKS.rows(
    _PP,
    ("402.pp.move", "A new set-point is reached", _enable_slowly, lambda t: _arrives(t, _begin_move(t, 2))),
    ("402.pp.acknowledge", "Bit 12 acknowledges a new set-point", _enable_slowly,
     has_bits(0x6041, _BIT_12, 0, "bit 12 before the set-point"), _begins(2),
     has_bits(0x6041, _BIT_12, _BIT_12, "bit 12 while bit 4 of the controlword is 1")),
    ("402.pp.acknowledge.end", "Bit 12 falls when bit 4 of the controlword falls", _enable_slowly,
     _begins(2), control(0x0F), waits(0.05), has_bits(0x6041, _BIT_12, 0, "bit 12")),
    ("402.pp.target-alone", "A target without a new set-point moves nothing", _enable_slowly, _put_target,
     control(0x0F), _stands_long),
    ("402.pp.stale", "A target written before enabling moves nothing", _select_slowly, _put_target,
     NodeTester.walk, _stands_long),
)  # fmt: skip


@_pp("reached", "Target reached is 0 during a move and 1 after it")
def _(t: NodeTester) -> None:
    target = _begin_move(t, 3)
    t.equal(t.read(0x6041) & _REACHED, 0, "bit 10 in motion")
    _arrives(t, target)


@_pp("held", "Holding bit 4 does not start a second move")
def _(t: NodeTester) -> None:
    target = _begin_move(t, 2)
    _arrives(t, target)
    t.put(0x607A, 0, 2 * _position(t) - target + _direction(t, 2) * t.travel, 4)
    t.control(0x1F)
    _stands(t, 0.3)


@_pp("relative", "A relative set-point is added to the previous set-point")
def _(t: NodeTester) -> None:
    first = _begin_move(t, 1)
    _arrives(t, first)
    distance = _direction(t, 2) * t.travel
    _set_point(t, distance, 0x40)
    t.wait(0.02)
    _arrives(t, first + distance)


@_pp("again", "A set-point at the present position is acknowledged and reached")
def _(t: NodeTester) -> None:
    target = _begin_move(t, 1)
    _arrives(t, target)
    _set_point(t, target)
    t.wait(0.05)
    t.equal(t.read(0x6041) & _BIT_12, _BIT_12, "bit 12")
    _arrives(t, target)


def _there_and_back(t: NodeTester, extra: int) -> tuple[int, int]:
    """Sends a second set-point, which leads back to the start, during the first move.

    Returns the largest distance from the start, and the distance of the first set-point.
    """
    _enable_slowly(t)
    start = _position(t)
    first = _begin_move(t, 3)
    _set_point(t, start, extra)
    farthest, end_s, came_back = 0, t.now + 10.0, False
    while not came_back:
        t.true(t.now < end_s, f"position {_position(t)}", f"{start}, the second set-point")
        distance = abs(_position(t) - start)
        farthest = max(farthest, distance)
        came_back = farthest > 0.2 * t.travel and distance <= _window(t) and bool(t.read(0x6041) & _REACHED)
        t.wait(0.005)
    return farthest, abs(first - start)


@check("402.pp.queue", "A set-point during a move is executed after it", _PP)
def _(t: NodeTester) -> None:
    farthest, first = _there_and_back(t, 0)
    t.true(farthest >= first - 2 * _window(t), f"the axis turned back at {farthest}", f"{first}")


@check("402.pp.immediately", "With bit 5 a set-point during a move is executed at once", _PP)
def _(t: NodeTester) -> None:
    farthest, first = _there_and_back(t, 0x20)
    t.true(farthest < 0.9 * first, f"the axis turned back at {farthest}", f"clearly before {first}")


@_pp("velocity", "A move is not faster than the profile velocity")
def _(t: NodeTester) -> None:
    speed = t.read(0x6081)
    start, begun_s = _position(t), t.now
    target = _ahead(t, 4)
    _set_point(t, target)
    _arrives(t, target)
    duration_s = t.now - begun_s
    shortest_s = max(0.0, abs(target - start) - _window(t)) / speed
    t.true(duration_s > 0.9 * shortest_s, f"{duration_s:.3f} s", f"at least {shortest_s:.3f} s")


@_pp("halt", "Halt stops a move, and bit 10 is 1 at rest")
def _(t: NodeTester) -> None:
    target = _begin_move(t, 4)
    t.control(0x11F)
    t.wait(_STOP_S)
    _stands(t)
    _short_of(t, target)
    t.equal(t.read(0x6041) & _REACHED, _REACHED, "bit 10 at rest")
    t.stays(_ENABLED)


@_pp("halt.end", "The move continues when halt ends")
def _(t: NodeTester) -> None:
    target = _begin_move(t, 4)
    t.control(0x11F)
    t.wait(_STOP_S)
    t.control(0x1F)
    _arrives(t, target)


@check("402.pp.limit", "A set-point beyond 607Dh leads at most to the limit", _PP, (0x607D, 1))
def _(t: NodeTester) -> None:
    _select_slowly(t)
    start, side = _position(t), _direction(t, 3)
    within = _limited(t, start, side, t.travel)
    t.walk()
    _set_point(t, start + side * 3 * t.travel)
    for _ in range(100):
        within(_position(t))
        t.wait(0.01)


def _ends_the_move(name: str, text: str, act: Callable[[NodeTester], None]) -> None:
    @check(f"402.pp.ends.{name}", text, _PP)
    def _(t: NodeTester) -> None:
        _enable_slowly(t)
        target = _begin_move(t, 5)
        act(t)
        t.wait(_STOP_S)
        _short_of(t, target)
        _stands(t)
        t.nmt(NmtCommand.START)
        _stands(t)


def _resets(t: NodeTester) -> None:
    reset_node(t)
    t.reaches(_DISABLED)


_ends_the_move("disable-voltage", "Disable voltage ends a move", lambda t: t.control(0x00))
_ends_the_move(
    "mode", "Another mode ends a move", lambda t: t.put(0x6060, 0, 6 if t.read(0x6502) & 0x20 else 8, 1)
)
_ends_the_move("reset", "NMT reset node ends a move, and power is off", _resets)


# ---------------------------------------------------------------- cyclic synchronous position


class _Stream:
    """Cyclic master: RPDO with controlword and target, SYNC, TPDO with statusword and position."""

    def __init__(self, t: NodeTester) -> None:
        self.t = t
        t.disable()
        _select(t, 8)
        if t.has(0x60C2, 1):
            t.write(0x60C2, 2, -3, 1)
            t.write(0x60C2, 1, round(1000 * _CYCLE_S), 1)
        self.tpdo = t.map_pdo(0x1800, ((0x6041, 0, 16), (0x6064, 0, 32)), 1)
        self.rpdo = t.map_pdo(0x1400, ((0x6040, 0, 16), (0x607A, 0, 32)), 1)
        self.word, self.target = 0x00, _position(t)
        self.status, self.position = 0, self.target
        self._next_s = t.now
        t.nmt(NmtCommand.START)

    @classmethod
    def running(cls, t: NodeTester) -> Self:
        """Returns the stream of an axis in motion."""
        stream = cls(t)
        stream.enable()
        stream.move()
        return stream

    def cycle(self, count: int = 1, step: float = 0.0) -> None:
        """Runs cycles in which the target advances by ``step``."""
        t, start = self.t, self.target
        for place in range(1, count + 1):
            since = t.mark()
            self.target = start + round(place * step)
            t.send(self.rpdo, struct.pack("<Hi", self.word, self.target))
            t.sync()
            self._next_s = max(self._next_s + _CYCLE_S, t.now)
            t.wait(self._next_s - t.now)
            for frame in t.heard(self.tpdo, since):
                self.status, self.position = struct.unpack("<Hi", frame.data)

    def enable(self) -> None:
        """Walks to OPERATION ENABLED with the target at the actual position."""
        self.t.powered = True
        for state, word in ENABLING:
            self.word = word
            end_s = self.t.now + self.t.timing.power_s
            while decode(self.status) is not state:
                self.t.true(self.t.now < end_s, state_name(self.status), state.value)
                self.cycle()
                if word != 0x0F:
                    self.target = self.position
        self.cycle(5)

    def move(self, side: int = 0) -> float:
        """Moves by one test distance in 0.5 s, by default in the direction in which the limits leave room;
        returns the step per cycle.
        """
        step = (side or _direction(self.t, 2)) * self.t.travel * _CYCLE_S / 0.5
        self.cycle(50, step)
        return step


@check("402.csp.enable", "Enabling in mode 8 with the target at the position moves nothing", _CSP)
def _(t: NodeTester) -> None:
    stream = _Stream(t)
    before = stream.position
    stream.enable()
    stream.cycle(20)
    _moved_at_most(t, before, 0.5 * t.travel, stream.position)


@check("402.csp.follow", "The position follows the target of every SYNC", _CSP)
def _(t: NodeTester) -> None:
    stream = _Stream.running(t)
    stream.cycle(20)
    off = abs(stream.position - stream.target)
    t.true(off <= _window(t), f"{off} units from the target", "the target")


@check("402.csp.status", "Bit 12 is 1 while the drive follows the target", _CSP)
def _(t: NodeTester) -> None:
    stream = _Stream.running(t)
    t.equal(stream.status & (_BIT_12 | _BIT_13), _BIT_12, "bits 12 and 13")


@check("402.csp.status.off", "Bit 12 is 0 without power", _CSP)
def _(t: NodeTester) -> None:
    stream = _Stream(t)
    stream.cycle(5)
    t.equal(stream.status & _BIT_12, 0, "bit 12")


@check("402.csp.halt", "Halt stops an axis that follows targets", _CSP)
def _(t: NodeTester) -> None:
    stream = _Stream(t)
    stream.enable()
    step = stream.move()
    stream.word = 0x10F
    stream.cycle(20, step)
    before = stream.position
    stream.cycle(30, step)
    _moved_at_most(t, before, 0.1 * t.travel + 2, stream.position)


@check("402.csp.limit", "A target beyond 607Dh leads at most to the limit", _CSP, (0x607D, 1))
def _(t: NodeTester) -> None:
    stream = _Stream(t)
    side = _direction(t, 3)
    within = _limited(t, stream.position, side, t.travel // 2)
    stream.enable()
    stream.move(side)
    stream.cycle(30)
    within(stream.position)


@check("402.csp.lost-sync", "Without SYNC the axis does not continue to move", _CSP)
def _(t: NodeTester) -> None:
    _Stream.running(t)
    t.wait(_STOP_S)
    _stands(t)


@check("402.csp.lost-heartbeat", "A lost heartbeat stops the axis and ends operation enabled", _CSP)
def _(t: NodeTester) -> None:
    t.require(0x6007)
    stream = _Stream(t)
    _fault_when_lost(t)
    t.be_supervised(300)
    stream.enable()
    t.beat()
    stream.cycle(50, 0.02 * t.travel * _direction(t, 3))
    t.reaches(_FAULT)
    _stands(t)


@check(
    "402.csp.return", "After a stop, repeated controlwords and targets do not set the axis in motion", _CSP,
    0x6007,
)  # fmt: skip
def _(t: NodeTester) -> None:
    _fault_when_lost(t)
    stream = _Stream.running(t)
    t.nmt(NmtCommand.STOP)
    t.wait(_STOP_S)
    t.nmt(NmtCommand.START)
    before = _position(t)
    stream.target = _ahead(t, 2)
    stream.cycle(20)
    t.true(decode(stream.status) is not _ENABLED, "operation enabled", "any other state")
    _moved_at_most(t, before, 0.1 * t.travel + 2, stream.position)


def _leaves(name: str, command: NmtCommand, text: str) -> None:
    @check(f"402.csp.nmt.{name}", f"{text} stops an axis that follows targets", _CSP, 0x6007)
    def _(t: NodeTester) -> None:
        _fault_when_lost(t)
        _Stream.running(t)
        t.nmt(command)
        t.wait(_STOP_S)
        t.nmt(NmtCommand.PRE_OPERATIONAL)
        _stands(t)
        t.true(t.power_state() is not _ENABLED, "operation enabled", "any other state")


_leaves("stop", NmtCommand.STOP, "NMT stop")
_leaves("pre-operational", NmtCommand.PRE_OPERATIONAL, "NMT enter pre-operational")


# ---------------------------------------------------------------- homing


def _home(t: NodeTester, offset: int) -> None:
    t.put(0x607C, 0, offset, 4)
    t.control(0x0F)
    t.control(0x1F)
    end_s = t.now + t.timing.power_s
    while (word := t.read(0x6041)) & (_REACHED | _BIT_12 | _BIT_13) != _REACHED | _BIT_12:
        t.true(not word & _BIT_13, "homing error (bit 13)", "homing attained")
        t.true(t.now < end_s, f"statusword {word:04X}h", "bits 10 and 12")
        t.wait(0.01)


def _homing(method: int) -> None:
    text = f"Homing method {method} sets the present position to 607Ch, without motion"

    @check(f"402.homing.{method}", text, _HM, 0x607C)
    def _(t: NodeTester) -> None:
        _enable_for_homing(t, method)
        before, offset = _position(t), t.read(0x607C, signed=True)
        wanted = t.travel if abs(before) > t.travel else 3 * t.travel
        _home(t, wanted)
        t.wait(0.05)
        found = _position(t)
        _home_back(t, before + found - wanted, offset)
        t.true(abs(found - wanted) <= _window(t), f"6064h = {found}", f"607Ch = {wanted}")


def _home_back(t: NodeTester, position: int, offset: int) -> None:
    """Homes again, so that the position values are the same as before the check."""
    _home(t, position)
    t.control(0x0F)
    t.put(0x607C, 0, offset, 4)


def _enable_for_homing(t: NodeTester, method: int) -> None:
    t.disable()
    _select(t, 6)
    _set_if_supported(t, 0x6098, method, t.read(0x6098, signed=True), 1)
    _enable_and_beat(t)


_homing(35)
_homing(37)


@check("402.homing.start", "Homing needs the rising edge of bit 4", _HM, 0x607C)
def _(t: NodeTester) -> None:
    _enable_for_homing(t, 37)
    before = _position(t)
    t.write(0x607C, 0, before + 3 * t.travel, 4)
    t.control(0x0F)
    t.wait(0.1)
    moved = abs(_position(t) - before)
    t.true(moved <= t.travel, f"6064h changed by {moved}", "no change")


@check(
    "402.following-error.fault", "A following error beyond 6065h is fault 8611h or bit 13",
    "CiA 402-2, objects 6065h, 6066h", 0x6065, 0x6066, 0x60F4,
)  # fmt: skip
def _(t: NodeTester) -> None:
    _select_slowly(t)
    t.write(0x6065, 0, 1, 4)
    t.write(0x6066, 0, 0, 2)
    t.walk()
    _set_point(t, _ahead(t, 4))
    exceeded = 0
    for _ in range(100):
        word = t.read(0x6041)
        if decode(word) is _FAULT or word & _BIT_13:
            return
        exceeded += abs(t.read(0x60F4, signed=True)) > 1
        t.wait(0.01)
    t.need(exceeded, "the drive follows without any error")
    t.fail(f"60F4h above 1 in {exceeded} of 100 readings, and no reaction", "fault 8611h, or bit 13")
