"""Intentional errors of hdbridge, and the exit status of a command for each.

    HdbridgeError
    ├── InputError        2   a file, option or value is wrong: nothing was written, nothing moved
    ├── BusError          3   the CAN interface cannot be opened, or has disappeared
    │   └── BusInUseError     another master is heard on it or holds its lock: nothing was sent
    ├── DriveError        4   the drive is absent, refuses, is not the expected one, or reports a fault
    │   ├── SdoError          an object could not be read or written
    │   ├── IdentityError     object 1018h, the ratio or the direction differs from the axis file
    │   └── TransitionError   a CiA-402 transition is not allowed, or did not happen in time
    ├── SafetyStop        5   the supervision stopped the axis while it ran (quick stop, latched)
    ├── OutputError       6   a result could not be written (a full disk); the measured figures were printed
    └── DaemonError       7   the daemon cannot be reached, or refuses this client now
        ├── LeaseError        the client does not hold the lease, the right to move
        └── RefusedError      the axis is in the wrong state for the request, or busy

A message says what is wrong, where (file:line:column, node and object), what was expected, and what to do.
Exit status 1 is an error in hdbridge itself; 130 is Ctrl-C.
"""

import shlex
from typing import ClassVar, Final

RESET: Final = "'hdbridge reset PROFILE', or 'hdbridge ctl reset AXIS' if a daemon holds the drive"
"""Commands that reset a fault, for all messages that request a reset."""


def command(*words: object) -> str:
    """Returns a command line of hdbridge for a message or a page, quoted for a shell."""
    return shlex.join(["hdbridge", *map(str, words)])


class HdbridgeError(Exception):
    """Base class of all intentional errors; its text is one line with advice."""

    exit_status: ClassVar[int] = 1


class InputError(HdbridgeError):
    """A file, an option or a value is wrong. Nothing was written and nothing moved."""

    exit_status = 2


class BusError(HdbridgeError):
    """The CAN interface cannot be opened or has disappeared."""

    exit_status = 3


class BusInUseError(BusError):
    """Another master uses the bus. Nothing was sent."""


class DriveError(HdbridgeError):
    """The drive is absent, refuses, is not the expected one, or reports a fault."""

    exit_status = 4


class SdoError(DriveError):
    """An object could not be read from or written to a node."""


class IdentityError(DriveError):
    """The node is not the drive that the axis file describes."""


class TransitionError(DriveError):
    """A CiA-402 transition is not allowed in the current state, or did not happen in time."""


class SafetyStop(HdbridgeError):  # noqa: N818 - it says what happened
    """The supervision stopped the axis while it ran; the stop is latched until an explicit reset."""

    exit_status = 5

    def __init__(self, text: str, hint: str = "") -> None:
        """``text`` describes the event, ``hint`` gives advice."""
        super().__init__(f"{text}; {hint}" if hint else text)
        self.text, self.hint = text, hint


class OutputError(HdbridgeError):
    """A file could not be written, for example because the disk is full; the old file remains."""

    exit_status = 6


class DaemonError(HdbridgeError):
    """The daemon cannot be reached, or refuses this client now. The request moved nothing."""

    exit_status = 7


class LeaseError(DaemonError):
    """The client does not hold the lease, the right to move."""


class RefusedError(DaemonError):
    """The axis is in the wrong state for the request, or busy."""
