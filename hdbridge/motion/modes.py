"""Modes of motion of a set-point."""

from enum import IntEnum


class MotionMode(IntEnum):
    """Source of the present motion. The numbers are part of the daemon's shared memory: add,
    never renumber.
    """

    HOLD = 0
    """At rest where the last motion ended."""
    GOTO = 1
    """Moving to a target."""
    JOG = 2
    """Moving at a velocity for as long as a client requests it."""
    STREAM = 3
    """Following knots that a client has planned."""
    STOP = 4
    """Braking to rest within the limits."""
    FOLLOW = 5
    """After a position that somebody else gives in each period."""
