"""Where a motor reverses: a turn counts only when it comes back by more than chatter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from hdbridge.analysis.readings import Reading, quantum_deg, reading_of, third_deviation
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


# The angle that drives the effects, its speed and its acceleration, of one record.


BoolArray = NDArray[np.bool_]

CHATTER_COUNTS = 2.6
"""A measured angle counts as reversed when it has come back by more than this many counts: noise of a third
of one flickers over two."""
WINDOW_S = 0.03
"""Speed and acceleration are means over so long."""
LONGEST_S = 0.05
"""... of the acceleration no longer than this: moves speed up in a tenth of a second."""
SETTLE_S = 0.1
"""After a fast move the load is left this much time to come to rest: two periods of a load that swings at
20 Hz."""


class Driven(NamedTuple):
    """What drove the axis in one record, arrays of shape (n,)."""

    motor_deg: FloatArray
    speed_deg_s: FloatArray
    acceleration_deg_s2: FloatArray
    rested_deg: FloatArray
    """The angle if at rest the motor stood in the middle of the counts that it was read in, and not as near
    to where it was told to be as they allow; the same without a command.
    """


def reading_of_all(angle_deg: FloatArray, parts: Sequence[slice]) -> Reading:
    """How finely the motor's angle was read: one encoder for all parts, so the one that saw it best tells."""
    largest = max(parts, key=lambda rows: rows.stop - rows.start)
    return replace(reading_of(angle_deg[largest]), count_deg=quantum_deg(angle_deg))


def settling(fast: BoolArray, time_s: FloatArray) -> BoolArray:
    """The samples of fast moves, and those within `SETTLE_S` after."""
    last = np.maximum.accumulate(np.where(fast, time_s, -np.inf))
    return np.asarray(fast | ((time_s - last < SETTLE_S) & (time_s >= last)))


def kinematics(position: FloatArray, target: FloatArray | None, time: FloatArray, reading: Reading) -> Driven:
    """What drove the axis in one record."""
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
        # Counts that come and go are no motion: less than half a count over eight windows is rest.
        span = 4 * window + 1
        resting |= np.abs(_slope(driving, time, span)) * span * np.median(np.diff(time)) < 0.5 * count
    speed[resting] = acceleration[resting] = 0.0
    rested = driving if target is None else _rested(driving, position, resting, window, 0.5 * count)
    return Driven(driving, speed, acceleration, rested)


def _rested(
    driving: FloatArray, position: FloatArray, resting: BoolArray, window: int, band: float
) -> FloatArray:
    path = driving.copy()
    edges = np.flatnonzero(np.diff(resting, prepend=False, append=False))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        path[first:end] = uniform_filter1d(position[first:end], 2 * window + 1, mode="nearest")
    return steadied(path, path, band)


def _driving(
    position: FloatArray, target: FloatArray | None, time: FloatArray, window: int, reading: Reading
) -> FloatArray:
    """The command and a smooth line for the lag behind it, within the cell that the encoder was read in;
    without a command the angle freed of chatter.
    """
    if target is None:
        return steadied(position, position, CHATTER_COUNTS * reading.unaided_deg)
    count = reading.count_deg
    lag = position - target
    # How large the acceleration is does not matter here: its part of the lag is fitted.
    speed, acceleration = _rates(target, target, time, window, window, exact=False)
    speed[_resting(target, window)] = 0.0
    columns = np.column_stack([np.ones(len(lag)), speed, acceleration])
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
    solution = np.linalg.lstsq(columns / scale, lag, rcond=1e-9)[0] / scale
    line = columns @ solution
    rest = lag - line
    noise = _noise(lag, count)
    if noise >= 0.5 * count and float(np.std(rest)) > 0.45 * count + 1e-6:
        line = line + uniform_filter1d(rest, 2 * window + 1, mode="nearest")
    # A motor that sticks where it reverses, or overshoots where it stops, is where its encoder says.
    cell = max(0.5 * count, 3.0 * noise)
    line = np.clip(line, lag - cell, lag + cell)
    # Without a reversal the path may change sides of its cell, and the cell moves with a noisy reading.
    band = max(CHATTER_COUNTS * reading.resolution_deg, 4.0 * cell)
    return steadied(target + line, target + line, band)


def _noise(lag: FloatArray, count: float) -> float:
    """Noise of the motor's reading in addition to that of its counts, degrees."""
    if len(lag) < 4:
        return 0.0
    return math.sqrt(max(third_deviation(np.diff(lag, 3)) ** 2 - count**2 / 12.0, 0.0))


def _smooth(values: FloatArray, window: int) -> FloatArray:
    return np.asarray(uniform_filter1d(values, window, mode="nearest"))


def _resting(angle: FloatArray, window: int) -> BoolArray:
    moved = np.abs(np.diff(angle, prepend=angle[:1])) > 1e-9
    near = np.convolve(moved.astype(np.float64), np.ones(2 * window + 1))
    return np.asarray(near[window : window + len(angle)] < 0.5)


def _rates(
    smooth: FloatArray, angle: FloatArray, time: FloatArray, window: int, bent: int, *, exact: bool
) -> tuple[FloatArray, FloatArray]:
    """Speed of ``smooth`` over one window, and acceleration of ``angle`` over the other.

    A record that begins or ends in motion has no window on its far side: there the acceleration goes on as it
    was, and the speed with it.
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
    """Accelerations without what the second moment of their weights has made of them, by second differences.

    An effect comes out larger by as much as the means leave out: a twentieth, where a move speeds up and
    slows down in a third of a second and is seen fifty times in one.
    """
    result = means.copy()
    # In samples: that of the differences, a triangle, and that of the smoothing, a rectangle.
    moment = max(1, window // 2) ** 2 / 6.0 + (window**2 - 1) / 12.0
    bend = means[2 * window :] - 2.0 * means[window:-window] + means[: -2 * window]
    result[window:-window] -= 0.5 * moment / window**2 * bend
    return result


def _slope(values: FloatArray, time: FloatArray, window: int) -> FloatArray:
    """Central differences."""
    half = max(1, window // 2)
    count = len(values)
    ahead = np.minimum(np.arange(count) + half, count - 1)
    back = np.maximum(np.arange(count) - half, 0)
    span = time[ahead] - time[back]
    result = np.zeros(count)
    np.divide(values[ahead] - values[back], span, out=result, where=span > 0.0)
    return result


def _curvature(values: FloatArray, time: FloatArray, window: int) -> FloatArray:
    """Second differences, as near to the sample as the window allows."""
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
