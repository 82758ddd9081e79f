"""Shares of counts with their intervals."""

from __future__ import annotations

from scipy.stats import beta


def proportion(hits: int, number: int) -> str:
    """Formats a count with its share's 95 % interval (Clopper-Pearson)."""
    if not number:
        return "none tried"
    low = float(beta.ppf(0.025, hits, number - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, number - hits)) if hits < number else 1.0
    return f"{hits} of {number} ({100 * low:.0f} to {100 * high:.0f} %)"
