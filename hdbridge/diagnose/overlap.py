"""Which causes lie so near to each other that what the form of one gets wrong looks like the other.

A law is never quite right. What it misses lies where the effect itself lies: between the directions of motion
and where one goes over to the other, or over the same coordinate. A second, smaller finding there needs more
than noise speaks for.
"""

from __future__ import annotations

from hdbridge.effects import Effect, Observations, aliases_of
from hdbridge.estimation.scales import Scales


def overlap(one: Effect, other: Effect, data: Observations, scales: Scales) -> float:
    """Share of the other's evidence that a finding needs, because it may look like what that leaves."""
    if one.name == other.name:
        return one.inexact
    moving = one.follows_motion() and other.follows_motion()
    if other.name in aliases_of(one.name):
        same = one.coordinate(data.motion, data.ratio).name == other.coordinate(data.motion, data.ratio).name
        exact = one.waves() or other.waves()  # a sum of waves leaves nothing that could look like the other
        if moving or (same and not exact):
            return scales.alias_share
    return scales.moving_share if moving else 0.0
