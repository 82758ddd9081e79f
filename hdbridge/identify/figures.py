"""Noise as the axis itself shows it, without any model: at rest, and between one lap and the next."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from hdbridge.effects import FloatArray
from hdbridge.effects.path import branches
from hdbridge.estimation.blocks import REST_DEG_S
from hdbridge.estimation.samples import Samples
from hdbridge.identify.result import Outliers
from hdbridge.identify.usable import SLOW
from hdbridge.observations.reading import median_deviation
from hdbridge.units import ARCSEC_PER_DEG

SHORTEST_REST_S = 1.0
LONGEST_GAP_S = 0.5
LAP_BIN_DEG = 30.0
WINDOW = 51
"""Samples whose median an outlier is compared with."""
OUTLYING = 6.0
"""Robust standard deviations."""


def standing_arcsec(samples: Samples) -> float | None:
    """Noise of the load encoder at rest: rms about the mean of each rest.

    A motor that rests between two counts of its encoder flickers, which is no noise of the load; a sine or
    sweep that creeps within a count seems to rest, while the load goes on.
    """
    still = samples.usable & (np.abs(samples.speed_deg_s) < REST_DEG_S)
    still &= ~samples.of_kind(*SLOW)
    # What was not recorded may have been a motion.
    pause = np.diff(samples.time_s, prepend=samples.time_s[0]) > LONGEST_GAP_S
    rest = np.where(still, np.cumsum(pause) + 1, 0)
    edges = np.flatnonzero(np.diff(rest, prepend=-1, append=-1))
    runs = [
        slice(begin, end)
        for begin, end in pairwise(edges.tolist())
        if still[begin]
        and end - begin >= 20
        and samples.time_s[end - 1] - samples.time_s[begin] >= SHORTEST_REST_S
    ]
    if not runs:
        return None
    loads = [samples.load_deg[run] * ARCSEC_PER_DEG for run in runs]
    return float(np.sqrt(np.mean(np.concatenate([load - np.mean(load) for load in loads]) ** 2)))


def laps_arcsec(samples: Samples) -> float | None:
    """Rms by which passes in the same direction differ, over the root of two; means over `LAP_BIN_DEG`."""
    passes: dict[int, list[dict[int, float]]] = {1: [], -1: []}
    sweep = samples.usable & samples.of_kind("sweep")
    for chain in samples.chains:
        turning, signs = branches(samples.motor_deg[chain.rows])
        for (first, last), sign in zip(pairwise(turning), signs, strict=True):
            rows = chain.rows.start + 1 + np.arange(first, last)
            rows = rows[sweep[rows]]
            if len(rows) >= 20:
                cells, inverse = np.unique(samples.motor_deg[rows] // LAP_BIN_DEG, return_inverse=True)
                means = np.bincount(inverse, samples.error_arcsec[rows]) / np.bincount(inverse)
                # The first cells of a pass are on the travel across the hysteresis.
                keep = slice(5, None) if sign > 0 else slice(None, -5)
                passes[sign].append(dict(zip(cells[keep].tolist(), means[keep].tolist(), strict=True)))
    differences = [
        earlier[cell] - later[cell]
        for each in passes.values()
        for earlier, later in pairwise(each)
        for cell in earlier.keys() & later.keys()
    ]
    return float(np.sqrt(np.mean(np.square(differences)) / 2.0)) if len(differences) >= 8 else None


def outlying(residual: FloatArray, count_arcsec: float = 0.0) -> tuple[FloatArray, Outliers]:
    """Weights (n,), 0 for samples far from the median of their neighbours; NaN residuals keep 1.

    Compared with neighbours and not with the model, so that what the model lacks is not thrown away, and a
    step that stays (lost counts) is left in for all to see. ``count_arcsec`` is the motor encoder's count at
    the load: a motor between two counts reads now the one and now the other, and only their mean is right.
    """
    weight = np.ones(len(residual))
    index = np.flatnonzero(np.isfinite(residual))
    if len(index) < WINDOW:
        return weight, Outliers(0, 0)
    values = residual[index]
    off = np.abs(values - median_filter(values, WINDOW, mode="nearest"))
    scale = max(median_deviation(off), 0.1)
    out = off > OUTLYING * scale + count_arcsec
    weight[index[out]] = 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], out, [False]]).astype(np.int8)))
    runs = edges[1::2] - edges[::2]
    return weight, Outliers(int(np.count_nonzero(out)), int(np.max(runs, initial=0)))
