"""Measurements of one control cycle. Data only."""

from typing import NamedTuple


class Feedback(NamedTuple):
    """Measurements of one cycle. Positions are encoder counts, unwrapped, multi-turn."""

    cycle: int
    """Number of periods since `Cycle.restart`, skipped ones included."""
    time_s: float
    """``cycle`` times the period."""
    statusword: int
    motor_counts: int
    load_counts: int
    demand_counts: int
    torque_permille: float
    """NaN if the drive does not send it (6077h)."""
    fresh: bool
    """False if a TPDO was missing or implausible; the values are then the last good ones."""
    readings: tuple[float | None, ...]
    """Last good reading of each channel of the axis file; None if there is none."""
