"""How large the white noise is, from the spectrum of the error itself: never from the residual of a fit.

A noise model fitted to a residual takes an effect for noise. Third differences see nothing that is slow, so a
slow effect of any size leaves them alone; but they take what is fast (a vibration, an encoder's
interpolation error) for noise, and so are an upper bound. What is fast is a few lines of the spectrum: the
level between the lines is the noise's own. Both are taken apart for standing and moving, and quantisation is
a floor. What is slow (wander, drift) is met later by statistics over blocks of seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hdbridge.effects import BoolArray, FloatArray
from hdbridge.observations.reading import third_deviation

SEGMENTS = (128, 64, 32)
"""Samples that are transformed together: the longer, the narrower a line; as many as there are enough of."""
ORDINATES = 150
"""So many of the spectrum's ordinates know the level to a tenth."""
LOWEST = 0.125
"""Share of the sampling rate below which a spectrum may be that of something slow."""
QUARTILE = 0.25
"""White noise has less than 0.29 of its mean power at so many frequencies. Lines have more, and where they
fill a third of the spectrum the deviation is found a quarter too large."""


def noise_arcsec(
    error_arcsec: FloatArray,
    still: BoolArray,
    motor_count_arcsec: float,
    load_count_arcsec: float,
    commanded: bool,
    starts: Sequence[int] = (0,),
) -> FloatArray:
    """Standard deviation of the white noise of each sample, shape (n,); ``starts`` are the first samples of
    records that were put together.
    """
    floor = load_count_arcsec / np.sqrt(12.0)
    if not commanded:
        floor = float(np.hypot(floor, motor_count_arcsec / np.sqrt(12.0)))
    third = np.diff(error_arcsec, 3)
    inner = still[1:-2]
    result = np.empty(len(error_arcsec))
    for rows, part in ((still, third[inner]), (~still, third[~inner])):
        size = third_deviation(part) if len(part) >= 20 else 0.0
        result[rows] = max(min(size, between_lines(error_arcsec, rows, starts)), floor, 0.02)
    if np.any(still) and np.any(~still):  # in motion nothing is quieter than at rest
        result[~still] = max(float(result[~still][0]), 0.5 * float(result[still][0]))
    return result


def between_lines(values: FloatArray, rows: BoolArray, starts: Sequence[int] = (0,)) -> float:
    """Standard deviation of the white noise of ``values`` in some rows, by the level between the lines of
    their spectra; infinite where too few rows are together.

    Third differences take away what is slow; their spectrum is divided by that of white noise.
    """
    edge = np.zeros(len(rows) + 1, dtype=bool)
    edge[1:-1] = np.diff(rows)
    edge[[*starts, 0, len(rows)]] = True
    runs = [values[first:last] for first, last in pairwise(np.flatnonzero(edge).tolist()) if rows[first]]
    for size in SEGMENTS:
        segments = [run[at : at + size] for run in runs for at in range(0, len(run) - size + 1, size)]
        if len(segments) * (size // 2 + 1 - round(LOWEST * size)) < ORDINATES:
            continue
        window = np.hanning(size - 1)[1:-1]
        power = np.abs(np.fft.rfft(np.diff(np.stack(segments), 3, axis=1) * window)) ** 2
        # What one sample of size one puts into each frequency, summed over the samples.
        power /= np.sum(np.abs(np.fft.rfft(np.diff(np.eye(size), 3, axis=1) * window)) ** 2, axis=0)
        level = float(np.quantile(power[:, round(LOWEST * size) :], QUARTILE))
        return float(np.sqrt(level / -np.log1p(-QUARTILE)))
    return float("inf")
