"""The units that the whole project speaks, and the constants between them.

Angles are degrees, multi-turn, never wrapped. Errors of the gear are arcseconds *at the load*. A name
carries its unit (``motor_deg``, ``offset_arcsec``, ``cycle_s``).
"""

from typing import Final

ARCSEC_PER_DEG: Final = 3600.0
"""Arcseconds in a degree."""

DEG_PER_TURN: Final = 360.0
"""Degrees in a turn."""

_UNITS: Final = {
    "arcsec_per_kiloturn": "arcsec/kiloturn",
    "arcsec_s_per_deg": "arcsec s/deg",
    "arcsec_per_turn": "arcsec/turn",
    "arcsec_per_nm": "arcsec/Nm",
    "arcsec_per_k": "arcsec/K",
    "percent_per_nm": "%/Nm",
    "percent_per_k": "%/K",
    "stiffness_s2": "s^2",
    "percent": "%",
    "arcsec": "arcsec",
    "deg_s2": "deg/s^2",
    "deg_s": "deg/s",
    "deg": "deg",
    "ms2": "ms^2",
    "ms": "ms",
    "hz": "Hz",
    "nm": "Nm",
    "s": "s",
}


def unit_of(name: str) -> str:
    """The unit that a parameter's name ends with; 1 where it has none."""
    return next(
        (unit for ending, unit in _UNITS.items() if name == ending or name.endswith("_" + ending)), "1"
    )
