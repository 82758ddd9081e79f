"""When a load has settled after a stop, and by how much noise moves that. Pure.

How far it swings is taken over some time, without the noise. The last of single samples to be outside would
be chosen by the noise: with that, replays of one axis with different noise were apart by up to 0.05 s in
0.07 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from hdbridge.effects import FloatArray

SETTLED_ARCSEC: Final = 10.0
"""A load that swings by less than this about where it comes to rest has settled: three motor counts of 8000
at a ratio of 50."""
SETTLED_NOISE: Final = 5.0
"""... or by less than so many times the noise of the load's reading, where that is more."""
OVER_S: Final = 0.04
"""How far it swings is root two times its rms over so long: half a period of the slowest ringing, 15 Hz."""
LEAST_SAMPLES: Final = 4
DRAWS: Final = 24


def band_arcsec(noise_arcsec: float) -> float:
    """Within what a load of this noise has settled."""
    return max(SETTLED_ARCSEC, SETTLED_NOISE * noise_arcsec)


def settling_s(time_s: FloatArray, load_arcsec: FloatArray, noise_arcsec: float, band: float) -> float:
    """Time from the first sample, where the command rests, until the load stays settled."""
    length = min(max(LEAST_SAMPLES, round(OVER_S / float(np.median(np.diff(time_s))))), len(time_s))
    squares = np.square(load_arcsec - _rest_arcsec(load_arcsec))
    swing = 2.0 * (np.convolve(squares, np.full(length, 1.0 / length), mode="valid") - noise_arcsec**2)
    outside = np.flatnonzero(swing > band**2)
    return float(time_s[outside[-1] + 1] - time_s[0]) if len(outside) else 0.0


def scatter_s(
    time_s: FloatArray, load_arcsec: FloatArray, noise_arcsec: float, band: float, noises: Sequence[float]
) -> float:
    """By how much two settling times of a load that moves so are apart, rms, for readings of these noises."""
    rng = np.random.default_rng(0)
    own = settling_s(time_s, load_arcsec, noise_arcsec, band)
    squares = 0.0
    for each in noises:
        for _ in range(DRAWS):
            noisy = load_arcsec + each * rng.standard_normal(len(load_arcsec))
            squares += (settling_s(time_s, noisy, float(np.hypot(noise_arcsec, each)), band) - own) ** 2
    return float(np.sqrt(squares / DRAWS))


def overshoot_arcsec(load_arcsec: FloatArray, way: float) -> float:
    """How far it goes beyond where it comes to rest; ``way`` is the sign of the motion before."""
    return max(0.0, float(np.max(way * (load_arcsec - _rest_arcsec(load_arcsec)))))


def _rest_arcsec(load_arcsec: FloatArray) -> float:
    return float(np.mean(load_arcsec[-max(LEAST_SAMPLES, len(load_arcsec) // 4) :]))
