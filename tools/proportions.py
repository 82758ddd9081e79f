"""Proportions with their confidence intervals."""

from __future__ import annotations

import math

Z95 = 1.959964


def proportion(hits: int, number: int) -> str:
    """Formats ``hits / number (per cent; Wilson's 95 % interval)``; a dash if ``number`` is 0."""
    if not number:
        return "-"
    share, square = hits / number, Z95**2 / number
    middle = (share + 0.5 * square) / (1.0 + square)
    half = Z95 * math.sqrt(share * (1.0 - share) / number + 0.25 * square / number) / (1.0 + square)
    low, high = max(middle - half, 0.0), min(middle + half, 1.0)
    return f"{hits} / {number} ({100.0 * share:.1f} %; {100.0 * low:.1f} to {100.0 * high:.1f})"
