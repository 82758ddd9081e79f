"""Formatting of numbers and sentences for pages."""

from typing import Final

from hdbridge import units

SIGMA: Final = "3\N{GREEK SMALL LETTER SIGMA}"
SCATTER: Final = (f"pooled {SIGMA}", "mean", f"CW {SIGMA}", "mean", f"CCW {SIGMA}", "mean")
"""Columns of a stepping test. Pooled comes first as the result, because a telephone shows two columns."""


def sentence(text: str) -> str:
    """Adds a capital letter and exactly one full stop."""
    return text[:1].upper() + text[1:].rstrip(".") + "."


def figure(value: float, digits: int = 4) -> str:
    """Formats a number with ``digits`` significant digits and a typographic minus sign."""
    return _typeset(units.figure(value, digits))


def with_interval(value: float, half_width: float) -> tuple[str, str]:
    """Formats the half width with two digits, and the value with as many decimals."""
    text, half = units.with_interval(value, half_width)
    return _typeset(text), _typeset(half)


def _typeset(number: str) -> str:
    return number.replace("-", "\N{MINUS SIGN}")
