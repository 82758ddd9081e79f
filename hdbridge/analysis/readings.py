"""How finely an angle was read: the counts of its encoder, the digits of its file, its own jitter.

An encoder's counts are seen in the record unless the file has kept too few digits, or noise is larger than
they are. What jitters without the axis having moved is known in either case, from third differences while it
moves: they see nothing that is slow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray

SMALLEST_COUNT_DEG = 1e-5
ROUNDED_DEG = 1e-6
"""Changes are whole counts to within this: floats round."""
WHOLE_SHARE = 0.99
"""So many of the changes have to be whole counts."""
DIGITS = 9
"""A file of fewer decimals has its last digit looked for."""
FINEST_COUNT_DEG = 360.0 / 2**20 - ROUNDED_DEG
"""What is finer is a digit of the file, or a count that its encoder's noise hides."""
COUNTS_PER_DIGIT = 6.0
"""A count that is to be seen through the rounding of a file is at least so many units of its last digit."""
_THIRD = np.sqrt(20.0)
_MAD = 1.4826
_UNIFORM = np.sqrt(12.0)


@dataclass(frozen=True, slots=True)
class Reading:
    """How finely an angle was read, degrees."""

    count_deg: float
    """One count of the encoder; 0 where none is seen."""
    jitter_deg: float
    """Standard deviation of what a reading is off by, that of rounding to counts included."""

    @property
    def resolution_deg(self) -> float:
        """The count; where none is seen, the one that would jitter as much."""
        if self.count_deg >= FINEST_COUNT_DEG:
            return self.count_deg
        return max(self.count_deg, self._alike_deg)

    @property
    def unaided_deg(self) -> float:
        """The same where no command distinguishes a motor that is shaken from a reading that is noisy: noise
        that is larger than the counts bounds it, too.
        """
        return self._alike_deg if self._alike_deg > 2.0 * self.count_deg else self.resolution_deg

    @property
    def _alike_deg(self) -> float:
        """The count that would jitter as much."""
        return float(_UNIFORM * self.jitter_deg)


def reading_of(angle_deg: FloatArray) -> Reading:
    """How finely an angle was read, shape (n,)."""
    return Reading(quantum_deg(angle_deg), jitter_deg(angle_deg))


def jitter_deg(angle_deg: FloatArray) -> float:
    """Standard deviation of a reading's own error, degrees; 0 where it is too short or never moves.

    From third differences while it moves, without the largest of them: those are motion that begins or ends.
    """
    if len(angle_deg) < 8:
        return 0.0
    first = angle_deg[1:] - angle_deg[:-1]
    second = first[1:] - first[:-1]
    third = np.abs(second[1:] - second[:-1])
    changed = first != 0.0
    third = third[changed[:-2] | changed[1:-1] | changed[2:]]
    if not len(third):
        return 0.0
    middle = float(np.median(third))
    kept = third[third <= 4.0 * middle] if middle > 0.0 else third[third <= np.quantile(third, 0.75)]
    return float(np.sqrt(np.mean(kept**2)) / _THIRD)


def median_deviation(off: FloatArray) -> float:
    """Standard deviation of Gaussian values about zero by the median of their sizes: a few wild ones do not
    matter.
    """
    return float(_MAD * np.median(np.abs(off)))


def third_deviation(third: FloatArray) -> float:
    """Standard deviation of white noise from its third differences."""
    return float(median_deviation(third) / _THIRD)


def quantum_deg(angle_deg: FloatArray) -> float:
    """The count in which an angle was read, degrees; 0 where it moves in no counts that can be seen.

    Changes of a counted angle, and the differences between them, are whole multiples of the count; the
    smallest of them is the count itself if nearly all changes are multiples of it. Where a file has rounded
    its numbers they are so to within the last digit.
    """
    exact = _exact(angle_deg)
    digit = last_digit(angle_deg)
    if exact > 1.5 * digit or not digit:
        return exact
    # What is seen exactly is the last digit of the file, or nothing.
    return _through_rounding(angle_deg, digit)


def last_digit(angle_deg: FloatArray) -> float:
    """The unit of the last digit that a file has kept of its largest values; 0 where it kept them all.

    Programs write so many significant digits or so many decimals; either way the largest values are the
    coarsest.
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
    steps = np.abs(np.diff(angle_deg))
    values = np.unique(np.round(steps, 9))
    gaps = np.diff(values)
    gaps = gaps[gaps > SMALLEST_COUNT_DEG]
    if len(gaps) < 1:
        return 0.0
    smallest = float(np.min(gaps))
    whole = np.round(values / smallest)
    sharp = float(np.median((values / np.maximum(whole, 1.0))[whole > 0])) if np.any(whole > 0) else smallest
    off = np.abs(steps - np.round(steps / sharp) * sharp)
    return sharp if np.mean(off < ROUNDED_DEG) > WHOLE_SHARE else 0.0


def _through_rounding(angle_deg: FloatArray, digit_deg: float) -> float:
    """The count where each reading was rounded to ``digit_deg``: changes lie in clusters, a count apart."""
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
    # From the smallest change up: each tells the count better, as long as its own number is certain.
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


# A clock that is coarser than the sampling: several samples have one time, though the axis has moved on.


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
