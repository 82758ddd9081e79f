"""Noise that is not white, and least squares that know it.

Four parts: white noise (its size may differ between standing and moving), a slow wander in time, a wander
over the motor's *travel*: an axis rests anywhere within a count of its encoder, the same way as long as it
stands and another way at the next stop; and what rounding to counts leaves over a whole leg, of a size that
the count gives. The wanders are first-order Markov processes, so the inverse of their covariance is banded,
and a fit costs no more than one with white noise (Rybicki and Press 1995).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

from hdbridge.analysis.blocks import Blocks
from hdbridge.effects import BoolArray, FloatArray, IntArray

PIECES = 16
PIECE_BLOCKS = 250
SMALLEST_ARCSEC = 1e-3
DIFFERENCE = 1e-4
"""Step of the likelihood's slopes, in logarithms: the rounding of a smaller one stops the fit on its way."""
COLUMNS_AT_ONCE = 8
CHAINS_KEPT = 8
"""A slope of the likelihood needs two at each length and one at a step from it."""
SAME_LEG = 1e-8
"""A block's step along a wander that stays the same over a leg: as good as none."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviations and correlation lengths."""

    standing_arcsec: float
    """White, of one sample, at rest."""
    moving_arcsec: float
    """White, of one sample, in motion."""
    slow_arcsec: float = 0.0
    slow_s: float = 10.0
    """Wander in time: its size, and the time in which it forgets."""
    place_arcsec: float = 0.0
    place_deg: float = 0.1
    """Wander over the motor's travel: its size, and the travel over which it forgets."""

    def white_variance(self, blocks: Blocks) -> FloatArray:
        """Of each block's mean; infinite for blocks without samples."""
        sample = np.where(blocks.moving, self.moving_arcsec, self.standing_arcsec) ** 2
        mean = np.divide(sample, blocks.count, out=np.full(len(blocks), np.inf), where=blocks.count > 0)
        return np.asarray(mean + blocks.blur)


BEGIN = NoiseModel(1.0, 1.0, 1.0, 10.0, 1.0, 0.3)
"""Where a fit of it begins; it ends where it would from any other."""


class White:
    """The inverse covariance of independent noise."""

    def __init__(self, weight: FloatArray) -> None:
        """``weight`` is one over the standard deviation of each row, shape (m,)."""
        self._precision = weight**2

    def apply(self, columns: FloatArray) -> FloatArray:
        """K^-1 times columns of shape (m,) or (m, p)."""
        return np.asarray(
            (self._precision if columns.ndim == 1 else self._precision[:, np.newaxis]) * columns
        )


class _Chain(NamedTuple):
    """A wander of unit size along some blocks: its inverse covariance, and what a block's mean has of it."""

    diagonal: FloatArray
    off_diagonal: FloatArray
    log_determinant: float
    load: FloatArray


class _Wanders:
    """The chains of some blocks. A search for a noise model asks for the same length again and again."""

    def __init__(self, blocks: Blocks) -> None:
        self._blocks = blocks
        self._fresh = np.diff(blocks.chain) != 0
        self._kept: dict[object, _Chain] = {}

    def in_time(self, length_s: float) -> _Chain:
        """The slow wander."""
        blocks = self._blocks
        return self._once(("time", length_s), lambda: self._along(blocks.time_s, blocks.duration_s, length_s))

    def in_place(self, length_deg: float) -> _Chain:
        """The wander over the motor's travel."""
        blocks = self._blocks
        return self._once(
            ("place", length_deg), lambda: self._along(blocks.travel_deg, blocks.extent_deg, length_deg)
        )

    def over_legs(self) -> _Chain:
        """What stays the same over a leg, of the size that the blocks say."""
        blocks = self._blocks
        return self._once(
            "leg",
            lambda: _chain(np.where(np.diff(blocks.leg) != 0, np.inf, SAME_LEG), blocks.locked_arcsec),
        )

    def _along(self, place: FloatArray, extent: FloatArray, length: float) -> _Chain:
        way = np.maximum(np.abs(np.diff(place)), 1e-9 * length) / length
        return _chain(np.where(self._fresh, np.inf, way), np.sqrt(_averaged(extent / length)))

    def _once(self, key: object, make: Callable[[], _Chain]) -> _Chain:
        if key not in self._kept:
            if len(self._kept) >= CHAINS_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = make()
        return self._kept[key]


def _chain(step: FloatArray, load: FloatArray) -> _Chain:
    """By the steps from block to block in correlation lengths; infinite where nothing is left."""
    spread = -np.expm1(-2.0 * step)
    decay = np.exp(-step)
    diagonal = np.ones(len(load))
    diagonal[:-1] += decay**2 / spread
    diagonal[1:] += decay**2 / spread
    return _Chain(diagonal, -decay / spread, float(-np.sum(np.log(spread))), load)


class Precision:
    """The inverse covariance of the noise of some blocks, applied without ever being written out.

    K = W + H S H', W white, S of the wanders. By Woodbury, with P = S^-1 (tridiagonal for each wander),
    K^-1 = w - w H (P + H' w H)^-1 H' w, and the bracket is banded.
    """

    def __init__(
        self,
        noise: NoiseModel,
        blocks: Blocks,
        left_out: BoolArray | None = None,
        wanders: _Wanders | None = None,
    ) -> None:
        """Blocks in ``left_out`` count as not observed; ``wanders`` are those of the blocks, where known."""
        weight = 1.0 / noise.white_variance(blocks)
        if left_out is not None:
            weight = np.where(left_out, 0.0, weight)
        self.weight: FloatArray = weight
        self._log_determinant = float(np.sum(np.log(weight[weight > 0])))
        wanders = wanders or _Wanders(blocks)
        chains: list[_Chain] = []
        self._loads: list[FloatArray] = []
        if noise.slow_arcsec > 0:
            chains.append(wanders.in_time(noise.slow_s))
            self._loads.append(noise.slow_arcsec * chains[-1].load)
        if noise.place_arcsec > 0:
            chains.append(wanders.in_place(noise.place_deg))
            self._loads.append(noise.place_arcsec * chains[-1].load)
        if np.any(blocks.locked_arcsec):
            chains.append(wanders.over_legs())
            self._loads.append(chains[-1].load)
        for chain in chains:
            self._log_determinant += chain.log_determinant
        self._factor = self._factored(chains) if chains else None

    def _factored(self, chains: list[_Chain]) -> FloatArray:
        """Cholesky factor of the bracket, wanders interleaved."""
        width, count = len(chains), len(self.weight)
        band = np.zeros((width + 1, width * count))
        for number, chain in enumerate(chains):
            band[0, number::width] = chain.diagonal + self.weight * self._loads[number] ** 2
            band[width, number : width * (count - 1) : width] = chain.off_diagonal
        for apart in range(1, width):
            for number in range(width - apart):
                band[apart, number::width] = self.weight * self._loads[number] * self._loads[number + apart]
        factor: FloatArray = cholesky_banded(band, lower=True, check_finite=False)
        self._log_determinant -= 2.0 * float(np.sum(np.log(factor[0])))
        return factor

    def apply(self, columns: FloatArray) -> FloatArray:
        """K^-1 times columns of shape (b,) or (b, p)."""
        if columns.ndim == 1:
            return np.asarray(self._applied(columns[np.newaxis])[0])
        result = np.empty(columns.shape)
        # a few columns at a time, each in one piece of memory, as the solver wants them: four times as fast
        for first in range(0, columns.shape[1], COLUMNS_AT_ONCE):
            part = slice(first, first + COLUMNS_AT_ONCE)
            result[:, part] = self._applied(columns[:, part].T).T
        return result

    def _applied(self, rows: FloatArray) -> FloatArray:
        """K^-1 times columns that are given as rows, (p, b)."""
        weighted = self.weight * rows
        if self._factor is None:
            return weighted
        loads = np.stack(self._loads, axis=1)
        right = weighted[:, :, np.newaxis] * loads
        shape = right.shape
        inner = cho_solve_banded(
            (self._factor, True), right.reshape(shape[0], -1).T, overwrite_b=True, check_finite=False
        )
        back = np.einsum("pbw,bw->pb", inner.T.reshape(shape), loads)
        return np.asarray(weighted - self.weight * back)

    def log_likelihood(self, residual: FloatArray) -> float:
        """Of Gaussian noise, up to a constant; only blocks that were observed count."""
        return 0.5 * (self._log_determinant - float(residual @ self.apply(residual)))


def _averaged(extent: FloatArray) -> FloatArray:
    """Variance of a wander's mean over a block, by that of the wander itself; extent in its own lengths."""
    x = np.maximum(extent, 1e-6)
    return np.where(x < 1e-3, 1.0 - x / 3.0, 2.0 * (x - 1.0 + np.exp(-x)) / x**2)


def fit_noise(residual: FloatArray, blocks: Blocks, parameters: int, begin: NoiseModel = BEGIN) -> NoiseModel:
    """The noise model that makes a residual (b,) most likely.

    Pieces of the record, spread over all of it, are enough: a likelihood of ten thousand blocks. The
    ``parameters`` that were fitted have taken their share of the white noise out.
    """
    pieces = _pieces(blocks)
    part = blocks.picked(pieces)
    left = residual[pieces]
    still = not np.any(part.moving)
    always = np.all(part.moving)

    def model(x: FloatArray) -> NoiseModel:
        standing, moving, *wanders = np.exp(x).tolist()
        return NoiseModel(moving if always else standing, standing if still else moving, *wanders)

    lower = np.log([SMALLEST_ARCSEC, SMALLEST_ARCSEC, SMALLEST_ARCSEC, 0.3, SMALLEST_ARCSEC, 0.01])
    upper = np.log([1e3, 1e3, 1e3, 600.0, 1e3, 60.0])

    wanders = _Wanders(part)

    def cost(x: FloatArray) -> float:
        return -Precision(model(x), part, wanders=wanders).log_likelihood(left)

    x = np.log(np.maximum(astuple(begin), SMALLEST_ARCSEC))
    found = minimize(
        cost,
        np.clip(x, lower, upper),
        method="L-BFGS-B",
        bounds=list(zip(lower, upper, strict=True)),
        options={"eps": DIFFERENCE, "ftol": 1e-7},
    )
    best = model(found.x)
    share = 1.0 / np.sqrt(max(1.0 - parameters / max(len(blocks), 1), 0.1))
    white = {name: share * getattr(best, name) for name in ("standing_arcsec", "moving_arcsec")}
    return replace(best, **white)


def _pieces(blocks: Blocks) -> IntArray:
    """Blocks of some pieces spread evenly over the record."""
    count = len(blocks)
    if count <= PIECES * PIECE_BLOCKS:
        return np.arange(count)
    begins = np.linspace(0, count - PIECE_BLOCKS, PIECES).astype(np.intp)
    return np.unique(np.concatenate([np.arange(begin, begin + PIECE_BLOCKS) for begin in begins]))
