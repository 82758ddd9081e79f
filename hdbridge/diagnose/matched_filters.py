"""Seekers: causes with a shape that no grid covers, each found over all its values at once.

Lost counts: a step at every sample, by cumulative sums. Local defects: a bump at every load angle, by
convolution over one load turn. Vibration: a Fourier transform over absolute time with the gaps left empty.
Interpolation errors: a Fourier transform over one load turn at the *predicted* load angle, 2^17 bins.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hdbridge.diagnose.candidates import HIGHEST_MOTOR_ORDER
from hdbridge.effects import CountLoss, Effect, FloatArray, LocalDefect, Step, SubdivisionalError, Vibration
from hdbridge.effects.orders import orders_from
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.screening import Candidate
from hdbridge.observations.reading import median_deviation
from hdbridge.units import DEG_PER_TURN

BINS = 1 << 17
DEFECT_BINS = 3600
HALF_WIDTHS_DEG = (0.5, 1.2, 2.5, 4.0, 6.5, 10.0)
LEAST_LINES = 256
LOWEST_HZ = 0.3
PEAKS = 3
FOOT_LINES = 50.0
"""Lines of the record's resolution next to a vibration that are taken for its feet."""
LINE_OVER_MEAN = 12.0
"""A line is looked at when its power is so many times the mean: noise alone reaches 11 in 65,000 lines."""


def count_loss(estimator: Estimator, fitted: Fitted) -> Candidate | None:
    """The best single step, at any sample; exact, with the hypothesis projected out."""
    weight, basis = estimator.weight, fitted.basis
    after = np.cumsum((weight * fitted.residual)[::-1])[::-1]
    square = np.cumsum((weight**2)[::-1])[::-1]
    left = square.copy()
    for column in basis.T:
        left -= np.cumsum((weight * column)[::-1])[::-1] ** 2
    edge = max(len(weight) // 500, 5)
    usable = left > 1e-3 * np.minimum(square, square[0] - square + 1e-300)
    usable[:edge] = usable[-edge:] = False
    if not np.any(usable):
        return None
    gain = np.where(usable, after**2 / np.maximum(left, 1e-300), 0.0)
    place = int(np.argmax(gain))
    data = estimator.data
    assert data.full.motion.time_s is not None
    first = data.runs[estimator.index[place]]  # of the samples of the point at which it is seen
    step = Step(time_s=float(data.full.motion.time_s[first]), size_arcsec=1.0)
    return Candidate("count_loss", CountLoss(steps=(step,)))


def local_defect(estimator: Estimator, fitted: Fitted) -> Candidate | None:
    """The best bump; it must lie on several passes, and not cover most of the travel."""
    ratio = estimator.data.ratio
    load = estimator.motion.motor_deg[estimator.index] / ratio
    place = np.floor(np.mod(load, DEG_PER_TURN) * (DEFECT_BINS / DEG_PER_TURN)).astype(np.intp) % DEFECT_BINS
    weight = estimator.weight

    def binned(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, values, DEFECT_BINS), dtype=np.float64)

    moments = binned(weight * fitted.residual)
    squares = binned(weight**2)
    shadows = np.stack([binned(weight * each) for each in fitted.basis.T])
    best: tuple[float, float, float] | None = None
    for half in HALF_WIDTHS_DEG:
        kernel = np.fft.rfft(_bump(half))
        square_kernel = np.fft.rfft(_bump(half) ** 2)

        def over(values: FloatArray, kernel: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> FloatArray:
            return np.asarray(np.fft.irfft(np.fft.rfft(values, axis=-1) * kernel, DEFECT_BINS, axis=-1))

        total = over(squares, square_kernel)
        left = total - np.sum(over(shadows, kernel) ** 2, axis=0)
        good = left > np.maximum(0.02 * total, 1e-6 * float(np.max(total)))
        gain = np.where(good, over(moments, kernel) ** 2 / np.maximum(left, 1e-300), 0.0)
        at = int(np.argmax(gain))
        if best is None or gain[at] > best[0]:
            best = (float(gain[at]), at * DEG_PER_TURN / DEFECT_BINS, half)
    if best is None or best[0] <= 0.0:
        return None
    effect = LocalDefect(ratio=ratio, height_arcsec=1.0, centre_deg=best[1], half_width_deg=best[2])
    return Candidate("local_defect", effect)


def is_met(effect: LocalDefect, estimator: Estimator) -> bool:
    """Whether the axis went over the place several times, in both directions or at different speeds.

    Passes that are all alike cannot distinguish a place from a moment of the move.
    """
    motion = estimator.motion
    if motion.motor_speed_deg_s is None or motion.time_s is None:
        return False
    turns = (motion.motor_deg / effect.ratio - effect.centre_deg) / DEG_PER_TURN
    # Between two records the axis may have jumped over it: faster than it ever went.
    steps, moved = np.diff(motion.time_s), np.abs(np.diff(motion.motor_deg))
    real = moved <= 3.0 * float(np.max(np.abs(motion.motor_speed_deg_s))) * steps
    speed = motion.motor_speed_deg_s[np.flatnonzero((np.diff(np.floor(turns)) != 0.0) & real)]
    fast = np.abs(speed[speed != 0.0])
    if len(fast) < 3:
        return False
    both = bool(np.any(speed > 0.0) and np.any(speed < 0.0)) and estimator.data.reversals >= 2
    return both or float(np.max(fast)) > 1.5 * float(np.min(fast))


def _bump(half_deg: float) -> FloatArray:
    away = np.arange(DEFECT_BINS) * (DEG_PER_TURN / DEFECT_BINS)
    away = np.minimum(away, DEG_PER_TURN - away)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.minimum(away / half_deg, 1.0)))


def fast_residual(estimator: Estimator, fitted: Fitted) -> tuple[FloatArray, FloatArray]:
    """Residual of every sample, and the predicted load angle there; zero where it is not usable."""
    full = estimator.data.full
    predicted = estimator.predicted(fitted)
    residual = np.where(full.usable, full.error_arcsec - predicted, 0.0)
    # What is slow is none of the business of those who ask for this, and would leak into their peaks.
    window = 9
    smooth = np.convolve(residual, np.ones(window) / window, mode="same")
    spread = 6.0 * median_deviation(residual - smooth) + 1e-9
    load = full.motion.motor_deg / estimator.data.ratio + predicted / 3600.0
    return np.clip(residual, -40.0 * spread, 40.0 * spread), np.asarray(load)


def vibrations(
    estimator: Estimator, residual: FloatArray, present: Sequence[Effect] = ()
) -> Iterator[Candidate]:
    """The highest lines over absolute time, apart from the feet of those ``present``.

    A line that swells and fades, as the axis stands or moves, has feet, and is one source all the same.
    """
    data = estimator.data
    time_s = data.full.motion.time_s
    assert time_s is not None
    slot = np.round((time_s - time_s[0]) / data.period_s).astype(np.int64)
    length = int(slot[-1]) + 1
    if length > 4 * len(time_s) + 1000 or length < 64:
        return
    size = 1 << int(np.ceil(np.log2(length)) + 2)
    grid = np.bincount(slot, residual, length)
    power = np.abs(np.fft.rfft(grid, size)) ** 2
    frequency = np.arange(len(power)) / (size * data.period_s)
    # Less than two periods of it are a bend, not a frequency. Moves that are alike bend alike: only what lies
    # about one zero counts together.
    unbroken = min(length, int(np.max(np.bincount(data.full.zero))))
    power[frequency < max(LOWEST_HZ, 2.0 / (unbroken * data.period_s))] = 0.0
    lobe = max(4, size // length * 4)
    for each in present:
        if isinstance(each, Vibration):
            power[np.abs(frequency - each.frequency_hz) < FOOT_LINES / (length * data.period_s)] = 0.0
    for _ in range(PEAKS):
        at = int(np.argmax(power))
        if power[at] <= 0.0:
            return
        best = frequency[at] + _off_centre(np.sqrt(power), at) * frequency[1]
        yield Candidate("vibration", Vibration(frequency_hz=float(best), amplitude_arcsec=1.0, phase_deg=0.0))
        power[max(at - lobe, 0) : at + lobe + 1] = 0.0


def _off_centre(height: FloatArray, at: int) -> float:
    """Where the top of a peak lies next to its highest sample, in samples: that of the parabola through
    three.
    """
    if not 0 < at < len(height) - 1:
        return 0.0
    left, middle, right = (float(each) for each in height[at - 1 : at + 2])
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def interpolation_errors(
    estimator: Estimator, residual: FloatArray, load_deg: FloatArray
) -> Iterator[Candidate]:
    """The highest lines over one load turn, beyond the orders of the mesh."""
    place = np.floor(np.mod(load_deg, DEG_PER_TURN) * (BINS / DEG_PER_TURN)).astype(np.intp) % BINS
    power = np.abs(np.fft.rfft(np.bincount(place, residual, BINS))) ** 2
    ratio = estimator.data.ratio
    power[: int(max(LEAST_LINES, 1.05 * HIGHEST_MOTOR_ORDER * (ratio + 1)))] = 0.0
    least = LINE_OVER_MEAN * float(np.mean(power[power > 0.0])) if np.any(power > 0.0) else 0.0
    for _ in range(PEAKS):
        at = int(np.argmax(power))
        if power[at] <= least:
            return
        for numbers in ((1,), (1, 2, 4)):
            yield Candidate(
                "subdivisional_error",
                SubdivisionalError(lines_per_turn=at, orders=orders_from(numbers)),
            )
        for part in (2, 4):
            if at % part == 0 and at // part >= LEAST_LINES:
                few = (1, 2) if part == 2 else (1, 2, 4)
                yield Candidate(
                    "subdivisional_error",
                    SubdivisionalError(lines_per_turn=at // part, orders=orders_from(few)),
                )
        power[max(at - 3, 0) : at + 4] = 0.0


def with_load_angle(estimator: Estimator, load_deg: FloatArray) -> None:
    """Make the predicted load angle what effects of the load encoder's lines count on."""
    data = estimator.data
    full = replace(data.full, motion=replace(data.full.motion, load_deg=load_deg))
    points = full
    if len(data.points) < len(full):
        mean = data.mean(load_deg)
        points = replace(data.points, motion=replace(data.points.motion, load_deg=mean))
    estimator.data = replace(data, full=full, points=points)
    estimator.load_angles += 1
