"""Small steps up and down, none as long as the hysteresis is wide: where the gear is between its branches."""

from __future__ import annotations

from dataclasses import dataclass

from hdbridge.procedures.moves import AxisView, MoveTo, Settle, Steps
from hdbridge.procedures.stepping import Standing, SteppingOutcome, standing

_GOLDEN = 0.618_033_988_75


@dataclass(frozen=True, slots=True)
class SmallSteps:
    """``count`` targets within ``reach_deg`` (motor degrees) on either side of a centre, in a mixed order.

    A stepping test whose steps are longer than the hysteresis is wide ends saturated each time, and cannot
    see its width, its shape or its memory; these steps can. Each outcome goes by the direction of its last
    move: ``cw`` upwards.
    """

    centre_deg: float = 0.0
    """At the load."""
    reach_deg: float = 20.0
    count: int = 40
    precondition_deg: float = 2.0
    """Load degrees; more than any hysteresis is wide."""
    settle: Settle = Settle()

    def moves(self, axis: AxisView) -> Steps[SteppingOutcome]:
        """Each step a jerk-limited move and a settle."""
        yield MoveTo(self.centre_deg - self.precondition_deg, kind="precondition")
        yield MoveTo(self.centre_deg, kind="precondition")
        ways: tuple[list[Standing], list[Standing]] = ([], [])
        last = self.centre_deg
        for index in range(1, self.count + 1):
            # Steps of all lengths: the differences of n^2 g modulo 1 are spread evenly, as its values are.
            share = (index * index * _GOLDEN) % 1.0
            target = self.centre_deg + (2.0 * share - 1.0) * self.reach_deg / axis.ratio
            yield MoveTo(target, kind="step")
            samples = yield self.settle
            ways[target < last].append(standing(target, samples, self.settle))
            last = target
        return SteppingOutcome(cw=tuple(ways[0]), ccw=tuple(ways[1]))
