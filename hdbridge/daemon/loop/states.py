"""State table of an axis in the control loop.

This module contains the states, the rows, and the functions that follow from them alone: the accepted
commands and the text of a refusal. It uses no bus, clock or drive. The drive has its own power
states (`hdbridge.drive.states`); these states determine what the loop may do with the axis. A command without
a row is refused and changes nothing.

Only an ENABLE command leads to ENABLING, and only ENABLING leads to ENABLED. No axis is therefore enabled
automatically, or after a stop before its latch is released.
"""

from enum import Enum, IntEnum
from typing import Final, NamedTuple

from hdbridge.daemon.memory.layout import CommandKind


class AxisState(IntEnum):
    """State of an axis. The numbers are part of the shared memory, so they may be added but not changed."""

    UNVERIFIED = 0
    """The drive was not verified. No RPDO is sent; received TPDOs are evaluated."""
    DISABLED = 1
    """The drive was verified. The RPDO carries the actual position as target, with power off."""
    ENABLING = 2
    """Changing to 'operation enabled', at rest."""
    ENABLED = 3
    """The axis follows its set-point."""
    STOPPING = 4
    """Braking to rest, then switching power off."""
    LENT = 5
    """The service controls the drive by SDO. No RPDO is sent."""
    QUICK_STOPPED = 6
    """A quick stop is latched. RPDOs continue."""
    LATCHED = 7
    """The drive must be verified again. No RPDO is sent."""


MAY_MOVE: Final = frozenset({AxisState.ENABLING, AxisState.ENABLED, AxisState.STOPPING})
"""States in which the loop may have commanded power."""
STOPPED: Final = frozenset({AxisState.QUICK_STOPPED, AxisState.LATCHED})
"""States of a latched stop."""
UNKNOWN: Final = frozenset({AxisState.UNVERIFIED, AxisState.LATCHED})
"""States in which the drive must be verified before any other request."""


class Trigger(Enum):
    """Events other than commands that cause a transition."""

    POWERED = "operation is enabled and the channels are known"
    POWER_OFF = "power is off"
    OVERDUE = "the drive takes too long"
    STOP_LATCHED = "the supervision stops the axis"
    VERIFICATION_LOST = "a node restarted or the bus is down"
    UNFED = "the gateway's set-points end"


Cause = CommandKind | Trigger


class Transition(NamedTuple):
    """Row of the table: in ``source``, ``cause`` leads to ``target``, which may be the same state."""

    source: AxisState
    cause: Cause
    target: AxisState


_S, _C, _T = AxisState, CommandKind, Trigger
_CONTROLLED: Final = (_S.DISABLED, _S.ENABLING, _S.ENABLED, _S.STOPPING)
"""States in which the loop controls the drive and no stop is latched."""

TRANSITIONS: Final[tuple[Transition, ...]] = (
    Transition(_S.UNVERIFIED, _C.VERIFIED, _S.DISABLED),
    Transition(_S.UNVERIFIED, _C.RELEASE, _S.UNVERIFIED),
    Transition(_S.UNVERIFIED, _C.RESET, _S.UNVERIFIED),
    Transition(_S.DISABLED, _C.VERIFIED, _S.DISABLED),
    Transition(_S.DISABLED, _C.RELEASE, _S.UNVERIFIED),
    Transition(_S.DISABLED, _C.HOME, _S.LENT),
    Transition(_S.DISABLED, _C.ENABLE, _S.ENABLING),
    Transition(_S.DISABLED, _C.DISABLE, _S.DISABLED),
    Transition(_S.DISABLED, _C.RESET, _S.DISABLED),
    Transition(_S.DISABLED, _C.DRIVE_FAULT_RESET, _S.DISABLED),
    Transition(_S.LENT, _C.HOMED, _S.DISABLED),
    Transition(_S.LENT, _C.RELEASE, _S.UNVERIFIED),
    Transition(_S.LENT, _C.QUICK_STOP, _S.QUICK_STOPPED),
    Transition(_S.ENABLING, _T.POWERED, _S.ENABLED),
    Transition(_S.ENABLING, _T.OVERDUE, _S.STOPPING),
    Transition(_S.ENABLING, _C.DISABLE, _S.STOPPING),
    Transition(_S.ENABLING, _C.QUICK_STOP, _S.QUICK_STOPPED),
    *(
        Transition(_S.ENABLED, kind, _S.ENABLED)
        for kind in (_C.MOVE, _C.JOG, _C.STREAM_BEGIN, _C.STREAM_END, _C.FOLLOW)
    ),
    Transition(_S.ENABLED, _T.UNFED, _S.STOPPING),
    Transition(_S.ENABLED, _C.DISABLE, _S.STOPPING),
    Transition(_S.ENABLED, _C.QUICK_STOP, _S.QUICK_STOPPED),
    Transition(_S.STOPPING, _C.DISABLE, _S.STOPPING),
    Transition(_S.STOPPING, _C.QUICK_STOP, _S.QUICK_STOPPED),
    Transition(_S.STOPPING, _T.POWER_OFF, _S.DISABLED),
    Transition(_S.STOPPING, _T.OVERDUE, _S.QUICK_STOPPED),
    Transition(_S.QUICK_STOPPED, _C.RESET, _S.STOPPING),
    Transition(_S.LATCHED, _C.RESET, _S.UNVERIFIED),
    # A stop is never refused, even if nothing moves. An axis that is being enabled is not enabled after it.
    *(Transition(state, _C.STOP, state if state is not _S.ENABLING else _S.STOPPING) for state in _S),
    *(
        Transition(state, _C.QUICK_STOP, state)
        for state in (_S.UNVERIFIED, _S.DISABLED, _S.QUICK_STOPPED, _S.LATCHED)
    ),
    # The service may change the compensation at any time.
    *(Transition(state, _C.CHANGE, state) for state in _S),
    *(Transition(state, _T.STOP_LATCHED, _S.QUICK_STOPPED) for state in _CONTROLLED),
    *(
        Transition(state, _T.VERIFICATION_LOST, _S.LATCHED)
        for state in (*_CONTROLLED, _S.LENT, _S.QUICK_STOPPED)
    ),
)
"""All transitions; a command without a row in a state is refused there."""

_TARGETS: Final = {(row.source, row.cause): row.target for row in TRANSITIONS}

_WAY_OUT: Final = {
    _S.UNVERIFIED: "the drive has to be booted and verified first",
    _S.DISABLED: "enable it first",
    _S.ENABLING: "wait until it is enabled, or disable it",
    _S.ENABLED: "disable it first",
    _S.STOPPING: "wait until it is disabled",
    _S.LENT: "wait until the service has given it back",
    _S.QUICK_STOPPED: "remove the cause, then reset it: hdbridge ctl reset {axis}",
    _S.LATCHED: "remove the cause, then reset it, which verifies the drive again: hdbridge ctl reset {axis}",
}
"""Advice for a refused command to ``axis``, by state."""


def target_of(state: AxisState, cause: Cause) -> AxisState | None:
    """Returns the target of ``cause`` in ``state``; None if it is refused or has no effect."""
    return _TARGETS.get((state, cause))


def refusal(axis: str, state: AxisState, kind: CommandKind) -> str:
    """Returns the message for a command to an axis that is refused in a state."""
    advice = _WAY_OUT[state].format(axis=axis)
    return f"{axis}: {label(kind)} is not possible while the axis is {label(state)}: {advice}"


def label(name: AxisState | CommandKind) -> str:
    """Returns a name in words, such as ``quick stopped``."""
    return name.name.lower().replace("_", " ")
