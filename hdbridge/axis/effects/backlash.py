"""Backlash behind the gear, from a loose key, a worn coupling or a gear stage on the output."""

from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect, Linear
from hdbridge.axis.effects.described import Cause, Compensable, Experiment, Observations, Shape, Tracker
from hdbridge.axis.effects.motion import FloatArray, Motion, Start
from hdbridge.axis.effects.play import Stop, stop
from hdbridge.units import ARCSEC_PER_DEG

_SOFTNESS = 1.25
"""Minimum crossing angle of a gap that can be inverted, relative to that of an ideal gap."""


class Backlash(Linear):
    """-gap / 2 times the stop operator of the motor angle: the load lags by half the gap in either direction.

    In an ideal gap the load is at rest while the motor crosses ``gap N / 3600`` degrees. The load angle
    then has no inverse, because many motor angles correspond to one load angle. `crossing_deg` may be larger
    (a soft contact). If a gap is too steep to invert, the compensation treats it as a softer gap
    (`gentle_tracker`), and makes the motor jump across most of the gap at once.
    """

    name = "backlash"
    about = Cause(
        title="backlash behind the gear",
        equation="-(gap / 2) s, s = clip(s_before + 2 d theta_M / crossing, -1, 1)",
        signature="after each reversal the load rests, then follows: a loop opposite in sense to the "
        "elastic one",
        consequence="the load lags by half the gap on either side, and is free within the gap",
        remedy="tighten the coupling or key; preload the axis; compensate the rest",
        experiment="reversals under a torque to one side: the torque closes the play, hysteresis stays",
        aliases=("hysteresis_parameters", "wear", "hysteresis_memory"),
        source="play operator (dead zone with a resting load)",
        size="2-36 arcsec",
        apart={
            "hysteresis_parameters": Experiment(
                3, "repeat the small reversals with a load torque to one side: it holds a gap closed"
            ),
            "hysteresis_memory": Experiment(
                3, "reversals of 0.1 to 2 deg of the motor, each beyond the last turning point"
            ),
        },
    )
    compensable = Compensable(
        True,
        "while friction holds the load against one side; leave it out if the load swings freely, because the "
        "motor has to cross the gap at each reversal",
    )
    shape = (Shape("crossing_deg", 0.02, 20.0, logarithmic=True),)
    nonnegative = True
    ordinary_arcsec = 1.0
    """Peak of a gap of 2 arcsec. A misfit of the elastic loop's shape can leave such a residual."""
    linear = ("gap_arcsec",)
    typical = {"gap_arcsec": 10.0, "crossing_deg": 0.02}

    gap_arcsec: float = Field(ge=0, le=3600, description="width of the dead zone, at the load")
    crossing_deg: float = Field(
        gt=0, le=360, description="motor angle that crosses it; at least gap N / 3600"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields a unit backlash for each of several crossing angles, from hard to soft contact."""
        yield from (cls(gap_arcsec=1.0, crossing_deg=each) for each in (0.05, 0.15, 0.4, 1.0, 2.5, 6.0))

    def unidentifiable(self, observations: Observations) -> str:
        """Requires reversals, because backlash is visible only there."""
        return "" if observations.reversals >= 2 else "no reversal in which play would show"

    def tidied(self, ratio: float) -> Self:
        """Increases the crossing angle to the minimum of a gap that can be inverted.

        Because of noise, a fit may return a smaller crossing angle than is physically possible.
        """
        crossing = _SOFTNESS * self.gap_arcsec * ratio / ARCSEC_PER_DEG
        return self.model_copy(update={"crossing_deg": max(crossing, self.crossing_deg)})

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a gap of 1 arcsec, shape (n, 1)."""
        return (-0.5 * stop(motion.motor_deg, self.crossing_deg, start))[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Stop(-0.5 * self.gap_arcsec, self.crossing_deg, start)

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        crossing = max(self.crossing_deg, self.gap_arcsec / fall_arcsec_per_deg)
        return Stop(-0.5 * self.gap_arcsec, crossing, start)

    def bound_arcsec(self) -> float:
        return 0.5 * self.gap_arcsec

    def slope_bound_arcsec_per_deg(self) -> float:
        return self.gap_arcsec / self.crossing_deg
