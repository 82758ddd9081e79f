"""Modes of motion of a set-point."""

from enum import IntEnum


class MotionMode(IntEnum):
    """Source of the present motion. The numbers are part of the daemon's shared memory, so they may be added
    but not changed.
    """

    HOLD = 0
    """At rest at the end of the last motion."""
    GOTO = 1
    """Moving to a target."""
    JOG = 2
    """Moving at a velocity while a client requests it."""
    STREAM = 3
    """Following knots planned by a client."""
    STOP = 4
    """Braking to rest within the limits."""
    FOLLOW = 5
    """Following a position supplied by another source in each period."""
