"""The units that the whole project speaks, and the constants between them.

Angles are degrees, multi-turn, never wrapped. Errors of the gear are arcseconds *at the load*. A name
carries its unit (``motor_deg``, ``offset_arcsec``, ``cycle_s``).
"""

from typing import Final

ARCSEC_PER_DEG: Final = 3600.0
"""Arcseconds in a degree."""

DEG_PER_TURN: Final = 360.0
"""Degrees in a turn."""
