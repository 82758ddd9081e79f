"""Bump at one load angle: a damaged tooth."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.base import Effect, Linear, Momentary
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Shape, Sought, Stretch
from hdbridge.axis.effects.load_order import Ratio
from hdbridge.axis.effects.motion import FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.path import away_from_reversals
from hdbridge.units import DEG_PER_TURN

PASSES = 3
OTHER_SPEED = 1.5
"""Minimum ratio of the highest to the lowest speed of the passes, if all are in one direction."""


FORM = 0.07
"""Deviation of a real bump from the formula, relative to its height."""


class LocalDefect(Momentary, Linear):
    """height (1 + cos(pi u)) / 2 for |u| < 1, u = (theta_M / N - centre, wrapped) / half width."""

    name = "local_defect"
    about = Cause(
        title="bump at one load angle",
        subject="local defects",
        equation="height (1 + cos(pi u)) / 2 where |u| < 1, u = ((theta_M / N - centre) mod 360 deg) / "
        "half_width",
        signature="the same bump on every pass over one load angle, in both directions",
        consequence="the load is off at one place, and the tooth wears further",
        remedy="inspect the tooth, and clean the load encoder's disc, on which a mark looks the same; "
        "compensate it until then",
        experiment="several slow passes over the place, both ways, and again with the load encoder "
        "re-clocked",
        aliases=("load_order",),
        source="raised cosine as a smooth bump of finite extent",
        size="1-20 arcsec",
    )
    compensable = Compensable(
        True, "the load really has this error, if it is a tooth and not a mark on the encoder's disc"
    )
    shape = (
        Shape("centre_deg", 0.0, 360.0),
        Shape("half_width_deg", 0.05, 30.0, logarithmic=True),
    )
    usual = 2
    sought = Sought.BUMP
    inexact = 0.15
    """A damaged tooth's bump never has exactly this shape, so its misfit can appear as a smaller bump."""
    linear = ("height_arcsec",)
    typical = {"height_arcsec": 5.0, "centre_deg": 0.0, "half_width_deg": 3.6}

    ratio: Ratio
    height_arcsec: float = Field(ge=-3600, le=3600, description="height of the bump")
    centre_deg: float = Field(ge=-360, le=360, description="load angle of its centre")
    half_width_deg: float = Field(gt=0, le=180, description="load angle from its centre to its foot")

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields a damaged tooth in the middle of the travel, as an example."""
        load = float(np.median(observations.motion.motor_deg)) / observations.ratio
        yield cls(
            ratio=observations.ratio, height_arcsec=1.0, centre_deg=load % DEG_PER_TURN, half_width_deg=3.6
        )

    def unidentifiable(self, observations: Observations) -> str:
        """Requires different passes, because identical ones do not separate a position from a time."""
        return "" if self._is_met(observations) else "not passed often enough, or always in the same way"

    def _is_met(self, observations: Observations) -> bool:
        """Returns True if the axis passed the bump repeatedly, in both directions or at different speeds."""
        motion = observations.motion
        if motion.motor_speed_deg_s is None or motion.time_s is None:
            return False
        turns = (motion.motor_deg / self.ratio - self.centre_deg) / DEG_PER_TURN
        # A jump between two records is not a pass. It implies a speed that the axis never reached.
        steps, moved = np.diff(motion.time_s), np.abs(np.diff(motion.motor_deg))
        real = moved <= 3.0 * float(np.max(np.abs(motion.motor_speed_deg_s))) * steps
        speed = motion.motor_speed_deg_s[np.flatnonzero((np.diff(np.floor(turns)) != 0.0) & real)]
        fast = np.abs(speed[speed != 0.0])
        if len(fast) < PASSES:
            return False
        both = bool(np.any(speed > 0.0) and np.any(speed < 0.0)) and observations.reversals >= 2
        return both or float(np.max(fast)) > OTHER_SPEED * float(np.min(fast))

    def shows(self, motion: Motion) -> Stretch | None:
        """Returns the samples away from reversals, where a misfit of the loop's shape leaves no bumps."""
        return away_from_reversals(motion)

    def changing(self, motion: Motion) -> FloatArray:
        """Returns bumps on either side, which a wave would have but a damaged tooth would not."""
        apart = 2.0 * self.half_width_deg
        beside = [self.model_copy(update={"centre_deg": self.centre_deg + each}) for each in (-apart, apart)]
        return np.hstack([each.columns(motion) for each in beside])

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        return replace(over.load_angle(motion, ratio), bins=120)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a bump of 1 arcsec, shape (n, 1)."""
        return self._bump(motion, self.half_width_deg)[:, np.newaxis]

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the deviations of a bump with a sharper top or a wider foot, shape (n, 2)."""
        widths = (0.5 * self.half_width_deg, 2.0 * self.half_width_deg)
        return FORM * self.height_arcsec * np.column_stack([self._bump(motion, each) for each in widths])

    def _bump(self, motion: Motion, half_width_deg: float) -> FloatArray:
        turns = (motion.motor_deg / self.ratio - self.centre_deg) / DEG_PER_TURN
        away = np.abs(turns - np.round(turns)) * DEG_PER_TURN
        near = np.flatnonzero(away < half_width_deg)
        bump = np.zeros(len(away))
        bump[near] = 0.5 + 0.5 * np.cos((np.pi / half_width_deg) * away[near])
        return bump

    def at(self, motor_deg: float, moment: Moment) -> float:
        turns = (motor_deg / self.ratio - self.centre_deg) / DEG_PER_TURN
        u = abs(turns - round(turns)) * DEG_PER_TURN / self.half_width_deg
        return self.height_arcsec * (0.5 + 0.5 * math.cos(math.pi * u)) if u < 1.0 else 0.0

    def bound_arcsec(self) -> float:
        return abs(self.height_arcsec)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns the slope at the steepest point of the bump's flank."""
        return 0.5 * math.pi * abs(self.height_arcsec) / self.half_width_deg / self.ratio
