"""Nested reversals: first-order reversal curves, which show whether a gear has return-point memory."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, MoveTo, Steps
from hdbridge.motion.procedures.parameters import Checked, Positive


@dataclass(frozen=True, slots=True)
class Reversals(Checked):
    """Reversal curves: for each depth, back by the depth, forward by half of it, back again, then forward.

    The gear forgets each curve on the approach to the next. ``depths_deg`` and ``reach_deg`` are motor
    degrees; ``reach_deg``, the travel of the approach, must exceed the width of the hysteresis. With
    ``beyond``, all depths form a single curve.
    """

    centre_deg: float = 0.0
    depths_deg: tuple[Positive, ...] = (2.0, 4.0, 8.0, 12.0, 16.0, 24.0)
    reach_deg: Positive = 60.0
    velocity_deg_s: Positive = 0.2
    """Speed at the load."""
    beyond: bool = False

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields the curves; each starts at the centre, on the forward branch."""
        depths = [each / axis.ratio for each in self.depths_deg]
        curves: list[tuple[float, ...]] = [(0.0, -each, -0.5 * each, -each, 0.0) for each in depths]
        if self.beyond:
            curves = [(0.0, *(place for each in depths for place in (-each, -0.5 * each)), 0.0)]
        for curve in curves:
            yield MoveTo(self.centre_deg - self.reach_deg / axis.ratio)
            for place in curve:
                yield MoveTo(self.centre_deg + place, self.velocity_deg_s, kind="reversal")
