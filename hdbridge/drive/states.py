"""Power state machine of CiA 402, as tables.

This module contains the states, the rows of the decoding and transition tables, and the functions that follow
from these rows alone: decoding, the commands permitted in each state, the path between two states, the
diagram. It has no bus, clock, objects or modes of operation, and no policy of *when* to move, which belongs
to `drive.py` and to the cycle. A drive that behaves differently requires an additional row, not an `if`.

The rows are those of CiA 402-2, with its transition numbers. Three transitions are never part of an automatic
path: leaving a fault (15) and resuming from a quick stop (16), which must be requested explicitly, and a
fault (13).
"""

from collections import deque
from collections.abc import Iterator
from enum import Enum
from typing import Final, NamedTuple

from hdbridge.enums import PowerState
from hdbridge.errors import RESET, TransitionError

State = PowerState
# The control cycle uses module names because looking up an enum member in its class takes five times as long.
_ENABLED: Final = State.OPERATION_ENABLED
_QUICK_STOP: Final = State.QUICK_STOP_ACTIVE
_FAULT: Final = State.FAULT
FAULTS: Final = (State.FAULT, State.FAULT_REACTION_ACTIVE)

_DECODING: Final[tuple[tuple[State, int, int], ...]] = (
    # state, mask, value: bits 0-3, 5, 6 of the statusword
    (State.NOT_READY_TO_SWITCH_ON, 0x4F, 0x00),
    (State.SWITCH_ON_DISABLED, 0x4F, 0x40),
    (State.READY_TO_SWITCH_ON, 0x6F, 0x21),
    (State.SWITCHED_ON, 0x6F, 0x23),
    (State.OPERATION_ENABLED, 0x6F, 0x27),
    (State.QUICK_STOP_ACTIVE, 0x6F, 0x07),
    (State.FAULT_REACTION_ACTIVE, 0x4F, 0x0F),
    (State.FAULT, 0x4F, 0x08),
)


class Command(Enum):
    """Command of a controlword: ``mask`` and ``word`` over bits 0-3 and 7."""

    SHUTDOWN = ("shutdown", 0x87, 0x06)
    SWITCH_ON = ("switch on", 0x8F, 0x07)
    ENABLE_OPERATION = ("enable operation", 0x8F, 0x0F)
    DISABLE_OPERATION = ("disable operation", 0x8F, 0x07)
    DISABLE_VOLTAGE = ("disable voltage", 0x82, 0x00)
    QUICK_STOP = ("quick stop", 0x86, 0x02)
    FAULT_RESET = ("fault reset", 0x80, 0x80)
    """Edge-triggered: bit 7 must have been low before."""

    def __init__(self, label: str, mask: int, word: int) -> None:
        self.label = label
        self.mask = mask
        self.word = word


class Transition(NamedTuple):
    """Row of the table: ``command`` leads from ``source`` to ``target``; None if the drive does it itself."""

    number: int
    source: State
    target: State
    command: Command | None


_S = State
_C = Command
TRANSITIONS: Final[tuple[Transition, ...]] = (
    Transition(1, _S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, None),
    Transition(2, _S.SWITCH_ON_DISABLED, _S.READY_TO_SWITCH_ON, _C.SHUTDOWN),
    Transition(3, _S.READY_TO_SWITCH_ON, _S.SWITCHED_ON, _C.SWITCH_ON),
    Transition(4, _S.SWITCHED_ON, _S.OPERATION_ENABLED, _C.ENABLE_OPERATION),
    Transition(5, _S.OPERATION_ENABLED, _S.SWITCHED_ON, _C.DISABLE_OPERATION),
    Transition(6, _S.SWITCHED_ON, _S.READY_TO_SWITCH_ON, _C.SHUTDOWN),
    Transition(7, _S.READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE),
    Transition(7, _S.READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, _C.QUICK_STOP),
    Transition(8, _S.OPERATION_ENABLED, _S.READY_TO_SWITCH_ON, _C.SHUTDOWN),
    Transition(9, _S.OPERATION_ENABLED, _S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE),
    Transition(10, _S.SWITCHED_ON, _S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE),
    Transition(10, _S.SWITCHED_ON, _S.SWITCH_ON_DISABLED, _C.QUICK_STOP),
    Transition(11, _S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _C.QUICK_STOP),
    Transition(12, _S.QUICK_STOP_ACTIVE, _S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE),
    Transition(13, _S.SWITCH_ON_DISABLED, _S.FAULT_REACTION_ACTIVE, None),
    Transition(13, _S.READY_TO_SWITCH_ON, _S.FAULT_REACTION_ACTIVE, None),
    Transition(13, _S.SWITCHED_ON, _S.FAULT_REACTION_ACTIVE, None),
    Transition(13, _S.OPERATION_ENABLED, _S.FAULT_REACTION_ACTIVE, None),
    Transition(13, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE, None),
    Transition(14, _S.FAULT_REACTION_ACTIVE, _S.FAULT, None),
    Transition(15, _S.FAULT, _S.SWITCH_ON_DISABLED, _C.FAULT_RESET),
    Transition(16, _S.QUICK_STOP_ACTIVE, _S.OPERATION_ENABLED, _C.ENABLE_OPERATION),
)
NEVER_IMPLIED: Final = frozenset({13, 15, 16})
"""Transitions that an automatic path must not use."""

HOLD: Final[dict[State, int]] = {
    State.READY_TO_SWITCH_ON: Command.SHUTDOWN.word,
    State.SWITCHED_ON: Command.SWITCH_ON.word,
    State.OPERATION_ENABLED: Command.ENABLE_OPERATION.word,
    State.QUICK_STOP_ACTIVE: Command.QUICK_STOP.word,
}
"""Controlword that keeps the drive in a state; 0 (disable voltage) in all other states."""


def _decoded(bits: int) -> State:
    return next((state for state, mask, value in _DECODING if bits & mask == value), State.UNKNOWN)


_STATE_BITS: Final = 0x6F
_DECODED: Final = tuple(_decoded(bits) for bits in range(_STATE_BITS + 1))


OFF: Final = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)
"""States with power off, in which a drive can be left."""


def decode(statusword: int | None) -> State:
    """Returns the state in a statusword; UNKNOWN for None, beyond 16 bits and for undefined bits."""
    if statusword is None or not 0 <= statusword <= 0xFFFF:
        return State.UNKNOWN
    return _DECODED[statusword & _STATE_BITS]


def row_for(state: State, command: Command) -> Transition:
    """Returns the row of ``command`` in ``state``; raises `TransitionError` for an illegal command."""
    for row in TRANSITIONS:
        if row.source is state and row.command is command:
            return row
    legal = ", ".join(row.command.label for row in TRANSITIONS if row.source is state and row.command)
    raise TransitionError(
        f"'{command.label}' is not allowed in state '{state.value}'; "
        + (f"allowed is {legal}" if legal else "no command is: wait for the drive or look at its fault")
    )


def _first_row(state: State, target: State) -> Transition | None:
    """Returns the first row of the shortest path (breadth-first search), or None.

    The path avoids the transitions of `NEVER_IMPLIED` and never passes *through* 'operation enabled', because
    a drive must not be powered merely to reach another state.
    """
    ways: deque[tuple[State, Transition | None]] = deque([(state, None)])
    seen = {state}
    while ways:
        here, first = ways.popleft()
        if here is target:
            return first
        if here is State.OPERATION_ENABLED and first is not None:
            continue
        for row in TRANSITIONS:
            if row.source is here and row.number not in NEVER_IMPLIED and row.target not in seen:
                seen.add(row.target)
                ways.append((row.target, first or row))
    return None


_FIRST_ROWS: Final = {(a, b): _first_row(a, b) for a in State for b in State}


def controlword_for(state: State, target: State) -> int:
    """Returns the controlword for the next step to ``target``, or the one that holds the drive there.

    It is 0 (disable voltage) if the drive must first change state on its own. Raises `TransitionError`
    without a path, which includes every exit from a fault (use `PowerWalk.reset_fault`) and the direct exit
    from a quick stop (only through 'switch on disabled').
    """
    if state is target and state is not State.UNKNOWN:
        return HOLD.get(state, 0)
    row = _FIRST_ROWS[state, target]
    if row is None:
        hint = {
            State.FAULT: f"reset the fault first: {RESET}",
            State.FAULT_REACTION_ACTIVE: f"wait for its fault reaction, then reset the fault: {RESET}",
            State.UNKNOWN: "no valid statusword has arrived; check that the drive sends it",
        }.get(state, "no command leads there")
        raise TransitionError(f"cannot go from '{state.value}' to '{target.value}': {hint}")
    return row.command.word if row.command is not None else 0


_NO_RESET, _RESET_LOW, _RESET_HIGH = range(3)


def _word(state: State, aim: State) -> int:
    try:
        return controlword_for(state, aim)
    except TransitionError:
        return 0  # no path: power off, and wait for the next aim


_WORDS: Final = {state: {aim: _word(state, aim) for aim in State} for state in State}


class PowerWalk:
    """Walks a drive through its states, taking one statusword and returning one controlword at a time.

    It only walks towards its target state. A drive that leaves 'operation enabled' on its own, or reports a
    fault on the way there, is not enabled until the next `go`, and a fault is reset only on request. A call
    that raises changes nothing.
    """

    def __init__(self) -> None:
        self.state = State.UNKNOWN
        """State of the last statusword."""
        self.aim = State.SWITCH_ON_DISABLED
        """State to which the drive is to be taken."""
        self._reset = _NO_RESET
        self._was_enabled = False
        self.dropped: State | None = None
        """First state after the drive left the way to 'operation enabled', or that state, without a command.

        Kept until the next `go` or `power_off`, whatever the drive reports meanwhile."""

    def observe(self, statusword: int | None) -> State:
        """Takes a statusword and returns its state."""
        state = _DECODED[statusword & _STATE_BITS] if statusword is not None else State.UNKNOWN
        self.state = state
        if state is _ENABLED:
            self._was_enabled = True
        elif self._was_enabled or state in FAULTS:
            self._was_enabled = False
            if self.aim is State.OPERATION_ENABLED:
                # The drive dropped out on its own. It stays there until the next `go`.
                self.dropped = state
                blind = state in (State.QUICK_STOP_ACTIVE, State.UNKNOWN)
                self.aim = State.QUICK_STOP_ACTIVE if blind else State.SWITCH_ON_DISABLED
        if state is not _FAULT:
            self._reset = _NO_RESET
        return state

    def go(self, target: State) -> None:
        """Sets the target state; raises `TransitionError` if no path leads there from the current state."""
        controlword_for(self.state, target)
        self.aim = target
        self.dropped = None
        self._was_enabled = self.state is State.OPERATION_ENABLED

    def quick_stop(self) -> None:
        """Stops now: quick stop if power is on, else disable voltage. Always allowed."""
        self.aim = (
            State.QUICK_STOP_ACTIVE
            if self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.UNKNOWN)
            else State.SWITCH_ON_DISABLED
        )
        self._reset = _NO_RESET

    def power_off(self) -> None:
        """Removes power now, by disable voltage, and ends the request for power. Always allowed."""
        self.aim = State.SWITCH_ON_DISABLED
        self.dropped = None
        self._reset = _NO_RESET

    def reset_fault(self) -> None:
        """Requests one fault reset; raises `TransitionError` unless the drive is in 'fault'."""
        row_for(self.state, Command.FAULT_RESET)
        self._reset = _RESET_LOW
        self.aim = State.SWITCH_ON_DISABLED

    def controlword(self) -> int:
        """Returns the word to send now. Bits 4-6 and 8-15 are zero; the mode of operation sets them."""
        if self._reset == _RESET_LOW:
            # Bit 7 acts on its rising edge, so it is sent low once before high.
            self._reset = _RESET_HIGH
            return 0
        if self._reset == _RESET_HIGH:
            return Command.FAULT_RESET.word
        if self.aim is _QUICK_STOP and self.state is not _QUICK_STOP:
            # Sent even if the drive's state is unknown: a quick stop does no harm in any state.
            return Command.QUICK_STOP.word
        return _WORDS[self.state][self.aim]


def states_on_the_way(state: State, target: State) -> Iterator[State]:
    """Yields the states from ``state`` to ``target``, both included; `TransitionError` without a path."""
    yield state
    while state is not target:
        controlword_for(state, target)
        row = _FIRST_ROWS[state, target]
        assert row is not None  # otherwise controlword_for has raised
        state = row.target
        yield state
