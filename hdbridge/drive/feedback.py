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
    torque_permille: int
    fresh: bool
    """False when a TPDO was missing or not believed: the values are the last good ones."""
    load_torque_nm: float | None = None
    """Last reading that was believed; None where the axis has none, or none is known (any more)."""
    temperature_c: float | None = None
    """Of the gear; None as with the load torque."""
