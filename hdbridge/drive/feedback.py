"""What one control cycle measured. Data only."""

from __future__ import annotations

from typing import NamedTuple


class Feedback(NamedTuple):
    """What a cycle measured. Positions are encoder counts, unwrapped, multi-turn."""

    cycle: int
    """Number of the period since `Cycle.restart`; skipped periods are counted."""
    time_s: float
    """``cycle`` times the period."""
    statusword: int
    motor_counts: int
    load_counts: int
    demand_counts: int
    torque_permille: float
    """NaN if the drive does not send it (6077h)."""
    fresh: bool
    """False when a TPDO was missing or not believed: the values are the last good ones."""
    readings: tuple[float | None, ...]
    """Of each channel of the axis file the last reading that was believed; None where none is known."""
