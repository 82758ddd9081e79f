"""Standing still: what the encoders say when nothing moves is their noise."""

from __future__ import annotations

from dataclasses import dataclass

from hdbridge.procedures.moves import AxisView, Dwell, MoveTo, Steps


@dataclass(frozen=True, slots=True)
class Precondition:
    """Back and forth by more than any hysteresis is wide, ending in a forward move at ``load_deg``.

    After it the gear's elastic state is known: saturated forward. Every plan begins with it.
    """

    load_deg: float = 0.0
    back_deg: float = 2.0

    def moves(self, axis: AxisView) -> Steps[None]:
        """Two moves."""
        yield MoveTo(self.load_deg - self.back_deg, kind="precondition")
        yield MoveTo(self.load_deg, kind="precondition")


@dataclass(frozen=True, slots=True)
class Standstill:
    """Stand at ``load_deg`` for a while."""

    load_deg: float = 0.0
    duration_s: float = 10.0

    def moves(self, axis: AxisView) -> Steps[None]:
        """Go there and stand."""
        yield MoveTo(self.load_deg)
        yield Dwell(0.5, kind="move")
        yield Dwell(self.duration_s)


@dataclass(frozen=True, slots=True)
class Reference:
    """Stand at a pose that recurs, approached from the same side each time: what changes there is drift."""

    load_deg: float = 0.0
    duration_s: float = 1.5

    def moves(self, axis: AxisView) -> Steps[None]:
        """Come to rest, then stand."""
        yield MoveTo(self.load_deg)
        yield Dwell(0.5, kind="move")
        yield Dwell(self.duration_s, kind="reference")
