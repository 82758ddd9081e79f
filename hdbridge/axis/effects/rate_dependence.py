"""Growth of the elastic loop with speed, because friction rises with the logarithm of the sliding speed."""

import math
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Loop, Modulating, has_loop, loop_of
from hdbridge.axis.effects.coordinate import Coordinate, Spacing
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Part, Scaled, Shape, Tracker
from hdbridge.axis.effects.kinematics import speed_of, top_speed_deg_s
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start


class RateDependence(Modulating):
    """growth log10(1 + |v| / reference) H, H being the loop: zero at rest, ``growth`` per decade of speed."""

    name = "rate_dependence"
    channels = frozenset({Channel.SPEED})
    about = Cause(
        title="loop that grows with speed",
        equation="growth log10(1 + |v| / v_ref) H, H the model's loop, v the commanded motor speed, "
        "limited to v_limit",
        signature="the same sine at a higher frequency has a higher loop; at rest the difference is gone",
        consequence="a loop measured slowly is too small for fast moves",
        remedy="compensate it; calibrate at working speed; thinner grease",
        experiment="sines of one amplitude at 0.01 to 1 Hz",
        aliases=("velocity_windup", "channel_skew", "hysteresis_parameters"),
        source="rate-dependent friction, logarithmic in the rate (rate-and-state laws)",
        size="5-30 % of the loop",
    )
    compensable = Compensable(True, "the load really has this error; the speed is commanded")
    shape = (Shape("reference_deg_s", 1.0, 1000.0, logarithmic=True),)
    carries = {Part.LOOP: "loop"}
    linear = ("growth_percent",)
    typical = {"growth_percent": 10.0, "reference_deg_s": 30.0}

    loop: Loop = Field(description="the model's loop")
    growth_percent: float = Field(ge=0, le=200, description="growth per decade of speed")
    reference_deg_s: float = Field(gt=0, le=1e5, description="motor speed above which it grows")
    limit_deg_s: float = Field(
        20_000.0, gt=0, le=1e6, description="motor speed above which the effect is constant"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields reference speeds far below and just below the record's highest speed."""
        fastest = top_speed_deg_s(observations.motion)
        if has_loop(base):
            for share in (0.02, 0.2):
                yield cls(
                    loop=loop_of(base), growth_percent=1.0,
                    reference_deg_s=min(max(share * fastest, 1.0), 1000.0),
                )  # fmt: skip

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        speed = np.abs(speed_of(motion, self.name))
        return Coordinate("speed, forward or backward", "motor deg/s", speed, spacing=Spacing.FILLED)

    def scales(self) -> tuple[Part, Effect]:
        return Part.LOOP, self.loop.law()

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a growth of 1 % per decade, shape (n, 1)."""
        speed = np.minimum(np.abs(speed_of(motion, self.name)), self.limit_deg_s)
        rate = np.log1p(speed / self.reference_deg_s) * (0.01 / math.log(10.0))
        return (rate * self.loop.law().predict(motion, start))[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Scaled(self.loop.law().tracker(start), self._rate)

    def bound_arcsec(self) -> float:
        return self._most() * abs(self.loop.offset_arcsec)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns 0 if a leading loop grows or a lagging one shrinks: the change only rises along the path.

        Otherwise returns infinity, because the change falls infinitely steeply after a reversal.
        """
        return 0.0 if self.growth_percent * self.loop.offset_arcsec >= 0.0 else math.inf

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Returns a tracker with a limited fall at the highest speed if the load lags, else None."""
        if self.growth_percent <= 0.0:
            return None
        loop = self.loop.law().gentle_tracker(start, fall_arcsec_per_deg / self._most())
        return None if loop is None else Scaled(loop, self._rate)

    def _rate(self, moment: Moment) -> float:
        """Returns the relative growth of the loop at this speed."""
        speed = min(abs(moment.motor_speed_deg_s), self.limit_deg_s)
        return 0.01 * self.growth_percent / math.log(10.0) * math.log1p(speed / self.reference_deg_s)

    def _most(self) -> float:
        """Returns the relative growth of the loop at the highest speed."""
        return 0.01 * self.growth_percent * math.log10(1.0 + self.limit_deg_s / self.reference_deg_s)
