"""Power in the control cycle: waiting for enable, and the states in which an axis may be at rest."""

import math
from collections.abc import Callable
from typing import Final

from hdbridge.drive.feedback import Feedback
from hdbridge.drive.states import PowerWalk, State
from hdbridge.errors import TransitionError

ENABLE_TIMEOUT_S: Final = 2.0
STOP_TIMEOUT_S: Final = 2.0
STANDING: Final = (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.FAULT)


def until_enabled(tick: Callable[[], Feedback], power: PowerWalk, period_s: float) -> Feedback:
    """Cycles until operation is enabled and returns that cycle's feedback; raises `TransitionError` on
    time-out.
    """
    for _ in range(math.ceil(ENABLE_TIMEOUT_S / period_s)):
        feedback = tick()
        if power.state is State.OPERATION_ENABLED:
            return feedback
    raise TransitionError(
        f"the drive did not reach 'operation enabled' within {ENABLE_TIMEOUT_S:g} s, it is in "
        f"'{power.state.value}'; look at its enable input, its supply and its fault history"
    )
