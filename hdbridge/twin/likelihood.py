"""How likely a rounded reading is by a simulation that is not rounded.

An encoder's rounding is no noise: where a motor goes an even way per cycle it errs alike in every row, and a
simulation of the true axis is within half a count of nearly all of them. So a reading says that the angle
was within its count, give or take what the simulation itself is off by: a normal deviation. Its likelihood is
that of quantised observations (Gustafsson and Karlsson, Statistical results for system identification based
on quantised observations, Automatica 45, 2009). With a deviation of a count and more it is that of least
squares.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr, ndtr

from hdbridge.effects import FloatArray

FINE = 1e-3
"""Half a step of fewer deviations is as good as none."""
STRAY = 0.02
"""Share of readings that may be anywhere: how a motor that stuck breaks away, and where it stood when the
drive was switched on, is no measure of what a simulation is off by elsewhere, nor of a parameter."""


def rooted(off: FloatArray, half: FloatArray, stray: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of which half the squares are the loss of log likelihood, and their derivative by ``off``.

    ``off`` is how far each reading is from the simulation, ``half`` half the step that it is rounded to, both
    in standard deviations of the simulation, shape (n,); ``stray`` the probability of a reading in spite of
    all. Without steps they are as they came.
    """
    size, plain = np.abs(off), half == 0.0
    stray = np.where(half < FINE, stray * FINE / np.where(plain, 1.0, half), stray)
    half = np.maximum(half, FINE)
    least = surprise(np.zeros_like(half), half, stray)
    lost = surprise(size, half, stray)
    root = np.sqrt(2.0 * np.maximum(lost - least, 0.0))
    rise = np.exp(lost - 0.5 * np.square(size - half)) * -np.expm1(-2.0 * size * half) / np.sqrt(2.0 * np.pi)
    flat = np.sqrt(2.0 * half * np.exp(least - 0.5 * np.square(half)) / np.sqrt(2.0 * np.pi))
    inner = root < 1e-4
    slope = np.where(inner, flat, rise / np.where(inner, 1.0, root))
    root = np.where(inner, flat * size, root)
    return np.sign(off) * np.where(plain, size, root), np.where(plain, 1.0, slope)


def surprise(size: FloatArray, half: FloatArray, stray: FloatArray) -> FloatArray:
    """Minus the logarithm of the probability of a reading so far away, ``size`` from zero on."""
    outer, inner = -size - half, size - half
    near = np.log1p(-np.minimum(ndtr(outer) + ndtr(inner), 1.0 - 1e-15))
    tail = log_ndtr(-inner)
    beyond = tail + np.log1p(-np.exp(np.minimum(log_ndtr(outer) - tail, -1e-12)))
    with np.errstate(divide="ignore"):
        anyhow = np.log(stray)
    return np.asarray(-np.logaddexp(np.where(inner < -1.0, near, beyond), anyhow), dtype=np.float64)


def deviation(
    off: FloatArray, step: float, least: float, spread: FloatArray | None = None
) -> tuple[float, float]:
    """The standard deviation of a simulation, by readings in steps: the most likely, ``least`` at least.

    ``spread`` is what each reading is known to be off by in addition. With it the probability of a reading in
    spite of all.
    """
    size, known = np.abs(off), np.zeros_like(off) if spread is None else spread
    farthest = max(float(np.max(size)), least)
    stray = STRAY / (1.0 - STRAY) * step / (2.0 * farthest + step)

    def cost(log_deviation: float) -> float:
        each = np.hypot(np.exp(log_deviation), known)
        half = 0.5 * step / each
        times = np.minimum(1.0, half / FINE)
        return float(
            np.sum(surprise(size / each, np.maximum(half, FINE), stray / times)) - np.sum(np.log(times))
        )

    bounds = (np.log(least), np.log(2.0 * farthest))
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02})
    return float(np.exp(found.x)), stray
