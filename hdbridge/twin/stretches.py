"""A long part of a recording in stretches, so that a fit can do with a few of them. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hdbridge.records.record import Record
from hdbridge.records.recording import Segment

STRETCH_S = 10.0
"""Long against what a replay does not know of the time before it: 60 degrees of the motor, the ringing."""
LONG_S = 30.0
"""A part no longer than this stays whole."""


def stretches(part: Record, legs: Sequence[Segment]) -> list[Record]:
    """The part's rows in order; each stretch begins with a leg, or within one longer than a stretch."""
    start_s, end_s = float(part.time_s[0]), float(part.time_s[-1])
    if end_s - start_s <= LONG_S:
        return [part]
    places: list[float] = []
    for leg in legs:
        inside = np.arange(leg.start_s, leg.end_s, STRETCH_S)
        places += [each for each in inside.tolist() if start_s < each < end_s]
    cuts = [start_s]
    for place in sorted(places):
        if place - cuts[-1] >= 0.5 * STRETCH_S and end_s - place >= 0.5 * STRETCH_S:
            cuts.append(place)
    rows = [*np.searchsorted(part.time_s, cuts).tolist(), len(part)]
    return [part.rows(first, end) for first, end in pairwise(rows)]
