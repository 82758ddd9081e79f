"""Linear filter and test of a claimed rate, without scipy.signal and scipy.stats, which load slowly."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg.blas import dtbsv
from scipy.special import bdtr

CHANCE = 0.01
"""Probability of rejecting a correct claim."""


def filtered(forward: Sequence[float], back: Sequence[float], values: np.ndarray) -> np.ndarray:
    """Returns the output of `scipy.signal.lfilter`; the first of ``back`` is 1."""
    driven = np.convolve(values, forward)[: len(values)]
    order = len(back) - 1
    return dtbsv(order, np.tile(np.reshape(back, (-1, 1)), len(values)), driven, lower=1, diag=1)


def least(trials: int, rate: float, chance: float = CHANCE) -> int:
    """Returns the minimum count of successes; fewer have a probability below ``chance`` at this rate."""
    return next(count for count in range(trials + 1) if bdtr(count, trials, rate) >= chance)
