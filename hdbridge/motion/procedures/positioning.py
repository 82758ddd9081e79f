"""Positioning test of machine tools (ISO 230-2): repeated approaches to targets from both sides."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, MoveTo, Settle, Steps
from hdbridge.motion.procedures.parameters import Checked, Count
from hdbridge.motion.procedures.stepping import step


@dataclass(frozen=True, slots=True)
class Approach:
    """One approach to a target."""

    target_deg: float
    forward: bool
    error_arcsec: float
    """Load encoder reading minus target, mean over the settled window."""


@dataclass(frozen=True, slots=True)
class Positioning(Checked):
    """Standard test cycle: up to each target, past the last, down to each target, past the first."""

    targets_deg: tuple[float, ...]
    """Load angles, ascending."""
    cycles: Count = 5
    overrun_deg: float = 2.0
    """Travel beyond the first and last target, load degrees; more than the width of any hysteresis."""
    settle: Settle = Settle()

    def moves(self, axis: AxisView) -> Steps[tuple[Approach, ...]]:
        """Yields a jerk-limited move and a settle for each approach."""
        found: list[Approach] = []
        yield MoveTo(self.targets_deg[0] - self.overrun_deg, kind="precondition")
        for _ in range(self.cycles):
            for upwards in (True, False):
                for target in self.targets_deg if upwards else reversed(self.targets_deg):
                    stand = yield from step(target, self.settle)
                    found.append(Approach(target, upwards, stand.error_arcsec))
                beyond = self.overrun_deg if upwards else -self.overrun_deg
                yield MoveTo(self.targets_deg[-1 if upwards else 0] + beyond, kind="precondition")
        return tuple(found)


def targets(low_deg: float, high_deg: float, axis: AxisView) -> tuple[float, ...]:
    """Returns the number of targets over a travel that ISO 230-2 requires of a rotary axis (3, 5 or 8).

    The targets are shifted from even spacing by different fractions of a motor turn (golden ratio), so that
    an error that repeats with each motor turn is sampled at different phases.
    """
    travel = high_deg - low_deg
    count = 3 if travel <= 90.0 else 5 if travel <= 180.0 else 8
    turn = 360.0 / axis.ratio
    places = []
    for index in range(count):
        even = low_deg + travel * index / (count - 1)
        phase = (0.618_033_988_75 * index) % 1.0
        shift = (phase - 0.5) * min(turn, 0.5 * travel / count)
        places.append(min(max(even + shift, low_deg), high_deg))
    return tuple(places)
