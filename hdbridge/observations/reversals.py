"""Where a motor reverses: a turn counts only when it comes back by more than chatter."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hdbridge.effects import FloatArray

REVERSAL_DEG = 0.3
"""Travel that a reversal has on either side of it, motor degrees: less than the narrowest loop that is looked
for (0.5, `effects.elastic_loop`), and several times what a motor settles by (0.07 in measured records)."""
JITTER_SIGMAS = 8.0
"""... and at least so many standard deviations of the reading's own error."""


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
