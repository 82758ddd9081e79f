"""Proportions with their confidence intervals."""

from __future__ import annotations

from scipy.stats import binomtest


def proportion(hits: int, number: int) -> str:
    """Formats ``hits / number (per cent; Wilson's 95 % interval)``; a dash if ``number`` is 0."""
    if not number:
        return "-"
    low, high = binomtest(hits, number).proportion_ci(method="wilson")
    return f"{hits} / {number} ({100.0 * hits / number:.1f} %; {100.0 * low:.1f} to {100.0 * high:.1f})"
