"""Coloured noise, and least squares weighted by it.

The noise has five parts: white noise, which may differ between standing and moving; a drift in time; a drift
over the motor's *travel*, because an axis rests anywhere within a count of its encoder, constant during a
stop and different at the next; the misfit of the loop's shape, which decays over each branch and differs
between branches; and the rounding error that is constant over a leg, whose size follows from the count. The
drifts are first-order Markov processes, so the inverse of their covariance is banded, and a fit costs no more
than one with white noise (Rybicki and Press 1995).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

from hdbridge.analysis.blocks import Blocks
from hdbridge.axis.effects import BoolArray, FloatArray, IntArray

PIECES = 16
PIECE_BLOCKS = 250
SMALLEST_ARCSEC, LARGEST_ARCSEC = 1e-3, 1e3
DIFFERENCE = 1e-4
"""Step of the likelihood's derivatives, in logarithms. With a smaller one, rounding stops the fit early."""
COLUMNS_AT_ONCE = 8
CHAINS_KEPT = 12
"""Size of the cache of chains: a derivative needs two at each length and one at a step from each."""
LOOP_LENGTH = 0.3
"""Correlation length of the misfit of a loop's shape, as a share of the travel over which the misfit
decays."""
LOOP_DEG = 8.0, 40.0
"""Range of that travel, derived from the widths of loops. A longer one is a drift, a shorter one ringing."""
SAME_LEG = 1e-8
"""Step between blocks of a leg in correlation lengths: practically zero, for an error constant over a leg."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviations and correlation lengths of the noise."""

    standing_arcsec: float
    """White noise of one sample at rest."""
    moving_arcsec: float
    """White noise of one sample in motion."""
    slow_arcsec: float = 0.0
    slow_s: float = 10.0
    """Drift in time: standard deviation and correlation time."""
    place_arcsec: float = 0.0
    place_deg: float = 0.1
    """Drift over the motor's travel: standard deviation and correlation length."""
    loop_arcsec: float = 0.0
    loop_deg: float = 10.0
    """Misfit of the loop's shape: standard deviation at a turning point, and travel over which it decays."""

    def white_variance(self, blocks: Blocks) -> FloatArray:
        """Returns the white-noise variance of each block's mean; infinite for blocks without samples."""
        sample = np.where(blocks.moving, self.moving_arcsec, self.standing_arcsec) ** 2
        mean = np.divide(sample, blocks.count, out=np.full(len(blocks), np.inf), where=blocks.count > 0)
        return np.asarray(mean + blocks.blur)


BEGIN = NoiseModel(1.0, 1.0, 1.0, 10.0, 1.0, 0.3, 1.0, 10.0)
"""Initial values of a noise fit; the result does not depend on them."""


class White:
    """The inverse covariance of independent noise."""

    def __init__(self, weight: FloatArray) -> None:
        """``weight`` is one over the standard deviation of each row, shape (m,)."""
        self._precision = weight**2

    def apply(self, columns: FloatArray) -> FloatArray:
        """Returns K^-1 times columns of shape (m,) or (m, p)."""
        return np.asarray(
            (self._precision if columns.ndim == 1 else self._precision[:, np.newaxis]) * columns
        )


class _Chain(NamedTuple):
    """Drift of unit size along some blocks: its inverse covariance, and its share in each block's mean."""

    diagonal: FloatArray
    off_diagonal: FloatArray
    log_determinant: float
    load: FloatArray


class _Wanders:
    """Cache of the chains of a set of blocks, because a noise fit requests the same lengths repeatedly."""

    def __init__(self, blocks: Blocks) -> None:
        self._blocks = blocks
        self._fresh = np.diff(blocks.chain) != 0
        self._kept: dict[object, _Chain] = {}

    def in_time(self, length_s: float) -> _Chain:
        """Returns the drift in time."""
        blocks = self._blocks
        return self._once(("time", length_s), lambda: self._along(blocks.time_s, blocks.duration_s, length_s))

    def in_place(self, length_deg: float) -> _Chain:
        """Returns the drift over the motor's travel."""
        blocks = self._blocks
        return self._once(
            ("place", length_deg), lambda: self._along(blocks.travel_deg, blocks.extent_deg, length_deg)
        )

    def over_legs(self) -> _Chain:
        """Returns the error that is constant over a leg, of the size given in the blocks."""
        blocks = self._blocks
        return self._once(
            "leg",
            lambda: _chain(np.where(np.diff(blocks.leg) != 0, np.inf, SAME_LEG), blocks.locked_arcsec),
        )

    def over_branches(self, length_deg: float) -> _Chain:
        """Returns the misfit of the loop's shape, which decays over each branch, anew for each."""

        def make() -> _Chain:
            crossed = self._blocks.since_turn_deg / length_deg
            way = np.maximum(np.abs(np.diff(crossed)) / LOOP_LENGTH, SAME_LEG)
            fresh = self._fresh | (np.diff(self._blocks.leg) != 0)
            return _chain(np.where(fresh, np.inf, way), 1.0 / (1.0 + crossed**2))

        return self._once(("loop", length_deg), make)

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
    """Builds a chain from the steps between blocks in correlation lengths (infinite: independent)."""
    spread = -np.expm1(-2.0 * step)
    decay = np.exp(-step)
    diagonal = np.ones(len(load))
    diagonal[:-1] += decay**2 / spread
    diagonal[1:] += decay**2 / spread
    return _Chain(diagonal, -decay / spread, float(-np.sum(np.log(spread))), load)


class Precision:
    """Inverse covariance of the noise of a set of blocks, applied without forming the matrix.

    K = W + H S H', with W white and S of the drifts. By Woodbury, with P = S^-1 (tridiagonal for each drift),
    K^-1 = w - w H (P + H' w H)^-1 H' w, and the bracket is banded.
    """

    def __init__(
        self,
        noise: NoiseModel,
        blocks: Blocks,
        left_out: BoolArray | None = None,
        wanders: _Wanders | None = None,
    ) -> None:
        """Treats blocks in ``left_out`` as unobserved; ``wanders`` is the cache of the blocks, if any."""
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
        if noise.loop_arcsec > 0:
            chains.append(wanders.over_branches(noise.loop_deg))
            self._loads.append(noise.loop_arcsec * chains[-1].load)
        if np.any(blocks.locked_arcsec):
            chains.append(wanders.over_legs())
            self._loads.append(chains[-1].load)
        for chain in chains:
            self._log_determinant += chain.log_determinant
        self._factor = self._factored(chains) if chains else None

    def _factored(self, chains: list[_Chain]) -> FloatArray:
        """Returns the Cholesky factor of the bracket, with the drifts interleaved."""
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
        """Returns K^-1 times columns of shape (b,) or (b, p)."""
        if columns.ndim == 1:
            return np.asarray(self._applied(columns[np.newaxis])[0])
        result = np.empty(columns.shape)
        # a few contiguous columns at a time suit the solver: four times as fast
        for first in range(0, columns.shape[1], COLUMNS_AT_ONCE):
            part = slice(first, first + COLUMNS_AT_ONCE)
            result[:, part] = self._applied(columns[:, part].T).T
        return result

    def _applied(self, rows: FloatArray) -> FloatArray:
        """Returns K^-1 times columns given as rows, (p, b)."""
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
        """Returns the Gaussian log likelihood of the observed blocks up to a constant."""
        return 0.5 * (self._log_determinant - float(residual @ self.apply(residual)))


def _averaged(extent: FloatArray) -> FloatArray:
    """Returns the variance of a drift's block mean relative to the drift's; extent: correlation lengths."""
    x = np.maximum(extent, 1e-6)
    return np.where(x < 1e-3, 1.0 - x / 3.0, 2.0 * (x - 1.0 + np.exp(-x)) / x**2)


def fit_noise(residual: FloatArray, blocks: Blocks, parameters: int, begin: NoiseModel = BEGIN) -> NoiseModel:
    """Fits the noise model to a residual (b,) by maximum likelihood.

    It uses at most `PIECES` pieces of the record, spread evenly. The white noise is corrected for the
    ``parameters`` that were fitted.
    """
    pieces = _pieces(blocks)
    part = blocks.picked(pieces)
    left = residual[pieces]
    still = not np.any(part.moving)
    always = np.all(part.moving)

    def model(x: FloatArray) -> NoiseModel:
        standing, moving, *wanders = np.exp(x).tolist()
        return NoiseModel(moving if always else standing, standing if still else moving, *wanders)

    least, most = SMALLEST_ARCSEC, LARGEST_ARCSEC
    lower = np.log([least, least, least, 0.3, least, 0.01, least, LOOP_DEG[0]])
    upper = np.log([most, most, most, 600.0, most, 60.0, most, LOOP_DEG[1]])

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
    """Selects the blocks of several pieces spread evenly over the record."""
    count = len(blocks)
    if count <= PIECES * PIECE_BLOCKS:
        return np.arange(count)
    begins = np.linspace(0, count - PIECE_BLOCKS, PIECES).astype(np.intp)
    return np.unique(np.concatenate([np.arange(begin, begin + PIECE_BLOCKS) for begin in begins]))
