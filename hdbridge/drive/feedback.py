"""Measurements of one control cycle."""

from typing import Final, NamedTuple


class Feedback(NamedTuple):
    """Measurements of one cycle. Positions are encoder counts, unwrapped, multi-turn."""

    cycle: int
    """Number of the period, from 0, including skipped periods; it continues after a restart of the cycle."""
    time_s: float
    """``cycle`` times the period."""
    statusword: int
    motor_counts: int
    load_counts: int
    demand_counts: int
    torque_permille: float
    """Torque in per mille of the rated torque (6077h); NaN if the drive does not send it."""
    fresh: bool
    """False if a TPDO was missing or implausible; the values are then the last good values."""
    readings: tuple[float | None, ...]
    """Last good reading of each channel of the axis file; None for a channel without a good reading."""


ENABLE_TIMEOUT_S: Final = 2.0
STOP_TIMEOUT_S: Final = 2.0
