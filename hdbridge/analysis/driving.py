"""Motor angle at which the effects are evaluated, without chatter, and its speed and acceleration.

A reversal counts only if the motor moves back by more than the chatter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from hdbridge.analysis.readings import (
    MOST_JITTER_DEG,
    ROUNDED_DEG,
    Reading,
    quantum_deg,
    reading_of,
    trimmed_deviation,
)
from hdbridge.axis.effects import FloatArray

REVERSAL_DEG = 0.3
"""Minimum travel on either side of a reversal, motor degrees. It is less than the width of the narrowest loop
considered (0.5, `effects.elastic_loop`) and several times the settling motion of a motor (0.07 in measured
records)."""
JITTER_SIGMAS = 8.0
"""Minimum travel on either side of a reversal, in standard deviations of the reading error."""


def steadied(path_deg: FloatArray, measured_deg: FloatArray, band_deg: float) -> FloatArray:
    """Removes reversals of the measured angle smaller than ``band_deg``.

    The resulting path is monotone between turning points. At each turning point it is clamped to the measured
    angle, because the maximum of many noisy angles overestimates the true one.
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
    """Counts the reversals in one record with sufficient travel on both sides (`REVERSAL_DEG`)."""
    if len(driving_deg) < 3:
        return 0
    band = max(REVERSAL_DEG, JITTER_SIGMAS * jitter_deg)
    steps = np.sign(np.diff(steadied(driving_deg, driving_deg, band)))
    return int(np.count_nonzero(np.diff(steps[steps != 0.0])))


# Driving angle, speed and acceleration of one record.


BoolArray = NDArray[np.bool_]

CHATTER_COUNTS = 2.6
"""Minimum backward travel of a reversal of a measured angle, counts. Noise of a third of a count makes a
reading flicker over two counts."""
LEAST_STILL = 20
"""Minimum number of samples at a constant command for estimating the noise of the motor reading."""
WINDOW_S = 0.03
"""Averaging window of speed and acceleration."""
LONGEST_S = 0.05
"""Longest window for the acceleration, because moves accelerate within a tenth of a second."""
SETTLE_S = 0.1
"""Time for the load to settle after a fast move: two periods of an oscillation at 20 Hz."""


class Driven(NamedTuple):
    """Motor motion in one record, as input of the effects; arrays of shape (n,)."""

    motor_deg: FloatArray
    speed_deg_s: FloatArray
    acceleration_deg_s2: FloatArray
    rested_deg: FloatArray
    """Motor angle if a resting motor is in the middle of its count. ``motor_deg`` assumes that it is as close
    to the command as the count allows. Without a command, both are equal."""


def reading_of_all(angle_deg: FloatArray, parts: Sequence[slice]) -> Reading:
    """Returns the resolution of an encoder: its noise from the longest part, its count from all parts."""
    largest = max(parts, key=lambda rows: rows.stop - rows.start)
    return replace(reading_of(angle_deg[largest]), count_deg=quantum_deg(angle_deg))


def settling(fast: BoolArray, time_s: FloatArray) -> BoolArray:
    """Returns a mask of the samples in fast moves and within `SETTLE_S` after them."""
    last = np.maximum.accumulate(np.where(fast, time_s, -np.inf))
    return np.asarray(fast | ((time_s - last < SETTLE_S) & (time_s >= last)))


def kinematics(position: FloatArray, target: FloatArray | None, time: FloatArray, reading: Reading) -> Driven:
    """Derives the driving angle, speed and acceleration of one record."""
    steps = np.diff(time)
    period_s = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0
    window = max(1, round(WINDOW_S / period_s)) | 1
    if len(time) < 4 * window:
        window = 1
    count = reading.resolution_deg if target is not None else reading.unaided_deg
    bent = window if window * period_s <= LONGEST_S else max(1, window - 2)
    driving = _driving(position, target, time, window, reading)
    speed, acceleration = _rates(_smooth(driving, window), driving, time, window, bent, exact=True)
    resting = _resting(driving if target is None else target, window)
    if count and target is None:
        # A flickering count is not motion. Less than half a count of travel over the span is rest.
        span = 4 * window + 1
        resting |= np.abs(_slope(driving, time, span)) * span * np.median(np.diff(time)) < 0.5 * count
    speed[resting] = acceleration[resting] = 0.0
    rested = driving if target is None else _rested(driving, position, resting, window, 0.5 * count)
    return Driven(driving, speed, acceleration, rested)


def _rested(
    driving: FloatArray, position: FloatArray, resting: BoolArray, window: int, band: float
) -> FloatArray:
    path = driving.copy()
    for first, end in _rests(resting):
        path[first:end] = uniform_filter1d(position[first:end], 2 * window + 1, mode="nearest")
    return steadied(path, path, band)


def _driving(
    position: FloatArray, target: FloatArray | None, time: FloatArray, window: int, reading: Reading
) -> FloatArray:
    """Returns the command plus a smooth estimate of the motor's lag, limited to the count that was read.

    Without a command, returns the measured angle without chatter.
    """
    if target is None:
        return steadied(position, position, CHATTER_COUNTS * reading.unaided_deg)
    count = reading.count_deg
    lag = position - target
    # The scale of the acceleration is irrelevant, because its contribution to the lag is fitted.
    speed, acceleration = _rates(target, target, time, window, window, exact=False)
    speed[_resting(target, window)] = 0.0
    columns = np.column_stack([np.ones(len(lag)), speed, acceleration])
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
    line = _fitted(columns / scale, lag, count, window)
    rest = lag - line
    noise = _noise(lag, target, count)
    if noise >= 0.5 * count and float(np.std(rest)) > 0.45 * count + 1e-6:
        line = line + uniform_filter1d(rest, 2 * window + 1, mode="nearest")
    # If the fit misses the cell of the reading (about a count wide), it does not determine the position
    # within the cell. Reading and fit are averaged, with weights from their variances.
    read = noise**2 + count**2 / 12.0
    cell = max(0.5 * count, 3.0 * noise)
    outside = np.abs(lag - line) > cell
    missed = uniform_filter1d(np.where(outside, (lag - line) ** 2, 0.0), 2 * window + 1, mode="nearest")
    line = lag + (read / (read + missed) if read else 1.0) * (line - lag)
    # The reading takes precedence if a motor sticks at a reversal or overshoots a stop.
    line = np.clip(line, lag - cell, lag + cell)
    line = _averaged_at_rest(line, lag, _resting(target, window), window, count, math.sqrt(read))
    # Within its cell, the path may move back without a true reversal, and noise moves the cell itself.
    band = max(CHATTER_COUNTS * reading.resolution_deg, 4.0 * cell)
    return steadied(target + line, target + line, band)


def _fitted(columns: FloatArray, lag: FloatArray, count: float, window: int) -> FloatArray:
    """Returns the combination of the columns (n, m) that fits a lag (n,) measured in whole counts.

    Readings are rounded. A motor that follows at a constant speed lags its set-points by a constant fraction
    of a count, so all its readings have the same rounding error. A run of equal lags is therefore a single
    observation. The misfit of the columns, for example in accelerations, is correlated over the window.
    """
    edges = np.flatnonzero(np.abs(np.diff(lag, prepend=np.inf, append=np.inf)) > ROUNDED_DEG)
    lengths = np.repeat(np.diff(edges), np.diff(edges))
    solution = np.linalg.lstsq(columns, lag, rcond=1e-9)[0]
    rounding = count**2 / 12.0
    if rounding:
        span = 2 * window + 1
        square = uniform_filter1d((lag - columns @ solution) ** 2, span, mode="nearest")
        weights = 1.0 / np.sqrt(lengths * rounding + span * np.maximum(square - rounding, 0.0))
        solution = np.linalg.lstsq(columns * weights[:, None], lag * weights, rcond=1e-9)[0]
    return np.asarray(columns @ solution)


def _averaged_at_rest(
    angle: FloatArray, reading: FloatArray, resting: BoolArray, window: int, count: float, error: float
) -> FloatArray:
    """Replaces an angle (n,) by the mean reading in each rest with a flickering reading.

    The largest reading of a resting encoder would look like a reversal. A rest begins when the reading stays
    within half a count plus three standard deviations, ``error``, of its mean over the second half of the
    rest. Later single readings may deviate further.
    """
    result, length = angle.copy(), 2 * window + 1
    for first, end in _rests(resting):
        rows = slice(max(first - window, 0), end + window)  # the whole span of constant command
        off = reading[rows] - np.mean(reading[(first + end) // 2 : end])
        smooth = uniform_filter1d(off, length, mode="nearest")
        settled = _after_last(np.abs(smooth) > 0.5 * count + 4.0 * error / math.sqrt(length))
        begin = rows.start + _after_last(np.abs(off[:settled]) > 0.5 * count + 3.0 * error)
        rest = reading[begin : rows.stop]
        if np.any(rest != rest[:1]):
            result[begin : rows.stop] = np.mean(rest)
    return result


def _rests(resting: BoolArray) -> Iterator[tuple[int, int]]:
    """Yields the index of the first sample of each rest, and the index after its last sample."""
    edges = np.flatnonzero(np.diff(resting, prepend=False, append=False)).tolist()
    yield from zip(edges[::2], edges[1::2], strict=True)


def _after_last(mask: BoolArray) -> int:
    """Returns the index after the last True value; 0 if no value is True."""
    return int(np.flatnonzero(mask)[-1]) + 1 if np.any(mask) else 0


def _noise(lag: FloatArray, target: FloatArray, count: float) -> float:
    """Returns the standard deviation of the motor reading beyond quantisation, degrees.

    In a fast move the lag itself changes within a few samples, which is not noise. The result is therefore
    limited to the noise at constant command. It is zero if counts are visible and the command is never
    constant.
    """
    third = np.diff(lag, 3)
    if not len(third):
        return 0.0
    moved = np.abs(np.diff(target)) > 0.0
    still = ~(moved[2:] | moved[1:-1] | moved[:-2])
    noise = min(trimmed_deviation(third), MOST_JITTER_DEG)
    if np.count_nonzero(still) >= LEAST_STILL:
        noise = min(noise, trimmed_deviation(third[still]))
    elif count:
        noise = 0.0
    return math.sqrt(max(noise**2 - count**2 / 12.0, 0.0))


def _smooth(values: FloatArray, window: int) -> FloatArray:
    return np.asarray(uniform_filter1d(values, window, mode="nearest"))


def _resting(angle: FloatArray, window: int) -> BoolArray:
    moved = np.abs(np.diff(angle, prepend=angle[:1])) > 1e-9
    near = np.convolve(moved.astype(np.float64), np.ones(2 * window + 1))
    return np.asarray(near[window : window + len(angle)] < 0.5)


def _rates(
    smooth: FloatArray, angle: FloatArray, time: FloatArray, window: int, bent: int, *, exact: bool
) -> tuple[FloatArray, FloatArray]:
    """Returns the speed of ``smooth`` over ``window`` and the acceleration of ``angle`` over ``bent``.

    At either end of the record the window is incomplete. There the acceleration is held constant, and the
    speed is extrapolated linearly.
    """
    speed, acceleration = _slope(smooth, time, window), _curvature(_smooth(angle, bent), time, bent)
    reach = 2 * max(1, window // 2)
    if len(time) > 3 * reach:
        if exact:
            acceleration[reach:-reach] = _unsmoothed(acceleration[reach:-reach], bent)
        for rows, inner in ((slice(0, reach), reach), (slice(-reach, None), -reach - 1)):
            acceleration[rows] = acceleration[inner]
            speed[rows] = speed[inner] + acceleration[inner] * (time[rows] - time[inner])
    return speed, acceleration


def _unsmoothed(means: FloatArray, window: int) -> FloatArray:
    """Corrects averaged accelerations for the second moment of the averaging weights, by second differences.

    At fifty samples per second, the averages are 5 % too small for a move that accelerates and decelerates
    within a third of a second. Fitted effects would be 5 % too large.
    """
    result = means.copy()
    # Second moments in samples: differences (triangle) plus smoothing (rectangle).
    moment = max(1, window // 2) ** 2 / 6.0 + (window**2 - 1) / 12.0
    bend = means[2 * window :] - 2.0 * means[window:-window] + means[: -2 * window]
    result[window:-window] -= 0.5 * moment / window**2 * bend
    return result


def _slope(values: FloatArray, time: FloatArray, window: int) -> FloatArray:
    """Returns the first derivative by central differences over a window."""
    half = max(1, window // 2)
    count = len(values)
    ahead = np.minimum(np.arange(count) + half, count - 1)
    back = np.maximum(np.arange(count) - half, 0)
    span = time[ahead] - time[back]
    result = np.zeros(count)
    np.divide(values[ahead] - values[back], span, out=result, where=span > 0.0)
    return result


def _curvature(values: FloatArray, time: FloatArray, window: int) -> FloatArray:
    """Returns the second derivative by second differences over a window; 0 near the ends."""
    half = max(1, window // 2)
    count = len(values)
    result = np.zeros(count)
    if count <= 2 * half:
        return result
    middle = slice(half, count - half)
    ahead, back = values[2 * half :] - values[middle], values[middle] - values[: count - 2 * half]
    after, before = time[2 * half :] - time[middle], time[middle] - time[: count - 2 * half]
    good = (after > 0.0) & (before > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = (ahead / after - back / before) / (0.5 * (after + before))
    result[middle] = np.where(good, bend, 0.0)
    return result
