"""Motion modes of a set-point."""

from enum import IntEnum


class MotionMode(IntEnum):
    """Kind of the current motion.

    The numbers are used in the daemon's shared memory. New ones may be added, but existing ones must not
    change.
    """

    HOLD = 0
    """At rest at the end of the last motion."""
    GOTO = 1
    """Moving to a target position."""
    JOG = 2
    """Moving at a constant velocity for as long as a client renews the request."""
    STREAM = 3
    """Following knots planned by a client."""
    STOP = 4
    """Braking to rest within the limits."""
    FOLLOW = 5
    """Following a position that another source supplies in each period."""
