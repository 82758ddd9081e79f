"""Sequence of procedures that acts as one procedure, optionally with limited acceleration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hdbridge.motion.procedures.moves import AxisView, Move, MoveTo, Procedure, Sample, Steps
from hdbridge.motion.procedures.parameters import Checked, Positive


@dataclass(frozen=True, slots=True)
class Chain(Checked):
    """Runs procedures in sequence; the outcome is that of the last one.

    ``acceleration_deg_s2`` (at the load) limits every move, because acceleration winds up the gear's spring.
    A calibration must exclude this wind-up.
    """

    parts: tuple[Procedure[object], ...]
    acceleration_deg_s2: Positive | None = None

    def moves(self, axis: AxisView) -> Steps[object]:
        outcome: object = None
        for part in self.parts:
            steps = part.moves(axis)
            reply: Sequence[Sample] | None = None
            while True:
                try:
                    move = next(steps) if reply is None else steps.send(reply)
                except StopIteration as end:
                    outcome = end.value
                    break
                reply = yield self._gently(move)
        return outcome

    def _gently(self, move: Move) -> Move:
        if self.acceleration_deg_s2 is None or not isinstance(move, MoveTo):
            return move
        return replace(move, acceleration_deg_s2=self.acceleration_deg_s2)
