"""A claimed rate against what was counted."""

from __future__ import annotations

from support.filters import binomial_quantile

CHANCE = 0.01
"""Of a right claim to be refused."""


def least(trials: int, rate: float) -> int:
    """So many successes at least: fewer have a probability below `CHANCE` where the rate is as claimed."""
    return binomial_quantile(CHANCE, trials, rate)
