"""Which causes lie so near to each other that what the form of one gets wrong looks like the other.

A law is never quite right. What it misses lies where the effect itself lies: between the directions of motion
and where one goes over to the other, or over the same coordinate. A second, smaller finding there needs more
than noise speaks for.
"""

from __future__ import annotations

from typing import Final

from hdbridge.effects import Effect, Motion, aliases_of

MOVING_SHARE: Final = 0.05
"""Of two effects that follow the motion the smaller one needs this share of the larger one's evidence."""
ALIAS_SHARE: Final = 0.15
"""... and this where the two can be taken for each other."""


def hides(one: Effect, other: Effect) -> bool:
    """Whether either may hide the other from a search that takes one at a time."""
    return (
        one.name != other.name
        and one.follows_motion()
        and other.follows_motion()
        and other.name in aliases_of(one.name)
    )


def overlap(one: Effect, other: Effect, motion: Motion, ratio: float) -> float:
    """Share of the other's evidence that a finding needs, because it may look like what that leaves."""
    if one.name == other.name:
        return one.inexact
    moving = one.follows_motion() and other.follows_motion()
    if other.name in aliases_of(one.name):
        same = one.coordinate(motion, ratio).name == other.coordinate(motion, ratio).name
        exact = one.waves() or other.waves()  # a sum of waves leaves nothing that could look like the other
        if moving or (same and not exact):
            return ALIAS_SHARE
    return MOVING_SHARE if moving else 0.0
