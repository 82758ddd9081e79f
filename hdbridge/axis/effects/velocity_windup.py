"""Wind-up of the gear due to drag on the output, from seals, bearings, grease or a cable."""

import math
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Angleless, Effect, Linear
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Shape
from hdbridge.axis.effects.kinematics import speed_of, top_speed_deg_s
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start

STRAIGHT = 20.0
"""Ratio of shear speed to top speed from which the drag deviates from a straight line by less than 5 %."""


EXPONENT = 0.58
"""Standard deviation of the exponent of (speed / shear speed) in the law.

The exponent lies between 0 (an oil without shear thinning) and 1 (a paste with a yield stress). For a uniform
distribution, this is the rms deviation from the law's value of 1."""


class VelocityWindup(Angleless, Linear):
    """-(coulomb sgn(v) + viscous v / (1 + |v| / shear)): drag divided by stiffness; zero at rest.

    Dry friction that remains at rest belongs to the elastic loop. Because of shear thinning, the viscous part
    is half the linear value at the shear speed, and constant far above it.
    """

    name = "velocity_windup"
    channels = frozenset({Channel.SPEED})
    about = Cause(
        title="wind-up by drag on the output",
        subject="drag",
        equation="-(coulomb sgn(v) + viscous v / (1 + |v| / v_shear)), v the commanded motor speed, "
        "limited to v_limit",
        signature="the error grows less than linearly with speed and vanishes at rest",
        consequence="the load lags while it moves",
        remedy="compensate it; thinner grease, seals with less drag; warm the axis up first",
        experiment="sweeps at several speeds both ways: drag is curved over speed, a skew is a straight line",
        aliases=("channel_skew", "rate_dependence"),
        source="Coulomb and viscous friction with shear thinning, over the gear's stiffness",
        size="5-50 arcsec",
    )
    compensable = Compensable(
        True, "the load really has this error and the speed is commanded; it is zero at rest"
    )
    shape = (Shape("shear_deg_s", 10.0, 100_000.0, logarithmic=True),)
    nonnegative = True
    """Drag always opposes the motion. Without this constraint, the estimate of an absent drag could have
    either sign."""
    linear = ("coulomb_arcsec", "viscous_arcsec_s_per_deg")
    typical = {
        "coulomb_arcsec": 3.0,
        "viscous_arcsec_s_per_deg": 0.015,
        "shear_deg_s": 1000.0,
    }
    """Drag with a wind-up of about 10 arcsec at 1000 motor degrees per second."""

    coulomb_arcsec: float = Field(ge=0, le=3600, description="dry drag over stiffness, while it moves")
    viscous_arcsec_s_per_deg: float = Field(
        ge=0, le=100, description="slope at low speed, per motor degree per second"
    )
    shear_deg_s: float = Field(gt=0, le=1e7, description="motor speed at which it has fallen off by half")
    limit_deg_s: float = Field(
        50_000.0, gt=0, le=1e6, description="motor speed above which the effect is constant"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields drags with shear speeds below, at and above the record's highest speed."""
        fastest = top_speed_deg_s(observations.motion)
        for share in (0.15, 1.0, 6.0):
            yield cls(
                coulomb_arcsec=1.0, viscous_arcsec_s_per_deg=0.01, shear_deg_s=max(share * fastest, 10.0)
            )

    def unidentifiable(self, observations: Observations) -> str:
        """Requires curvature over speed, because a linear drag is not separable from a sampling delay.

        A small dry part is not evidence either. If a drive follows a command in whole counts, it lags by a
        constant fraction of a count in the direction of motion, which looks the same.
        """
        speed = observations.motion.motor_speed_deg_s
        if speed is None or self.coulomb_arcsec > 0.5 * observations.motor_count_arcsec:
            return ""
        if self.shear_deg_s < STRAIGHT * float(np.max(np.abs(speed))):
            return ""
        return "a straight line in speed is a delay, not a drag"

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the errors due to unit dry drag and unit viscous drag, shape (n, 2)."""
        speed = np.clip(speed_of(motion, self.name), -self.limit_deg_s, self.limit_deg_s)
        return -np.column_stack([np.sign(speed), speed / (1.0 + np.abs(speed) / self.shear_deg_s)])

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to one standard deviation (`EXPONENT`) of the shear exponent, (n, 1)."""
        speed = np.clip(speed_of(motion, self.name), -self.limit_deg_s, self.limit_deg_s)
        share = np.abs(speed) / self.shear_deg_s
        bent = share * np.log(np.maximum(share, 1e-300)) / (1.0 + share) ** 2
        return (EXPONENT * self.viscous_arcsec_s_per_deg * speed * bent)[:, np.newaxis]

    def at(self, motor_deg: float, moment: Moment) -> float:
        speed = min(max(moment.motor_speed_deg_s, -self.limit_deg_s), self.limit_deg_s)
        if not speed:
            return 0.0
        viscous = self.viscous_arcsec_s_per_deg * speed / (1.0 + abs(speed) / self.shear_deg_s)
        return -(self.coulomb_arcsec * math.copysign(1.0, speed) + viscous)

    def bound_arcsec(self) -> float:
        viscous = self.limit_deg_s / (1.0 + self.limit_deg_s / self.shear_deg_s)
        return abs(self.coulomb_arcsec) + abs(self.viscous_arcsec_s_per_deg) * viscous
