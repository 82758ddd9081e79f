"""Resolution of a recorded angle: encoder count, digits of the file, and jitter.

Counts are visible in a record unless the file has too few digits or the noise is larger than a count. The
jitter is always known. It is derived from third differences during motion, which suppress slow changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hdbridge.axis.effects import FloatArray

SMALLEST_COUNT_DEG = 1e-5
ROUNDED_DEG = 1e-6
"""Floating-point tolerance within which a change is a whole number of counts."""
WHOLE_SHARE = 0.99
"""Minimum fraction of changes that are whole numbers of counts."""
NEAREST = 200
"""Number of smallest differences between changes from which the count is determined."""
DIGITS = 9
"""Number of decimals from which a file is treated as unrounded."""
FINEST_COUNT_DEG = 360.0 / 2**20 - ROUNDED_DEG
"""Smallest plausible count. A smaller step is a digit of the file, or a count masked by noise."""
COUNTS_PER_DIGIT = 6.0
"""Smallest count that can be recognised in a rounded file, in units of its last digit."""
NEAR_COUNTS = 6
"""Maximum span of four consecutive readings for estimating jitter, counts: twice the span of flicker."""
LEAST_NEAR = 20
"""Minimum number of groups of four readings for estimating jitter."""
MOST_JITTER_DEG = 0.1
"""Largest plausible standard deviation of a motor reading: rounding at 1,000 counts per turn. Larger third
differences are due to fast motion."""
NEAR_SAMPLES = 5
"""Maximum distance of two changes of speed that are due to rounding or to one acceleration."""
LEAST_BENDS = 6
"""Minimum number of such changes."""
LEAST_CURVED_SHARE = 0.2
"""Minimum number of changes of acceleration relative to those of speed, for a rounded path."""
_THIRD = np.sqrt(20.0)
"""Amplification of white noise by third differences: the square root of 1 + 9 + 9 + 1."""
_MAD = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""
_UNIFORM = np.sqrt(12.0)


@dataclass(frozen=True, slots=True)
class Reading:
    """Resolution of an encoder angle: count and jitter, degrees."""

    count_deg: float
    """One count of the encoder; 0 if counts are not visible."""
    jitter_deg: float
    """Standard deviation of the reading error, including quantisation."""

    @property
    def resolution_deg(self) -> float:
        """Encoder count; if not visible, the count whose rounding error equals the jitter."""
        if self.count_deg >= FINEST_COUNT_DEG:
            return self.count_deg
        return max(self.count_deg, self._alike_deg)

    @property
    def unaided_deg(self) -> float:
        """Resolution without a command, when motor vibration is not separable from reading noise.

        Noise larger than two counts then limits the resolution.
        """
        return self._alike_deg if self._alike_deg > 2.0 * self.count_deg else self.resolution_deg

    @property
    def _alike_deg(self) -> float:
        """Encoder count whose rounding error equals the jitter."""
        return float(_UNIFORM * self.jitter_deg)


def reading_of(angle_deg: FloatArray) -> Reading:
    """Determines the resolution of a recorded angle, shape (n,).

    A change of speed within a few samples is not noise. If counts are visible, the jitter is therefore
    derived from consecutive readings within a few counts of each other or, without such readings, from
    rounding.
    """
    count, jitter = quantum_deg(angle_deg), min(jitter_deg(angle_deg), MOST_JITTER_DEG)
    if not count or len(angle_deg) <= 3:
        return Reading(count, jitter)
    four = sliding_window_view(angle_deg, 4)
    span = np.ptp(four, axis=1)
    near = np.diff(four[(span > 0.5 * count) & (span < (NEAR_COUNTS + 0.5) * count)], 3, axis=1)
    size = float(np.sqrt(np.mean(near**2)) / _THIRD) if len(near) >= LEAST_NEAR else 0.0
    return Reading(count, min(jitter, max(size, float(count / _UNIFORM))))


def jitter_deg(angle_deg: FloatArray) -> float:
    """Returns the standard deviation of the reading error, degrees; 0 without motion or with few readings.

    It is derived from third differences during motion. The largest are excluded, because they belong to the
    start or end of a motion.
    """
    if len(angle_deg) < 8:
        return 0.0
    first = angle_deg[1:] - angle_deg[:-1]
    second = first[1:] - first[:-1]
    third = second[1:] - second[:-1]
    changed = first != 0.0
    return trimmed_deviation(third[changed[:-2] | changed[1:-1] | changed[2:]])


def trimmed_deviation(third: FloatArray) -> float:
    """Returns the standard deviation of noise from its third differences, excluding the largest.

    The mean square is used, because the median of whole counts is a whole count, whatever the noise.
    """
    if not len(third):
        return 0.0
    size = np.abs(third)
    middle = float(np.median(size))
    kept = size[size <= 4.0 * middle] if middle > 0.0 else size[size <= np.quantile(size, 0.75)]
    return float(np.sqrt(np.mean(kept**2)) / _THIRD)


def median_deviation(off: FloatArray) -> float:
    """Returns the standard deviation of Gaussian values about zero, from the median of their magnitudes.

    It is robust against a few outliers.
    """
    return float(_MAD * np.median(np.abs(off)))


def third_deviation(third: FloatArray) -> float:
    """Returns the standard deviation of white noise from its third differences."""
    return float(median_deviation(third) / _THIRD)


def quantum_deg(angle_deg: FloatArray) -> float:
    """Returns the count of an angle, degrees; 0 if no counts are visible.

    The changes between readings, and the differences of these changes, are multiples of the count. The
    smallest difference is the count if nearly all changes are multiples of it, within the last digit of a
    rounded file, and if the changes are irregular as after rounding. The equal changes of an exact ramp have
    a common divisor as well, but it is not a count.
    """
    exact = _exact(angle_deg)
    digit = last_digit(angle_deg)
    # Exact steps may also be those of the file's last digit.
    count = exact if exact > 1.5 * digit or not digit else _through_rounding(angle_deg, digit)
    return count if count and _is_rounded(angle_deg, count) else 0.0


def _is_rounded(angle_deg: FloatArray, count_deg: float) -> bool:
    """Returns True if speed and acceleration vary by whole counts from sample to sample, as after rounding.

    The speed of an exact ramp changes only at its corners, the acceleration of an exact trapezoid too.
    """
    counts = np.round(np.diff(angle_deg) / count_deg)
    bends = np.flatnonzero(np.diff(counts))
    near = np.count_nonzero(np.diff(bends) <= NEAR_SAMPLES)
    curved = np.count_nonzero(np.diff(counts, 2))
    return bool(near >= LEAST_BENDS and curved > LEAST_CURVED_SHARE * near)


def last_digit(angle_deg: FloatArray) -> float:
    """Returns the unit of the last digit of a file's largest values; 0 if unrounded.

    Programs write a fixed number of significant digits or of decimals; in both cases the largest values are
    the coarsest.
    """
    size = np.abs(angle_deg)
    largest = float(np.max(size, initial=0.0))
    if not largest:
        return 0.0
    top = angle_deg[size >= 10.0 ** np.floor(np.log10(largest))]
    for decimals in range(-2, DIGITS):
        scaled = top * 10.0**decimals
        if np.all(np.abs(scaled - np.round(scaled)) <= 1e-14 * 10.0**decimals * largest + 1e-9):
            return float(10.0**-decimals)
    return 0.0


def _exact(angle_deg: FloatArray) -> float:
    """Returns the common divisor of the changes, by Euclid's algorithm on their smallest differences."""
    steps = np.sort(np.abs(np.diff(angle_deg)))
    gaps = np.diff(steps)
    gaps = np.sort(gaps[gaps > SMALLEST_COUNT_DEG])[:NEAREST]
    count = float(gaps[0]) if len(gaps) else 0.0
    while count > SMALLEST_COUNT_DEG:
        left = np.abs(gaps - np.round(gaps / count) * count)
        if np.mean(left < ROUNDED_DEG) > WHOLE_SHARE:
            break
        count = float(np.min(left[left >= ROUNDED_DEG]))
    else:
        return 0.0
    for values in (gaps, steps):  # larger multiples determine the count more accurately
        whole = np.round(values / count)
        count = float(values @ whole / (whole @ whole))
    off = np.abs(steps - np.round(steps / count) * count)
    return count if np.mean(off < ROUNDED_DEG) > WHOLE_SHARE else 0.0


def _through_rounding(angle_deg: FloatArray, digit_deg: float) -> float:
    """Returns the count of readings rounded to ``digit_deg``, from clusters of changes one count apart."""
    steps = np.sort(np.abs(np.diff(angle_deg)))
    if len(steps) < 2:
        return 0.0
    edges = np.flatnonzero(np.diff(steps) > 1.5 * digit_deg) + 1
    sizes = np.array([float(np.mean(each)) for each in np.split(steps, edges)])
    apart = np.diff(sizes)
    if len(apart) < 1:
        return 0.0
    count = float(np.median(apart[apart < 1.5 * np.min(apart)]))
    if count < COUNTS_PER_DIGIT * digit_deg:
        return 0.0
    # In ascending order, each change improves the count, as long as its multiple is certain.
    products = squares = 0.0
    for size in sizes[sizes > 0.5 * count]:
        whole = round(size / count)
        if products and whole * digit_deg > 0.25 * count * np.sqrt(squares):
            break
        products += whole * size
        squares += whole**2
        count = products / squares
    near = steps[steps < 0.25 * count * np.sqrt(squares) / digit_deg * count] if squares else steps
    off = np.abs(near - np.round(near / count) * count)
    return count if len(near) and np.mean(off < 1.5 * digit_deg) > WHOLE_SHARE else 0.0


# Correction of clocks coarser than the sampling period, which repeat times during motion.


def coarse(time_s: FloatArray, motor_deg: FloatArray) -> int:
    """Counts the samples with the same time as the previous sample, but a different motor angle."""
    return int(np.count_nonzero((np.diff(time_s) == 0.0) & (np.diff(motor_deg) != 0.0)))


def spread(time_s: FloatArray) -> FloatArray:
    """Spreads the times of samples evenly between the ticks of their clock, shape (n,).

    The first sample of each tick keeps its time. After the last tick the previous spacing is continued.
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
