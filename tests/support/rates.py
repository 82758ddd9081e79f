"""Test of a claimed rate against a count."""

from support.filters import binomial_quantile

CHANCE = 0.01
"""Probability of refusing a correct claim."""


def least(trials: int, rate: float) -> int:
    """Returns the minimum count of successes; fewer have a probability below `CHANCE` at this rate."""
    return binomial_quantile(CHANCE, trials, rate)
