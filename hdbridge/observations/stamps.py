"""A clock that is coarser than the sampling: several samples have one time, though the axis has moved on."""

from __future__ import annotations

import numpy as np

from hdbridge.effects import FloatArray


def coarse(time_s: FloatArray, motor_deg: FloatArray) -> int:
    """How many samples have the time of the one before and another motor angle: which no axis can do."""
    return int(np.count_nonzero((np.diff(time_s) == 0.0) & (np.diff(motor_deg) != 0.0)))


def spread(time_s: FloatArray) -> FloatArray:
    """The times of samples that came evenly from one tick of their clock to the next, shape (n,).

    The first sample of each tick keeps its time; what follows the last tick goes on as what came before it.
    """
    ticks = np.flatnonzero(np.diff(time_s, prepend=-np.inf) > 0.0)
    if len(ticks) < 2:
        return time_s
    rows = np.arange(len(time_s))
    times: FloatArray = np.interp(rows, ticks, time_s[ticks])
    last = ticks[-1]
    step = (time_s[last] - time_s[ticks[-2]]) / (last - ticks[-2])
    times[last:] = time_s[last] + step * (rows[last:] - last)
    return times
