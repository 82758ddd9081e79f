"""Screens all candidates: scores them on the residual, with the current hypothesis projected out.

The score is the predicted decrease in chi square. With Q an orthonormal basis of the hypothesis's tangent and
C a candidate's columns, C'C - (Q'C)'(Q'C) is the remaining Gram matrix. One matrix product serves all
columns, so a grid of hundreds of shapes takes no longer than one fit. A direction whose remaining fraction is
below `SHARE_LEFT` is not visible in the record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import Linearised
from hdbridge.analysis.readings import median_deviation
from hdbridge.axis.effects import (
    CATALOGUE,
    Effect,
    FloatArray,
    Observations,
    Sought,
    Start,
    causes,
    missing_channels,
)
from hdbridge.axis.effects.orders import HIGHEST_MOTOR_ORDER
from hdbridge.units import DEG_PER_TURN

SHARE_LEFT = 1e-4
"""Minimum fraction of a column's sum of squares left by the hypothesis; below it, the column is explained."""


def candidates(observations: Observations, base: Sequence[Effect], screened: bool = True) -> list[Effect]:
    """Returns the catalogue's candidates for a record and the model ``base``, over grids of shape parameters.

    Only candidates whose channels were recorded are included. Their coefficients are arbitrary. With
    ``screened``, only additions to the model that a grid covers are included.
    """
    kinds = [CATALOGUE[each] for each in causes()]
    if screened:
        kinds = [each for each in kinds if each.changes is None and each.sought is None]
    return [each for kind in kinds for each in proposed(kind, observations, base)]


def proposed(kind: type[Effect], observations: Observations, base: Sequence[Effect] = ()) -> list[Effect]:
    """Returns a kind's proposals for a record and the model ``base``; none if its channels are missing."""
    available = observations.motion.available()
    return [each for each in kind.proposals(observations, base) if not missing_channels([each], available)]


@dataclass(frozen=True, slots=True)
class Score:
    """Predicted gain of adding a candidate to the hypothesis."""

    effect: Effect
    gain: float
    """Predicted decrease in chi square, from the linearised fit."""
    freedom: int
    """Number of directions of the candidate's columns that the hypothesis does not span."""
    share: float
    """Largest fraction of a column's sum of squares that the causes in the hypothesis do not explain.

    The model's own parts do not count as causes, because their calibration limits their size."""


class Screen:
    """Weighted columns of all candidates, computed once."""

    def __init__(self, estimator: Estimator, candidates: Sequence[Effect], start: Start) -> None:
        self._candidates = tuple(candidates)
        blocks = [estimator.weighted(estimator.columns(each, start)) for each in candidates]
        self._slices: list[slice] = []
        at = 0
        for block in blocks:
            self._slices.append(slice(at, at + block.shape[1]))
            at += block.shape[1]
        self._matrix = np.hstack(blocks) if blocks else np.empty((len(estimator.index), 0))
        self._grams = [block.T @ block for block in blocks]

    def scores(self, fit: Linearised, causes: Linearised) -> list[Score]:
        """Returns the score of each candidate, in the order of the candidates.

        ``causes`` is the fit without the model's own parts.
        """
        matrix = self._matrix
        shadow = fit.basis.T @ matrix
        moment = matrix.T @ fit.residual - shadow.T @ fit.slack
        taken = np.sum((causes.basis.T @ matrix) ** 2, axis=0)
        return [
            _score(effect, np.diag(gram), gram - shadow[:, at].T @ shadow[:, at], moment[at], taken[at])
            for effect, gram, at in zip(self._candidates, self._grams, self._slices, strict=True)
        ]


def score_of(effect: Effect, columns: FloatArray, fit: Linearised, causes: Linearised) -> Score:
    """Scores one candidate, given its weighted columns; ``causes`` is the fit without the model's parts."""
    taken = np.sum((causes.basis.T @ columns) ** 2, axis=0)
    return _score(effect, np.sum(columns**2, axis=0), *fit.left(columns), taken)


def _score(
    effect: Effect, size: FloatArray, gram: FloatArray, moment: FloatArray, taken: FloatArray
) -> Score:
    """Computes a score.

    ``size`` and ``taken`` are the total and the explained sum of squares of each column. ``gram`` and
    ``moment`` exclude the part that the hypothesis explains.
    """
    seen = size > 0.0
    if not np.any(seen):
        return Score(effect, 0.0, 0, 0.0)
    share = float(np.max(1.0 - taken[seen] / size[seen]))
    scale = np.sqrt(size[seen])
    left = gram[np.ix_(seen, seen)] / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(left)
    kept = values > SHARE_LEFT
    if not np.any(kept):
        return Score(effect, 0.0, 0, share)
    inner = vectors[:, kept].T @ (moment[seen] / scale)
    return Score(effect, float(np.sum(inner**2 / values[kept])), int(np.count_nonzero(kept)), share)


# Matched filters for effects that can be at any location (`Sought`), evaluated at all locations at once.


BINS = 1 << 17
DEFECT_BINS = 3600
HALF_WIDTHS_DEG = (0.5, 1.2, 2.5, 4.0, 6.5, 10.0)
"""Grid of the searches over position. A fit refines the result, and `Scales` decides whether to report it."""
LEAST_LINES = 256
"""Minimum number of lines per turn of an encoder with interpolation."""
LINE_OVER_MEAN = 12.0
"""Minimum power of a spectral line for a fit, relative to the mean power. Such a line lowers chi square by
twice this number, about half of the required gain."""
LOWEST_HZ = 0.3
"""Lowest frequency of a tone; slower spectral lines are due to the motion itself."""
PEAKS = 3
"""Maximum number of spectral lines to fit, the highest first."""


def filtered(estimator: Estimator, fitted: Fitted) -> list[Effect]:
    """Returns the best candidates of the kinds for which matched filters search."""
    residual, load_deg = fast_residual(estimator, fitted)
    estimator.with_load_angle(load_deg)
    result: list[Effect] = []
    shapes: Iterator[tuple[float, ...]]
    for kind in CATALOGUE.values():
        match kind.sought:
            case Sought.STEP:
                shapes = step(estimator, fitted)
            case Sought.BUMP:
                shapes = bump(estimator, fitted)
            case Sought.TONE:
                shapes = tones(estimator, residual)
            case Sought.LINE:
                lines = load_lines(estimator, residual, load_deg)
                result += [each for at in lines for each in kind.at_lines(at)]
                continue
            case _:
                continue
        example = kind.candidate(estimator.data.ratio)
        one = np.ones(len(example.coefficients()))
        names = [each.name for each in kind.shape]
        for each in shapes:
            shape = dict(zip(names, each, strict=True))
            result.append(example.fitted(one, shape))
    return result


def step(estimator: Estimator, fitted: Fitted) -> Iterator[tuple[float]]:
    """Yields the time (s) of the single step that fits best, with the hypothesis projected out."""
    weight, basis = estimator.weight, fitted.linearised.basis
    after = np.cumsum((weight * fitted.residual)[::-1])[::-1]
    square = np.cumsum((weight**2)[::-1])[::-1]
    left = square.copy()
    for column in basis.T:
        left -= np.cumsum((weight * column)[::-1])[::-1] ** 2
    edge = max(len(weight) // 500, 5)
    usable = left > 1e-3 * np.minimum(square, square[0] - square + 1e-300)
    usable[:edge] = usable[-edge:] = False
    if not np.any(usable):
        return
    gain = np.where(usable, after**2 / np.maximum(left, 1e-300), 0.0)
    place = int(np.argmax(gain))
    data = estimator.data
    first = data.runs[estimator.index[place]]  # first sample of the point at which the step appears
    yield (float(data.full.time_s[first]),)


def bump(estimator: Estimator, fitted: Fitted) -> Iterator[tuple[float, float]]:
    """Yields the centre and half width (load degrees) of the bump that fits best.

    Bumps over most of the travel are excluded.
    """
    ratio = estimator.data.ratio
    load = estimator.motion.motor_deg[estimator.index] / ratio
    place = np.floor(np.mod(load, DEG_PER_TURN) * (DEFECT_BINS / DEG_PER_TURN)).astype(np.intp) % DEFECT_BINS
    weight = estimator.weight

    def binned(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, values, DEFECT_BINS), dtype=np.float64)

    moments = binned(weight * fitted.residual)
    squares = binned(weight**2)
    shadows = np.stack([binned(weight * each) for each in fitted.linearised.basis.T])
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
    if best is not None and best[0] > 0.0:
        yield best[1:]


def _bump(half_deg: float) -> FloatArray:
    away = np.arange(DEFECT_BINS) * (DEG_PER_TURN / DEFECT_BINS)
    away = np.minimum(away, DEG_PER_TURN - away)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.minimum(away / half_deg, 1.0)))


def fast_residual(estimator: Estimator, fitted: Fitted) -> tuple[FloatArray, FloatArray]:
    """Returns the clipped residual of each sample (0 if unusable), and the predicted load angle."""
    full = estimator.data.full
    predicted = estimator.predicted(fitted)
    residual = np.where(full.usable, full.error_arcsec - predicted, 0.0)
    # The clipping limits are derived from fast variations only.
    window = 9
    smooth = np.convolve(residual, np.ones(window) / window, mode="same")
    spread = 6.0 * median_deviation(residual - smooth) + 1e-9
    load = full.motion.motor_deg / estimator.data.ratio + predicted / 3600.0
    return np.clip(residual, -40.0 * spread, 40.0 * spread), np.asarray(load)


def tones(estimator: Estimator, residual: FloatArray) -> Iterator[tuple[float]]:
    """Yields the frequencies (Hz) of the highest spectral lines in time."""
    data = estimator.data
    time_s = data.full.time_s
    slot = np.round((time_s - time_s[0]) / data.period_s).astype(np.int64)
    length = int(slot[-1]) + 1
    if length > 4 * len(time_s) + 1000 or length < 64:
        return
    size = 1 << int(np.ceil(np.log2(length)) + 2)
    grid = np.bincount(slot, residual, length)
    power = np.abs(np.fft.rfft(grid, size)) ** 2
    frequency = np.arange(len(power)) / (size * data.period_s)
    # At least two periods are needed; fewer are only curvature. Similar moves have similar curvature, so the
    # duration of the data with one encoder zero is decisive.
    unbroken = min(length, int(np.max(np.bincount(data.full.zero))))
    power[frequency < max(LOWEST_HZ, 2.0 / (unbroken * data.period_s))] = 0.0
    lobe = max(4, size // length * 4)
    for at in _highest(power, lobe, 0.0):
        yield (float(frequency[at] + _off_centre(np.sqrt(power), at) * frequency[1]),)


def _highest(power: FloatArray, lobe: int, least: float) -> Iterator[int]:
    """Yields the indices of the peaks above ``least``, highest first, more than ``lobe`` samples apart."""
    left = power.copy()
    for _ in range(PEAKS):
        at = int(np.argmax(left))
        if left[at] <= least:
            return
        yield at
        left[max(at - lobe, 0) : at + lobe + 1] = 0.0


def _off_centre(height: FloatArray, at: int) -> float:
    """Returns the offset of a peak from its highest sample, in samples, by a three-point parabola."""
    if not 0 < at < len(height) - 1:
        return 0.0
    left, middle, right = (float(each) for each in height[at - 1 : at + 2])
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def load_lines(estimator: Estimator, residual: FloatArray, load_deg: FloatArray) -> Iterator[int]:
    """Yields the numbers of periods per load turn of the highest spectral lines above the gear's orders."""
    place = np.floor(np.mod(load_deg, DEG_PER_TURN) * (BINS / DEG_PER_TURN)).astype(np.intp) % BINS
    power = np.abs(np.fft.rfft(np.bincount(place, residual, BINS))) ** 2
    ratio = estimator.data.ratio
    power[: int(max(LEAST_LINES, 1.05 * HIGHEST_MOTOR_ORDER * (ratio + 1)))] = 0.0
    least = LINE_OVER_MEAN * float(np.mean(power[power > 0.0])) if np.any(power > 0.0) else 0.0
    yield from _highest(power, 3, least)
