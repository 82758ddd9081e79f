"""Two records of a signal over time, and their spectra. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge.effects import FloatArray

SPECTRUM_SAMPLES: Final = 1024
SHORTEST: Final = 32
"""Samples of the shortest part that has a spectrum."""


@dataclass(frozen=True, eq=False)
class Trace:
    """A signal of both records over time, for a picture."""

    time_s: FloatArray
    measured: FloatArray
    simulated: FloatArray

    @property
    def difference(self) -> FloatArray:
        """Measured less simulated."""
        return self.measured - self.simulated


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitude density by frequency, in the signal's unit per root hertz."""

    frequency_hz: FloatArray
    measured: FloatArray
    simulated: FloatArray
    difference: FloatArray


def spectrum_of(trace: Trace, parts: Sequence[slice]) -> Spectrum | None:
    """Welch's estimate over the parts, on an even grid; None where all are too short."""
    steps = np.concatenate([np.diff(trace.time_s[part]) for part in parts])
    period_s = float(np.median(steps)) if len(steps) else 0.0
    if period_s <= 0.0:
        return None
    longest = max(parts, key=lambda part: part.stop - part.start)
    length = min(SPECTRUM_SAMPLES, longest.stop - longest.start)
    if length < SHORTEST:
        return None
    from scipy.signal import welch  # noqa: PLC0415 - takes a second to load

    powers: list[FloatArray] = []
    weights: list[int] = []
    frequency = np.empty(0)
    for part in parts:
        time_s = trace.time_s[part]
        if len(time_s) < length:
            continue
        grid = np.arange(time_s[0], time_s[-1], period_s)
        if len(grid) < length:
            continue
        values = (trace.measured[part], trace.simulated[part], trace.difference[part])
        even = np.stack([np.interp(grid, time_s, each) for each in values])
        frequency, power = welch(even, 1.0 / period_s, nperseg=length, detrend="linear")
        powers.append(power)
        weights.append(len(grid))
    if not powers:
        return None
    mean = np.average(np.stack(powers), axis=0, weights=weights)
    return Spectrum(frequency, *np.sqrt(mean))
