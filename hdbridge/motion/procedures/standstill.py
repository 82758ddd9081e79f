"""Standstill: encoder readings without motion, which show the noise and, if repeated, drift."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, Dwell, MoveTo, Steps
from hdbridge.motion.procedures.parameters import Checked, Positive


@dataclass(frozen=True, slots=True)
class Precondition(Checked):
    """Moves back and forth by more than the width of any hysteresis, ending forward at ``load_deg``.

    The gear's elastic state is then known, because it is saturated in the forward direction. Every task of a
    plan starts with this move.
    """

    load_deg: float = 0.0
    back_deg: float = 2.0

    def moves(self, axis: AxisView) -> Steps[None]:
        yield MoveTo(self.load_deg - self.back_deg, kind="precondition")
        yield MoveTo(self.load_deg, kind="precondition")


@dataclass(frozen=True, slots=True)
class Standstill(Checked):
    """Standstill at ``load_deg`` for a given time."""

    load_deg: float = 0.0
    duration_s: Positive = 10.0
    kind: str = "standstill"
    """Purpose: ``reference`` at a recurring pose, always approached from the same side, which shows drift."""

    def moves(self, axis: AxisView) -> Steps[None]:
        yield MoveTo(self.load_deg)
        yield Dwell(0.5, kind="move")
        yield Dwell(self.duration_s, self.kind)
