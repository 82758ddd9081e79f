"""Slow sweeps in both directions, which show the synchronous part, load orders and the height of the loop."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, MoveTo, Steps
from hdbridge.motion.procedures.parameters import Checked, Count, Positive


@dataclass(frozen=True, slots=True)
class Sweep(Checked):
    """Sweeps from ``low_deg`` to ``high_deg`` and back at constant speed, ``laps`` times."""

    low_deg: float
    high_deg: float
    velocity_deg_s: Positive
    laps: Count = 1

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields the move to ``low_deg`` and the laps."""
        yield MoveTo(self.low_deg)
        for _ in range(self.laps):
            yield MoveTo(self.high_deg, self.velocity_deg_s, kind="sweep")
            yield MoveTo(self.low_deg, self.velocity_deg_s, kind="sweep")
