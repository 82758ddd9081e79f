"""Coloured noise, and least squares weighted by its inverse covariance.

The noise has five parts:

- white noise, which may differ between rest and motion;
- a drift in time;
- a drift over the motor's *travel*, because an axis rests anywhere within a count of its encoder; this error
  is constant during a stop, and different at the next one;
- the misfit of the loop's shape, which decays over each branch and differs between branches;
- the rounding error that is constant over a leg; its size follows from the count.

Each drift is a first-order Markov process. The inverse of its covariance is therefore banded, and a fit takes
no longer than one with white noise (Rybicki and Press 1995).
"""

from __future__ import annotations

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
ABSENT_ARCSEC = 2.0 * SMALLEST_ARCSEC
"""Minimum fitted size of a drift. A smaller one is at its lower limit and is omitted, because each drift
slows down all products."""
COLUMNS_AT_ONCE = 8
LOOP_LENGTH = 0.3
"""Correlation length of the misfit of the loop's shape, as a fraction of its decay travel."""
LOOP_DEG = 8.0, 40.0
"""Range of the decay travel, motor degrees, derived from the widths of loops. A longer decay is a drift, a
shorter one is ringing."""
SHORTEST_STEP = 1e-8
"""Minimum distance between blocks, in correlation lengths of a drift: practically zero."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviations and correlation lengths of the noise."""

    standing_arcsec: float
    """Standard deviation of the white noise of one sample at rest."""
    moving_arcsec: float
    """Standard deviation of the white noise of one sample in motion."""
    slow_arcsec: float = 0.0
    slow_s: float = 10.0
    """Drift in time: standard deviation and correlation time."""
    place_arcsec: float = 0.0
    place_deg: float = 0.1
    """Drift over the motor's travel: standard deviation and correlation length."""
    loop_arcsec: float = 0.0
    loop_deg: float = 10.0
    """Misfit of the loop's shape: standard deviation at a turning point, and decay travel."""

    def white_variance(self, blocks: Blocks) -> FloatArray:
        """Returns the white-noise variance of each block's mean; infinite for blocks without samples."""
        sample = np.where(blocks.moving, self.moving_arcsec, self.standing_arcsec) ** 2
        mean = np.divide(sample, blocks.count, out=np.full(len(blocks), np.inf), where=blocks.count > 0)
        return np.asarray(mean + blocks.blur)


BEGIN = NoiseModel(1.0, 1.0, 1.0, 10.0, 1.0, 0.3, 1.0, 10.0)
"""Initial values of a noise fit; the result does not depend on them."""


class White:
    """Inverse covariance of independent noise."""

    def __init__(self, weight: FloatArray) -> None:
        """``weight`` is the inverse standard deviation of each row, shape (m,)."""
        self._precision = weight**2

    def apply(self, columns: FloatArray) -> FloatArray:
        """Returns K^-1 times columns of shape (m,) or (m, p)."""
        return np.asarray(
            (self._precision if columns.ndim == 1 else self._precision[:, np.newaxis]) * columns
        )


class _Chain(NamedTuple):
    """Drift of unit size along the blocks: tridiagonal inverse covariance, and loading on each block.

    The loading (``load``) is the factor with which the drift enters the block's mean. Each quantity is
    followed by its derivative with respect to the logarithm of the correlation length.
    """

    diagonal: FloatArray
    diagonal_slope: FloatArray
    off_diagonal: FloatArray
    off_diagonal_slope: FloatArray
    log_determinant: float
    log_determinant_slope: float
    load: FloatArray
    load_slope: FloatArray


def _along(blocks: Blocks, place: FloatArray, extent: FloatArray, length: float) -> _Chain:
    """Returns the chain of a drift along ``place`` (time or travel), averaged over each block's extent."""
    step = np.where(np.diff(blocks.chain) != 0, np.inf, np.abs(np.diff(place)) / length)
    # Variance of the mean over x correlation lengths.
    x = np.maximum(extent / length, 1e-6)
    fallen = -np.expm1(-x)
    averaged = np.where(x < 1e-3, 1.0 - x / 3.0, 2.0 * (x - fallen) / x**2)
    load = np.sqrt(averaged)
    return _chain(step, load, (averaged - fallen / x) / load)


def _over_branches(blocks: Blocks, length_deg: float) -> _Chain:
    """Returns the chain of the loop's shape misfit, which decays over each branch, independently."""
    crossed = blocks.since_turn_deg / length_deg
    fresh = (np.diff(blocks.chain) != 0) | (np.diff(blocks.leg) != 0)
    step = np.where(fresh, np.inf, np.abs(np.diff(crossed)) / LOOP_LENGTH)
    load = 1.0 / (1.0 + crossed**2)
    return _chain(step, load, 2.0 * (crossed * load) ** 2)


def _over_legs(blocks: Blocks) -> _Chain:
    """Returns the chain of each leg's constant rounding error; the loadings are its standard deviations."""
    step = np.where(np.diff(blocks.leg) != 0, np.inf, 0.0)
    return _chain(step, blocks.locked_arcsec, np.zeros(len(blocks)))


def _chain(step: FloatArray, load: FloatArray, load_slope: FloatArray) -> _Chain:
    """Builds a chain from the distances between blocks, in correlation lengths; infinite for independence."""
    step_slope = np.where((step > SHORTEST_STEP) & np.isfinite(step), -step, 0.0)
    step = np.maximum(step, SHORTEST_STEP)
    decay = np.exp(-step)
    spread = -np.expm1(-2.0 * step)
    inward = decay**2 / spread
    inward_slope = -2.0 * inward / spread * step_slope
    return _Chain(
        1.0 + np.append(inward, 0.0) + np.append(0.0, inward),
        np.append(inward_slope, 0.0) + np.append(0.0, inward_slope),
        -decay / spread,
        decay * (1.0 + decay**2) / spread**2 * step_slope,
        float(-np.sum(np.log(spread))),
        float(-2.0 * inward @ step_slope),
        load,
        load_slope,
    )


class Precision:
    """Inverse covariance of the noise of a set of blocks, applied without forming the matrix.

    The covariance is K = W + H S H', with the white noise W, the drifts' covariance S and their loadings H.
    With w = W^-1 and P = S^-1 (tridiagonal for each drift), Woodbury's identity gives
    K^-1 = w - w H (P + H' w H)^-1 H' w. The bracket is banded.
    """

    def __init__(self, noise: NoiseModel, blocks: Blocks, left_out: BoolArray | None = None) -> None:
        """Treats the blocks in ``left_out`` as not observed."""
        weight = 1.0 / noise.white_variance(blocks)
        if left_out is not None:
            weight = np.where(left_out, 0.0, weight)
        self.weight: FloatArray = weight
        self._noise, self._blocks = noise, blocks
        self._log_determinant = float(np.sum(np.log(weight[weight > 0])))
        chains: dict[str, tuple[float, _Chain]] = {}
        if noise.slow_arcsec > 0:
            chain = _along(blocks, blocks.time_s, blocks.duration_s, noise.slow_s)
            chains["slow"] = noise.slow_arcsec, chain
        if noise.place_arcsec > 0:
            chain = _along(blocks, blocks.travel_deg, blocks.extent_deg, noise.place_deg)
            chains["place"] = noise.place_arcsec, chain
        if noise.loop_arcsec > 0:
            chains["loop"] = noise.loop_arcsec, _over_branches(blocks, noise.loop_deg)
        if np.any(blocks.locked_arcsec):
            chains["leg"] = 1.0, _over_legs(blocks)
        self._chains = chains
        self._loads = np.zeros((len(chains), len(blocks)))
        for number, (size, chain) in enumerate(chains.values()):
            self._loads[number] = size * chain.load
            self._log_determinant += chain.log_determinant
        if chains:
            self._band = self._bracket()
            self._factor: FloatArray = cholesky_banded(self._band, lower=True, check_finite=False)
            self._log_determinant -= 2.0 * float(np.sum(np.log(self._factor[0])))

    def _bracket(self) -> FloatArray:
        """Returns P + H' w H in lower band storage, with the drifts interleaved."""
        width, count = len(self._chains), len(self.weight)
        band = np.zeros((width + 1, width * count))
        loads = self._loads
        for number, (_, chain) in enumerate(self._chains.values()):
            weighted = self.weight * loads[number]
            band[0, number::width] = chain.diagonal + weighted * loads[number]
            band[width, number : width * (count - 1) : width] = chain.off_diagonal
            for apart in range(1, width - number):
                band[apart, number::width] = weighted * loads[number + apart]
        return band

    def apply(self, columns: FloatArray) -> FloatArray:
        """Returns K^-1 times columns of shape (b,) or (b, p)."""
        if columns.ndim == 1:
            return np.asarray(self._applied(columns[np.newaxis])[0])
        result = np.empty(columns.shape)
        # The solver is four times as fast with a few contiguous columns at a time.
        for first in range(0, columns.shape[1], COLUMNS_AT_ONCE):
            part = slice(first, first + COLUMNS_AT_ONCE)
            result[:, part] = self._applied(columns[:, part].T).T
        return result

    def _applied(self, rows: FloatArray) -> FloatArray:
        """Returns K^-1 times columns that are given as rows, shape (p, b)."""
        if not self._chains:
            return self.weight * rows
        back = np.einsum("pbw,wb->pb", self._drifts(rows), self._loads)
        return np.asarray(self.weight * (rows - back))

    def _drifts(self, rows: FloatArray) -> FloatArray:
        """Returns the expected drifts, given the observations (p, b); shape (p, b, drifts)."""
        right = (self.weight * rows)[:, :, np.newaxis] * np.ascontiguousarray(self._loads.T)
        inner = cho_solve_banded(
            (self._factor, True), right.reshape(len(rows), -1).T, overwrite_b=True, check_finite=False
        )
        return np.asarray(inner.T.reshape(right.shape))

    def _drift_covariance(self) -> tuple[FloatArray, FloatArray]:
        """Returns the covariance of the drifts given the observations.

        The first array contains the covariances within each block, shape (drifts, drifts, b). The second
        contains the covariance of each drift with its value in the next block, shape (drifts, b - 1). The
        inverse at a block is obtained by elimination of all blocks before it and of all blocks after it.
        """
        width = len(self._chains)
        mirrored = np.zeros_like(self._band)
        for apart, row in enumerate(self._band):
            mirrored[apart, : len(row) - apart] = row[: len(row) - apart][::-1]
        before = _pivots(self._factor)
        behind = _pivots(cholesky_banded(mirrored, lower=True, check_finite=False))[::-1, ::-1, ::-1]
        pivots = before + behind - (self.weight * self._loads)[:, np.newaxis] * self._loads
        for number, (_, chain) in enumerate(self._chains.values()):
            pivots[number, number] -= chain.diagonal
        within = _inverses(pivots)
        coupling = self._band[width].reshape(-1, width).T[:, :-1]
        between = -np.einsum("ijb,jb,jib->ib", _inverses(before)[:, :, :-1], coupling, within[:, :, 1:])
        return within, between

    def log_likelihood(self, residual: FloatArray) -> float:
        """Returns the Gaussian log likelihood of the observed blocks, up to a constant."""
        return 0.5 * (self._log_determinant - float(residual @ self.apply(residual)))

    def score(self, residual: FloatArray) -> FloatArray:
        """Returns the derivatives (8,) of `log_likelihood` with respect to the logarithms of the noise model.

        The model must have a drift. By Fisher's identity, the derivatives follow from the mean and covariance
        of the drifts, given the residual.
        """
        weight, loads, moving = self.weight, self._loads, self._blocks.moving
        drifts = np.ascontiguousarray(self._drifts(residual[np.newaxis])[0].T)
        within, between = self._drift_covariance()
        left = residual - np.sum(loads * drifts, axis=0)
        shared = np.einsum("ijb,jb->ib", within, loads)
        sampled = np.where(weight > 0, 1.0 - weight * self._blocks.blur, 0.0)
        white = sampled * (weight * (left**2 + np.sum(loads * shared, axis=0)) - 1.0)
        slopes = {"standing": [np.sum(white[~moving])], "moving": [np.sum(white[moving])]}
        by_load = weight * (left * drifts - shared)
        squares = drifts**2 + np.einsum("iib->ib", within)
        products = drifts[:, :-1] * drifts[:, 1:] + between
        for number, (name, (size, chain)) in enumerate(self._chains.items()):
            by_length = 0.5 * (chain.log_determinant_slope - squares[number] @ chain.diagonal_slope)
            by_length += (
                size * by_load[number] @ chain.load_slope - products[number] @ chain.off_diagonal_slope
            )
            slopes[name] = [by_load[number] @ loads[number], by_length]
        absent = [0.0, 0.0]
        parts = ("standing", "moving", "slow", "place", "loop")
        return np.concatenate([slopes.get(each, absent) for each in parts])


def _pivots(factor: FloatArray) -> FloatArray:
    """Returns the pivots (drifts, drifts, b) of a block elimination, from the banded Cholesky factor."""
    width = len(factor) - 1
    root = np.zeros((width, width, factor.shape[1] // width))
    for row in range(width):
        for column in range(row + 1):
            root[row, column] = factor[row - column, column::width]
    return np.asarray(np.einsum("ikb,jkb->ijb", root, root))


def _inverses(matrices: FloatArray) -> FloatArray:
    """Inverts small positive definite matrices, shape (n, n, b), all at once (Gauss-Jordan)."""
    result = matrices.copy()
    for k, row in enumerate(result):
        inverse = 1.0 / row[k]
        scaled, column = row * inverse, result[:, k].copy()
        result -= column[:, np.newaxis] * scaled
        result[k], result[:, k], result[k, k] = scaled, -column * inverse, inverse
    return result


def fit_noise(residual: FloatArray, blocks: Blocks, parameters: int, begin: NoiseModel = BEGIN) -> NoiseModel:
    """Fits the noise model to a residual (b,) by maximum likelihood.

    The fit uses at most `PIECES` pieces of the record, spread evenly. The white noise is corrected for the
    number of fitted ``parameters``.
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

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        precision = Precision(model(x), part)
        return -precision.log_likelihood(left), -precision.score(left)

    x = np.log(np.maximum(astuple(begin), SMALLEST_ARCSEC))
    found = minimize(
        cost,
        np.clip(x, lower, upper),
        method="L-BFGS-B",
        jac=True,
        bounds=list(zip(lower, upper, strict=True)),
        options={"ftol": 1e-7},
    )
    best = model(found.x)
    drifts = {name: getattr(best, name) for name in ("slow_arcsec", "place_arcsec", "loop_arcsec")}
    absent = {name: 0.0 for name, size in drifts.items() if size < ABSENT_ARCSEC}
    share = 1.0 / np.sqrt(max(1.0 - parameters / max(len(blocks), 1), 0.1))
    white = {name: share * getattr(best, name) for name in ("standing_arcsec", "moving_arcsec")}
    return replace(best, **white, **absent)


def _pieces(blocks: Blocks) -> IntArray:
    """Returns the indices of the blocks in several pieces, spread evenly over the record."""
    count = len(blocks)
    if count <= PIECES * PIECE_BLOCKS:
        return np.arange(count)
    begins = np.linspace(0, count - PIECE_BLOCKS, PIECES).astype(np.intp)
    return np.unique(np.concatenate([np.arange(begin, begin + PIECE_BLOCKS) for begin in begins]))
