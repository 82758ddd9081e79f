"""CiA-402 power state machine of the simulated drive, as tables.

Written from the profile, independently of the master's table, so that each verifies the other.
"""

from enum import Enum, IntEnum
from typing import Final


class State(Enum):
    """Power states; the value holds statusword bits 0 to 3, 5 and 6."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08

    # Hash by identity: Enum's own hash is computed in Python, which is measurable in every cycle.
    __hash__ = object.__hash__


class Command(Enum):
    """Device control commands of a controlword."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"  # also 'disable operation': the same bits
    ENABLE = "switch on and enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"


class Control(IntEnum):
    """Controlword bits other than the state commands."""

    NEW_SET_POINT = 1 << 4  # PP: new set-point; HM: start; IP: interpolate
    CHANGE_IMMEDIATELY = 1 << 5
    RELATIVE = 1 << 6
    FAULT_RESET = 1 << 7
    HALT = 1 << 8


class Status(IntEnum):
    """Statusword bits other than the state bits."""

    VOLTAGE_ENABLED = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    MODE_12 = 1 << 12  # PP: set-point acknowledged; CSP: follows; IP: interpolates; HM: attained
    MODE_13 = 1 << 13  # PP, CSP: following error; HM: homing error
    REFERENCED = 1 << 14  # manufacturer-specific: homing has been done


class PowerStage:
    """Power stage as seen by the firmware. This class switches immediately and never fails.

    The firmware requests power with ``switch`` and operates the axis only while ``is_on``. ``error_code`` is
    the emergency error code of a failure (0 for none) and stays until a ``reset`` has removed it. The
    firmware remains in FAULT while ``is_resetting``.
    """

    is_on = True
    is_resetting = False
    error_code = 0
    error_details = b""
    """Up to five manufacturer-specific bytes of the emergency message."""

    def switch(self, on: bool) -> None:
        """Requests power, or switches it off."""

    def reset(self) -> None:
        """Requests the removal of a failure."""


POWERED: Final = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE})
"""States in which the motor is under control."""

_S = State
_C = Command
TRANSITIONS: Final[dict[tuple[State, Command], State]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, _C.ENABLE): _S.OPERATION_ENABLED,  # 3, then 4 automatically
    (_S.SWITCHED_ON, _C.ENABLE): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5, by option 605Ch
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8, by option 605Bh
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11, by option 605Ah
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE): _S.OPERATION_ENABLED,  # 16, only if 605Ah is 5 to 8
}
"""Next state by state and command; all other pairs change nothing. Comments give the profile's numbers.

Transitions 0, 1 (start), 13, 14 (fault reaction) and 15 (fault reset, by the edge of bit 7) are not commands.
"""


def command_of(controlword: int) -> Command | None:
    """Returns the command in bits 0 to 3 and 7, or None if bit 7 (fault reset) is set (CiA 402)."""
    if controlword & 0x80:
        return None
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE if controlword & 0x08 else Command.SWITCH_ON


def next_state(state: State, controlword: int) -> State:
    """Returns the state that ``controlword`` requests in ``state``, or ``state`` without a request."""
    command = command_of(controlword)
    return state if command is None else TRANSITIONS.get((state, command), state)
