"""Small steps up and down, shorter than the width of the hysteresis, which keep the gear between its
branches.
"""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, MoveTo, Settle, Steps
from hdbridge.motion.procedures.stepping import Standing, SteppingOutcome, standing

_GOLDEN = 0.618_033_988_75


@dataclass(frozen=True, slots=True)
class SmallSteps:
    """``count`` targets within ``reach_deg`` (motor degrees) on either side of a centre, in mixed order.

    A stepping test with steps longer than the width of the hysteresis ends saturated each time and cannot
    show its width, shape or memory; these steps can. Outcomes are classified by the direction of the last
    move; ``cw`` is upwards.
    """

    centre_deg: float = 0.0
    """Centre at the load."""
    reach_deg: float = 20.0
    count: int = 40
    precondition_deg: float = 2.0
    """Load degrees; more than the width of any hysteresis."""
    settle: Settle = Settle()

    def moves(self, axis: AxisView) -> Steps[SteppingOutcome]:
        """Yields a jerk-limited move and a settle for each step."""
        yield MoveTo(self.centre_deg - self.precondition_deg, kind="precondition")
        yield MoveTo(self.centre_deg, kind="precondition")
        ways: tuple[list[Standing], list[Standing]] = ([], [])
        last = self.centre_deg
        for index in range(1, self.count + 1):
            # Steps of all lengths: the differences of n^2 g modulo 1 are distributed as evenly as its values.
            share = (index * index * _GOLDEN) % 1.0
            target = self.centre_deg + (2.0 * share - 1.0) * self.reach_deg / axis.ratio
            yield MoveTo(target, kind="step")
            samples = yield self.settle
            ways[target < last].append(standing(target, samples, self.settle))
            last = target
        return SteppingOutcome(cw=tuple(ways[0]), ccw=tuple(ways[1]))
