"""The angle that drives the gear's elastic state: smooth, and free of chatter.

A hysteresis law with an infinite slope at each reversal turns one count of chatter into several arcseconds,
so it must not see the encoder as it is. It sees the command, and where the motor was measured too, the
command plus the lag behind it; either way a turn counts only when the motor comes back by more than chatter.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from hdbridge.effects import FloatArray
from hdbridge.observations.reading import reading_of

LAG_SAMPLES = 5
"""Samples over which the lag of the motor behind its command is averaged."""
CHATTER_COUNTS = 2.6
"""A measured angle counts as reversed when it has come back by more than this many counts."""
REVERSAL_DEG = 0.3
"""Travel that a reversal has on either side of it, motor degrees: less than the narrowest loop that is looked
for (0.5, `effects.elastic_loop`), and several times what a motor settles by (0.07 in measured records)."""
JITTER_SIGMAS = 8.0
"""... and at least so many standard deviations of the reading's own error."""


def driving_angle(motor_deg: FloatArray, position_deg: FloatArray | None, commanded: bool) -> FloatArray:
    """Motor angle for the regressors, degrees, shape (n,).

    Where the motor was measured in addition to its command: the command plus the averaged lag, but never
    outside the cell that the encoder was read in, so that a fast move's lag does not smear over a turn.
    """
    if len(motor_deg) < 2 or (position_deg is None and commanded):
        return motor_deg
    if position_deg is None:
        return steadied(motor_deg, motor_deg, CHATTER_COUNTS * reading_of(motor_deg).unaided_deg)
    reading = reading_of(position_deg)
    cell = reading.count_deg
    path = position_deg
    if cell:
        lag = uniform_filter1d(position_deg - motor_deg, min(LAG_SAMPLES, len(motor_deg)), mode="nearest")
        path = np.clip(motor_deg + lag, position_deg - 0.5 * cell, position_deg + 0.5 * cell)
    return steadied(path, position_deg, CHATTER_COUNTS * reading.resolution_deg)


def steadied(path_deg: FloatArray, measured_deg: FloatArray, band_deg: float) -> FloatArray:
    """A path without reversals smaller than ``band_deg`` of what was measured: monotone from turn to turn.

    At each turn it reaches what was measured and no more: the largest of many noisy angles lies too far out.
    """
    changes = np.flatnonzero(np.diff(measured_deg, prepend=np.nan) != 0.0)
    until = np.append(changes[1:], len(measured_deg)) - 1
    turns = [0]
    sign, extreme, at = 0, float(measured_deg[0]), 0
    for first, last, value in zip(
        changes.tolist(), until.tolist(), measured_deg[changes].tolist(), strict=True
    ):
        if sign == 0:
            if abs(value - extreme) > band_deg:
                sign, extreme, at = (1 if value > extreme else -1), value, (first + last) // 2
        elif (value - extreme) * sign > 0.0:
            extreme, at = value, (first + last) // 2
        elif (extreme - value) * sign > band_deg:
            turns.append(at)
            sign, extreme, at = -sign, value, (first + last) // 2
    result = path_deg.copy()
    for first, last in pairwise([*turns, len(measured_deg) - 1]):
        stretch = result[first : last + 1]
        ends = sorted((measured_deg[first], measured_deg[last]))
        np.clip(stretch, *ends, out=stretch)
        if measured_deg[last] >= measured_deg[first]:
            np.maximum.accumulate(stretch, out=stretch)
        else:
            np.minimum.accumulate(stretch, out=stretch)
    return result


def reversals(driving_deg: FloatArray, jitter_deg: float) -> int:
    """How often one record reverses with travel on both sides (`REVERSAL_DEG`)."""
    if len(driving_deg) < 3:
        return 0
    band = max(REVERSAL_DEG, JITTER_SIGMAS * jitter_deg)
    steps = np.sign(np.diff(steadied(driving_deg, driving_deg, band)))
    return int(np.count_nonzero(np.diff(steps[steps != 0.0])))
