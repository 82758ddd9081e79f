"""From one load angle to the next, and to hold the last."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from hdbridge.procedures.moves import AxisView, MotionLimits, MoveTo, Path, Sample, Settle, Steps
from hdbridge.procedures.stepping import Standing, standing


class Hold:
    """Stand still for a while, or until told: the leg's duration is nobody's to foresee."""

    kind = "hold"

    def __init__(self, duration_s: float = math.inf, released: Callable[[], bool] = lambda: False) -> None:
        """``released`` is asked in each cycle."""
        self.begun = False
        """Whether the axis stands there."""
        self._duration_s, self._released = duration_s, released
        self._since_s = 0.0

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """No motion."""
        return Path(0.0, lambda _: start_deg, start_deg, start_deg)

    def ended(self, samples: Sequence[Sample]) -> bool:
        """Whether the time is over, or it was told to end."""
        if not self.begun:
            self.begun, self._since_s = True, samples[0].time_s
        return self._released() or samples[-1].time_s - self._since_s >= self._duration_s


@dataclass(frozen=True, slots=True)
class WayPoints:
    """Jerk-limited moves, each followed by a rest; at the last the axis is held."""

    targets_deg: tuple[float, ...]
    """Load angles."""
    hold: Hold = field(default_factory=lambda: Hold(0.0))
    velocity_deg_s: float | None = None
    """At the load; else the axis's limit."""
    settle: Settle = Settle()

    def moves(self, axis: AxisView) -> Steps[tuple[Standing, ...]]:
        """Each way point a move and a settle; the outcome is where the load then stood."""
        stands: list[Standing] = []
        for target_deg in self.targets_deg:
            yield MoveTo(target_deg, self.velocity_deg_s)
            samples = yield self.settle
            stands.append(standing(target_deg, samples, self.settle))
        yield self.hold
        return tuple(stands)
