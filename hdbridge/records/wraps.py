"""Finds angles that jump by a constant, because a counter wraps or the angle is limited to one turn.

A wrap is a jump in one angle only. At a join of concatenated records, both angles jump. All wraps have the
same size, whereas a misread sample is wrong by any amount and the next sample is right again.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from hdbridge.axis.effects import FloatArray
from hdbridge.records.columns import Unit
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN, rounded

LEAST_JUMP_DEG: Final = 900.0 / ARCSEC_PER_DEG
"""Minimum size of a jump, larger than any gear error."""
CONSTANT_SHARE: Final = 0.05
"""Maximum deviation of a jump from the mean jump of a counter, relative to the mean."""
NOMINAL_SHARE: Final = 0.02
"""Maximum uncertainty of a period, relative to the period."""
LEAST_TIMES: Final = 3.0
"""Minimum ratio of a jump to any other difference between the two angles' steps."""
SAME_SHARE: Final = 0.3
"""Maximum fraction of a jump that the motion of the other angle may explain; otherwise both have jumped."""
THERE_AND_BACK: Final = 2
"""Maximum length of a misreading, samples."""
WINDOW: Final = 5
"""Number of neighbouring steps whose median is the expected step."""
_PERIODS: Final = (DEG_PER_TURN, math.tau, 1.0, 21_600.0, 1_296_000.0, *(2.0**bits for bits in range(8, 33)))
"""One turn in each unit, and the ranges of binary counters."""


class Wraps(NamedTuple):
    """Jumps of a wrapping angle."""

    rows: NDArray[np.intp]
    """Index of the first sample after each jump."""
    period_deg: float
    """Period of the counter: the size of its jumps, or one turn if the jumps are multiples of a turn."""
    jump_deg: float
    """Measured size of the jumps, a whole number of periods."""
    tolerance_deg: float
    """Uncertainty of the period and the jump size."""


def find_wraps(angle_deg: FloatArray, other_deg: FloatArray, starts: Sequence[int] = (0,)) -> Wraps | None:
    """Finds jumps of constant size in an angle (n,) that do not occur in the axis's other angle (n,).

    Returns None without such jumps. They are accepted if they equal a whole turn or a power of two of counts,
    or if all of them are at the ends of one period, unlike lost counts of equal size. Steps to the first
    sample of a record (``starts``) are ignored.
    """
    if len(angle_deg) < 2 * WINDOW:
        return None
    step, other = np.diff(angle_deg), np.diff(other_deg)
    between = [start - 1 for start in starts if 0 < start < len(angle_deg)]
    step[between] = other[between] = 0.0
    excess = step - median_filter(step, WINDOW, mode="mirror")
    slip = step - _slope(step, other) * other
    alone = np.abs(slip - excess) <= SAME_SHARE * np.abs(excess)
    size = np.where(alone, np.abs(excess), 0.0)
    large = np.flatnonzero(size > max(0.5 * float(np.max(size)), LEAST_JUMP_DEG))
    jumps = _lasting(large, excess)
    if not len(jumps):
        return None
    sizes = np.abs(slip[jumps])
    jump = float(np.mean(sizes))
    turns = np.maximum(np.round(sizes / DEG_PER_TURN), 1.0)
    if np.all(np.abs(sizes / turns - DEG_PER_TURN) < CONSTANT_SHARE * DEG_PER_TURN):
        sizes = sizes / turns
    period = float(np.mean(sizes))
    calm = float(np.max(np.abs(np.delete(slip, large)), initial=0.0))
    if np.any(np.abs(sizes - period) > CONSTANT_SHARE * period) or LEAST_TIMES * calm > period:
        return None
    # An angle wraps at the same position each time. The gear error there is the same, so averaging over the
    # jumps does not reduce its effect.
    off = float(np.quantile(np.abs(np.delete(slip, large)), 0.99)) + float(np.std(sizes))
    wraps = Wraps(jumps + 1, period, jump, min(off, NOMINAL_SHARE * period))
    at_ends = len(jumps) > 1 and float(np.ptp(angle_deg[[jumps, jumps + 1]])) <= jump + off
    return wraps if at_ends or _nominal(wraps, 1.0, count_of(angle_deg)) else None


def period_in(unit: Unit, wraps: Wraps, angle_deg: FloatArray) -> float:
    """Returns the roundest period consistent with jumps and counts, in the unit of the angle's column."""
    scale = abs(unit.factor)
    count = count_of(angle_deg / unit.factor)
    binary = 2.0 ** round(math.log2(wraps.jump_deg / scale))
    if unit.name == "counts" and abs(binary * scale - wraps.jump_deg) <= wraps.tolerance_deg:
        return float(binary)
    if nominal := _nominal(wraps, scale, count):
        return nominal
    period, off = wraps.period_deg / scale, wraps.tolerance_deg / scale
    if count and off < 0.5 * count:
        return round(period / count) * count
    for digits in range(1, 13):
        round_period = rounded(period, digits)
        if abs(round_period - period) <= off:
            return round_period
    return period


def unwrapped(angle_deg: FloatArray, period_deg: float) -> FloatArray:
    """Unwraps an angle (n,); the result is correct if no step exceeds half the period."""
    return np.asarray(np.unwrap(angle_deg, period=period_deg))


def _nominal(wraps: Wraps, scale: float, count: float) -> float:
    """Returns the nearest nominal period (a turn in some unit, or a binary counter's range); else 0."""
    period, off = wraps.period_deg / scale, wraps.tolerance_deg / scale
    near = [each for each in _PERIODS if abs(each - period) <= max(off, 1e-6 * each)]
    if count and count != 1.0:
        counted = 2.0 ** round(math.log2(period / count)) * count
        near += [counted] if abs(counted - period) <= max(off, 1e-6 * counted) else []
    return min(near, key=lambda each: abs(each - period), default=0.0)


def _slope(step: FloatArray, other: FloatArray) -> float:
    """Returns the change of an angle per unit of the other angle, as the median over the larger steps."""
    size = np.abs(other)
    large = size > 0.5 * float(np.quantile(size, 0.9))
    return float(np.median(step[large] / other[large])) if np.any(large) else 0.0


def _lasting(jumps: NDArray[np.intp], excess: FloatArray) -> NDArray[np.intp]:
    """Returns the jumps that are not reversed within `THERE_AND_BACK` samples."""
    kept = np.ones(len(jumps), dtype=np.bool_)
    for place in range(len(jumps) - 1):
        out, back = jumps[place], jumps[place + 1]
        returned = abs(excess[out] + excess[back]) < CONSTANT_SHARE * abs(excess[out])
        if kept[place] and back - out <= THERE_AND_BACK and returned:
            kept[place : place + 2] = False
    return jumps[kept]


def count_of(values: FloatArray) -> float:
    """Returns the largest decimal number of which all steps are multiples; 0 if it is just the last digit."""
    for decimals in range(10):
        whole = np.round(values * 10.0**decimals)
        if np.all(np.abs(values * 10.0**decimals - whole) < 1e-4) and np.max(np.abs(whole)) < 2.0**53:
            count = int(np.gcd.reduce(np.diff(whole).astype(np.int64)))
            return 0.0 if decimals and count == 1 else count / 10.0**decimals
    return 0.0
