"""First-order lags over a whole record, with exact exponential steps for any sampling."""

import numpy as np

from hdbridge.axis.effects.motion import FloatArray


def recurrence(decay: FloatArray, drive: FloatArray, first: float) -> FloatArray:
    """Returns y[0] = first, y[i] = decay[i] y[i-1] + drive[i]; shape (n,), linear time, any decay in [0, 1].

    It solves a bidiagonal system with unit main diagonal by forward substitution (BLAS).
    """
    from scipy.linalg.blas import dtbsv  # noqa: PLC0415 - a model is read and compensated without scipy

    if not len(decay):
        return np.empty(0)
    diagonals = np.ones((2, len(decay)), order="F")
    diagonals[1, :-1] = -decay[1:]
    right = np.array(drive, dtype=np.float64)
    right[0] = first
    solved: FloatArray = dtbsv(1, diagonals, right, lower=1, diag=1, overwrite_x=1)
    return solved


def lagged(values: FloatArray, time_s: FloatArray, tau_s: float) -> FloatArray:
    """Applies a first-order lag to a sampled quantity, which is held between samples.

    The lag is in equilibrium at the first sample.
    """
    if not len(values):
        return np.empty(0)
    decay = np.exp(-np.maximum(np.diff(time_s, prepend=time_s[:1]), 0.0) / tau_s)
    return recurrence(decay, (1.0 - decay) * values, float(values[0]))
