"""Linear filters and binomial quantiles; `scipy.signal` and `scipy.stats` take a second to load."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg.blas import dtbsv
from scipy.special import bdtr


def filtered(forward: Sequence[float], back: Sequence[float], values: np.ndarray) -> np.ndarray:
    """What `scipy.signal.lfilter` gives; the first of ``back`` is 1."""
    driven = np.convolve(values, forward)[: len(values)]
    order = len(back) - 1
    return dtbsv(order, np.tile(np.reshape(back, (-1, 1)), len(values)), driven, lower=1, diag=1)


def binomial_quantile(chance: float, trials: int, rate: float) -> int:
    """The smallest number of successes that is not exceeded with this chance, `scipy.stats.binom.ppf`."""
    return next(count for count in range(trials + 1) if bdtr(count, trials, rate) >= chance)
