"""Something unknown: a smooth random function of one coordinate, a candidate like any other."""

from __future__ import annotations

import numpy as np

from hdbridge.effects import FloatArray, Motion
from hdbridge.effects import coordinate as over
from hdbridge.effects.coordinate import Coordinate
from hdbridge.estimation.observed import Observed

LENGTHS = (2.0, 10.0)
"""Over which it is smooth, in bins of the coordinate."""


def coordinates(data: Observed) -> dict[str, Coordinate]:
    """What something unknown may depend on, apart from time."""
    motion: Motion = data.full.motion
    found = [
        over.motor_angle(motion), over.load_angle(motion, data.ratio), over.position(motion, data.ratio),
        over.speed(motion), over.acceleration(motion), over.since_reversal(motion),
        over.time_since_reversal(motion), *(over.measured(motion, each) for each in motion.measured),
    ]  # fmt: skip
    return {each.name: each for each in found if each.varies()}


def unknown_columns(data: Observed, name: str) -> FloatArray:
    """Columns of unit variance in every bin of a coordinate, neighbours alike, for every sample (n, k)."""
    coordinate = coordinates(data)[name]
    edges = coordinate.edges()
    number = coordinate.numbers()
    count = len(edges) - 1
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    kernel = np.mean([np.exp(-apart / each) for each in LENGTHS], axis=0)
    columns = np.linalg.cholesky(kernel)[number]
    if not coordinate.both_ways:
        return np.asarray(columns)
    forward = np.diff(data.full.motion.motor_deg, prepend=data.full.motion.motor_deg[0]) >= 0.0
    return np.hstack([columns * forward[:, np.newaxis], columns * ~forward[:, np.newaxis]])
