"""Units of the project, and their conversion constants.

Angles are degrees, multi-turn, never wrapped. Gear errors are arcseconds *at the load*. A name contains its
unit (``motor_deg``, ``offset_arcsec``, ``cycle_s``).
"""

import math
import re
from typing import Final

ARCSEC_PER_DEG: Final = 3600.0
"""Arcseconds per degree."""

DEG_PER_TURN: Final = 360.0
"""Degrees per turn."""

_UNITS: Final = {
    "arcsec_per_kiloturn": "arcsec/kiloturn",
    "arcsec_s_per_deg": "arcsec s/deg",
    "arcsec_per_turn": "arcsec/turn",
    "arcsec_per_nm": "arcsec/Nm",
    "arcsec_per_k": "arcsec/K",
    "percent_per_nm": "%/Nm",
    "percent_per_k": "%/K",
    "percent": "%",
    "arcsec": "arcsec",
    "deg_s2": "deg/s^2",
    "s2": "s^2",
    "deg_s": "deg/s",
    "deg": "deg",
    "ms2": "ms^2",
    "ms": "ms",
    "hz": "Hz",
    "nm": "Nm",
    "s": "s",
    "k": "K",
}

FIGURE: Final = re.compile(r"\(?[-+~<]?\d[\d,.]*(e[-+]?\d+)?\)?( ?(s|%))?")
"""Pattern of a table's cell that contains a number."""


def unit_of(name: str) -> str:
    """Returns the unit at the end of a parameter's name; 1 for a dimensionless parameter."""
    return _UNITS.get(_ending(name), "1")


def without_unit(name: str) -> str:
    """Returns a parameter's name without its unit."""
    return name.removesuffix("_" + _ending(name))


def _ending(name: str) -> str:
    return next((each for each in _UNITS if name == each or name.endswith("_" + each)), "")


def figure(value: float, digits: int = 4) -> str:
    """Formats a number with ``digits`` significant digits; uses no exponent between a ten-thousandth and a
    million.
    """
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if decimals > 0 else text


def rounded(value: float, digits: int = 5) -> float:
    """Rounds a number to ``digits`` significant digits."""
    return float(f"{value:.{digits}g}")


def with_interval(value: float, half_width: float) -> tuple[str, str]:
    """Formats a number and the half width of its interval, which has two significant digits and determines
    the number of decimals.
    """
    if not (math.isfinite(half_width) and half_width > 0.0):
        return figure(value), figure(half_width)
    last = math.floor(math.log10(half_width)) - 1
    if 0.0 < abs(value) < 1e-4:
        return f"{value:.{max(math.floor(math.log10(abs(value))) - last, 0)}e}", f"{half_width:.1e}"
    middle, half = (f"{round(each, -last):.{max(-last, 0)}f}" for each in (value, half_width))
    return middle, half
