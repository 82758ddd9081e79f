"""First-order lags over a whole record: the exact step of an exponential, evenly sampled or not."""

from __future__ import annotations

import math

import numpy as np

from hdbridge.effects.base import FloatArray


def recurrence(decay: FloatArray, drive: FloatArray, first: float) -> FloatArray:
    """y[0] = first, y[i] = decay[i] y[i-1] + drive[i]; shape (n,), linear time, any decay in [0, 1].

    Done in about sqrt(n) blocks side by side, then the blocks are carried on: no loop over samples, and
    none of the overflow of the closed form with cumulative products.
    """
    count = len(decay)
    if not count:
        return np.empty(0)
    width = max(1, math.isqrt(count))
    rows = -(-count // width)
    factors = np.ones(rows * width)
    terms = np.zeros(rows * width)
    factors[:count], terms[:count] = decay, drive
    factors[0], terms[0] = 0.0, first
    # one row per step within the blocks, so that each step is a vector operation over all blocks
    a, b = factors.reshape(rows, width).T.copy(), terms.reshape(rows, width).T.copy()
    for step in range(1, width):
        b[step] += a[step] * b[step - 1]
        a[step] *= a[step - 1]
    carry = np.empty(rows)
    value = 0.0
    for row, (whole, added) in enumerate(zip(a[-1].tolist(), b[-1].tolist(), strict=True)):
        carry[row] = value
        value = whole * value + added
    result: FloatArray = (b + a * carry).T.reshape(-1)[:count]
    return result


def lagged(values: FloatArray, time_s: FloatArray, tau_s: float) -> FloatArray:
    """First-order lag of a sampled quantity, held between samples; in equilibrium at the first."""
    if not len(values):
        return np.empty(0)
    decay = np.exp(-np.maximum(np.diff(time_s, prepend=time_s[:1]), 0.0) / tau_s)
    return recurrence(decay, (1.0 - decay) * values, float(values[0]))
