"""Shares of counts with their intervals."""

from __future__ import annotations

from scipy.stats import binomtest


def proportion(hits: int, number: int) -> str:
    """Formats ``hits / all (per cent; Wilson's 95 % interval)``; a dash for none."""
    if not number:
        return "-"
    interval = binomtest(hits, number).proportion_ci(method="wilson")
    low, high = 100.0 * interval.low, 100.0 * interval.high
    return f"{hits} / {number} ({100.0 * hits / number:.1f} %; {low:.1f} to {high:.1f})"
