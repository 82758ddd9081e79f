"""Nested reversals: first-order reversal curves, which show whether a gear has return-point memory."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, MoveTo, Steps


@dataclass(frozen=True, slots=True)
class Reversals:
    """For each depth: back by the depth, forward by half of it, back again, then forward until all is
    forgotten.

    ``depths_deg`` are motor degrees; ``reach_deg`` must exceed the width of the hysteresis.
    """

    centre_deg: float = 0.0
    depths_deg: tuple[float, ...] = (2.0, 4.0, 8.0, 12.0, 16.0, 24.0)
    reach_deg: float = 60.0
    velocity_deg_s: float = 0.2
    """Speed at the load."""
    beyond: bool = False

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields the curves, each starting on the forward branch at the centre."""
        depths = [each / axis.ratio for each in self.depths_deg]
        curves: list[tuple[float, ...]] = [(0.0, -each, -0.5 * each, -each, 0.0) for each in depths]
        if self.beyond:
            curves = [(0.0, *(place for each in depths for place in (-each, -0.5 * each)), 0.0)]
        for curve in curves:
            yield MoveTo(self.centre_deg - self.reach_deg / axis.ratio)
            for place in curve:
                yield MoveTo(self.centre_deg + place, self.velocity_deg_s, kind="reversal")
