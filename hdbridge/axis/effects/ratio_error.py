"""Difference between the true gear ratio and that of the model."""

from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.base import Effect, Linear, Momentary
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable, Observations
from hdbridge.axis.effects.motion import FloatArray, Moment, Motion, Start
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

TEETH_PER_TURN = 2.0
"""Teeth passed per motor turn: the usual difference in tooth count between circular spline and flexspline."""
SCALE = 1e-3
"""Largest scale error of a correctly mounted encoder: a tape on a drum of 100 mm whose radius is 0.1 mm off.
A disc has no scale error, because its number of lines per turn is an integer."""
SAME_TEETH = 1e-4
"""Relative accuracy of a ratio that is derived from a ramp in the presence of other causes: a tenth of
`SCALE`."""


class RatioError(Momentary, Linear):
    """(1 / N_true - 1 / N) theta_M, an error proportional to the motor angle."""

    name = "ratio_error"
    about = Cause(
        title="wrong gear ratio or encoder scale",
        subject="ratio errors",
        equation="ramp theta_M, ramp = 3600 (1 / N_true - 1 / N), theta_M limited to +- limit",
        signature="a ramp over the motor angle, the same in both directions, undone on the return",
        consequence="the error is proportional to the distance from zero",
        remedy="correct ratio, teeth or counts per turn in the axis file",
        experiment="a long sweep both ways, then rest: a ratio error grows with the angle, a drift with time",
        aliases=("load_order", "zero_drift", "wear"),
        source="kinematics",
        size="784 arcsec per 43.56 motor degrees between ratios 40 and 50",
    )
    compensable = Compensable(
        True,
        "the load really has this error (unless the load encoder's scale is wrong), but correct the axis "
        "file instead",
    )
    linear = ("ramp_arcsec_per_turn",)
    typical = {"ramp_arcsec_per_turn": 2.592}

    ramp_arcsec_per_turn: float = Field(ge=-1e6, le=1e6, description="ramp per motor turn")
    limit_deg: float = Field(1e6, gt=0, le=1e9, description="motor angle above which the effect is constant")

    def true_ratio(self, ratio: float) -> float:
        """Returns the true gear ratio if a model with ``ratio`` has this ramp as its error."""
        return 1.0 / (1.0 / ratio + self.ramp_arcsec_per_turn / (DEG_PER_TURN * ARCSEC_PER_DEG))

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        yield cls(ramp_arcsec_per_turn=1.0)

    def implausible(self, observations: Observations) -> str:
        """Accepts a record of a whole load turn, a ratio of whole tooth counts, or a small scale error.

        The ratio of a strain wave gear is half the tooth count of its flexspline, or one more. In less than a
        load turn, any other ramp may be a part of a periodic error.
        """
        ratio = self.true_ratio(observations.ratio)
        teeth = TEETH_PER_TURN * ratio
        turned = float(np.ptp(observations.motion.motor_deg)) >= DEG_PER_TURN * observations.ratio
        off = abs(teeth - round(teeth)) / teeth
        if turned or abs(observations.ratio / ratio - 1.0) < SCALE or off < SAME_TEETH:
            return ""
        return f"no teeth have the ratio {ratio:.6g}, and no encoder's scale is so wrong"

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the multi-turn load angle."""
        return over.position(motion, ratio)

    def changing(self, motion: Motion) -> FloatArray:
        """Returns bends at one and two thirds of the travel, because a wrong ratio has a constant slope."""
        angle = motion.motor_deg
        low, span = float(np.min(angle)), float(np.ptp(angle))
        bends = [np.maximum(angle - low - share * span, 0.0) for share in (1.0 / 3.0, 2.0 / 3.0)]
        return np.column_stack(bends) / DEG_PER_TURN

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a ramp of 1 arcsec per motor turn, shape (n, 1)."""
        angle = np.clip(motion.motor_deg, -self.limit_deg, self.limit_deg)
        return (angle / DEG_PER_TURN)[:, np.newaxis]

    def at(self, motor_deg: float, moment: Moment) -> float:
        return self.ramp_arcsec_per_turn / DEG_PER_TURN * min(max(motor_deg, -self.limit_deg), self.limit_deg)

    def bound_arcsec(self) -> float:
        return abs(self.ramp_arcsec_per_turn) / DEG_PER_TURN * self.limit_deg

    def slope_bound_arcsec_per_deg(self) -> float:
        return max(-self.ramp_arcsec_per_turn, 0.0) / DEG_PER_TURN
