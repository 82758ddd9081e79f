"""What moves the set-point at present."""

from __future__ import annotations

from enum import IntEnum


class MotionMode(IntEnum):
    """The numbers are part of the daemon's shared memory: add, never renumber."""

    HOLD = 0
    """At rest where the last motion ended."""
    GOTO = 1
    """On the way to a target."""
    JOG = 2
    """At a velocity for as long as somebody asks for it."""
    STREAM = 3
    """Along knots that somebody else has planned."""
    STOP = 4
    """Braking to rest within the limits."""
