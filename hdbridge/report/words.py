"""Numbers and sentences as pages write them."""

from __future__ import annotations

import math
from typing import Final

SIGMA: Final = "3\N{GREEK SMALL LETTER SIGMA}"
SCATTER: Final = (f"pooled {SIGMA}", "mean", f"CW {SIGMA}", "mean", f"CCW {SIGMA}", "mean")
"""Columns of a stepping test. Pooled is the result, so it comes first: a telephone shows two columns."""


def sentence(text: str) -> str:
    """With a capital and one full stop."""
    return text[:1].upper() + text[1:].rstrip(".") + "."


def figure(value: float) -> str:
    """Four digits and a real minus sign."""
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def with_interval(value: float, half_width: float) -> tuple[str, str]:
    """The half width with two digits, the value with as many decimals."""
    if not (math.isfinite(half_width) and half_width > 0.0):
        return figure(value), figure(half_width)
    decimals = max(1 - math.floor(math.log10(half_width)), 0)
    return f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}"), f"{half_width:.{decimals}f}"
