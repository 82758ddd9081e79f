"""Measurements of one control cycle, and the wait for 'operation enabled' in the cycle."""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

from hdbridge.drive.states import PowerWalk, State
from hdbridge.errors import TransitionError


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
STANDING: Final = (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.FAULT)


def until_enabled(tick: Callable[[], Feedback], power: PowerWalk, period_s: float) -> Feedback:
    """Cycles until operation is enabled; returns that cycle's feedback. `TransitionError` on time-out."""
    for _ in range(math.ceil(ENABLE_TIMEOUT_S / period_s)):
        feedback = tick()
        if power.state is State.OPERATION_ENABLED:
            return feedback
    raise TransitionError(
        f"the drive did not reach 'operation enabled' within {ENABLE_TIMEOUT_S:g} s, it is in "
        f"'{power.state.value}'; look at its enable input, its supply and its fault history"
    )
