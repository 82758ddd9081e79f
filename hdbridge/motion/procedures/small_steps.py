"""Small steps in both directions, within the width of the hysteresis, so that the loop does not saturate."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, Settle, Steps
from hdbridge.motion.procedures.parameters import Checked, Count, Positive
from hdbridge.motion.procedures.standstill import Precondition
from hdbridge.motion.procedures.stepping import Standing, SteppingOutcome, step

_GOLDEN = 0.618_033_988_75


@dataclass(frozen=True, slots=True)
class SmallSteps(Checked):
    """Steps to ``count`` targets in mixed order, within ``reach_deg`` (motor degrees) of a centre.

    If steps are longer than the width of the hysteresis, the loop is saturated after each. Such a test cannot
    show the loop's width, shape or memory, but these steps can. Results are grouped by the direction of the
    last move; ``cw`` is upwards.
    """

    centre_deg: float = 0.0
    """Centre of the targets, load degrees."""
    reach_deg: Positive = 20.0
    count: Count = 40
    precondition_deg: float = 2.0
    """Travel of the pre-conditioning move, load degrees; more than the width of any hysteresis."""
    settle: Settle = Settle()

    def moves(self, axis: AxisView) -> Steps[SteppingOutcome]:
        """Yields a jerk-limited move and a settle for each step."""
        yield from Precondition(self.centre_deg, self.precondition_deg).moves(axis)
        ways: tuple[list[Standing], list[Standing]] = ([], [])
        last = self.centre_deg
        for index in range(1, self.count + 1):
            # Steps of all lengths occur: the differences of n^2 g modulo 1 are distributed as evenly as the
            # values.
            share = (index * index * _GOLDEN) % 1.0
            target = self.centre_deg + (2.0 * share - 1.0) * self.reach_deg / axis.ratio
            ways[target < last].append((yield from step(target, self.settle)))
            last = target
        return SteppingOutcome(cw=tuple(ways[0]), ccw=tuple(ways[1]))
