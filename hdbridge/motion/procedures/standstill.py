"""Standstill: encoder readings without motion, which show the noise."""

from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, Dwell, MoveTo, Steps


@dataclass(frozen=True, slots=True)
class Precondition:
    """Back and forth by more than the width of any hysteresis, ending in a forward move at ``load_deg``.

    The gear's elastic state is then known: saturated forward. Every plan starts with it.
    """

    load_deg: float = 0.0
    back_deg: float = 2.0

    def moves(self, axis: AxisView) -> Steps[None]:
        yield MoveTo(self.load_deg - self.back_deg, kind="precondition")
        yield MoveTo(self.load_deg, kind="precondition")


@dataclass(frozen=True, slots=True)
class Standstill:
    """Standstill at ``load_deg`` for a given time."""

    load_deg: float = 0.0
    duration_s: float = 10.0

    def moves(self, axis: AxisView) -> Steps[None]:
        yield MoveTo(self.load_deg)
        yield Dwell(0.5, kind="move")
        yield Dwell(self.duration_s)


@dataclass(frozen=True, slots=True)
class Reference:
    """Standstill at a recurring pose, always approached from the same side, so that changes are drift."""

    load_deg: float = 0.0
    duration_s: float = 1.5

    def moves(self, axis: AxisView) -> Steps[None]:
        yield MoveTo(self.load_deg)
        yield Dwell(0.5, kind="move")
        yield Dwell(self.duration_s, kind="reference")
