"""Several procedures as one."""

from __future__ import annotations

from dataclasses import dataclass

from hdbridge.procedures.moves import AxisView, Procedure, Steps


@dataclass(frozen=True, slots=True)
class Chain:
    """One after the other; the outcome is the last one's."""

    parts: tuple[Procedure[object], ...]

    def moves(self, axis: AxisView) -> Steps[object]:
        """The moves of each."""
        outcome: object = None
        for part in self.parts:
            outcome = yield from part.moves(axis)
        return outcome
