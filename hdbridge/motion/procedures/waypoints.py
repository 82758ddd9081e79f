"""Moves through load angles, with a hold at the last one."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import AxisView, MotionLimits, Path, Sample, Settle, Steps
from hdbridge.motion.procedures.parameters import Checked, Positive
from hdbridge.motion.procedures.stepping import Standing, step


class Hold:
    """Standstill for a given time or until released; the duration of the leg is not known in advance."""

    kind = "hold"

    def __init__(self, duration_s: float = math.inf, released: Callable[[], bool] = lambda: False) -> None:
        """``released`` is called in each cycle, and ends the hold when it returns True.

        Raises `InputError` for a duration that is not a number of at least 0; infinity is allowed.
        """
        if not (isinstance(duration_s, int | float) and duration_s >= 0.0):
            raise InputError(f"Hold: duration_s: found {duration_s!r}; expected at least 0")
        self.begun = False
        """True once the axis stands at its final position."""
        self._duration_s, self._released = duration_s, released
        self._since_s = 0.0

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        return Path(0.0, lambda _: start_deg, start_deg, start_deg)

    def ended(self, samples: Sequence[Sample], axis: AxisView) -> bool:
        """Returns True if the time has elapsed or the axis was released."""
        if not self.begun:
            self.begun, self._since_s = True, samples[0].time_s
        return self._released() or samples[-1].time_s - self._since_s >= self._duration_s


@dataclass(frozen=True, slots=True)
class WayPoints(Checked):
    """Jerk-limited moves, each followed by settling, and a hold at the last target."""

    targets_deg: tuple[float, ...]
    """Load angles."""
    hold: Hold = field(default_factory=lambda: Hold(0.0))
    velocity_deg_s: Positive | None = None
    """Maximum speed at the load; None for the axis's limit."""
    settle: Settle = Settle()

    def moves(self, axis: AxisView) -> Steps[tuple[Standing, ...]]:
        """Yields a move and a settle for each way point; the outcome is the load's position at each."""
        stands: list[Standing] = []
        for target_deg in self.targets_deg:
            stands.append((yield from step(target_deg, self.settle, self.velocity_deg_s, "move")))
        yield self.hold
        return tuple(stands)
