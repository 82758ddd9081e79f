"""Shift of the zero position with temperature, because housing, encoder mount and gear expand differently."""

from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.base import Effect, Linear
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable, Experiment, Observations, Tracker
from hdbridge.axis.effects.motion import FloatArray, Motion, Start
from hdbridge.axis.effects.warmth import Warmed, WarmthTracker


class ZeroDrift(Linear, Warmed):
    """drift w: a shift of the zero position proportional to the gear's warmth w."""

    name = "zero_drift"
    about = Cause(
        title="zero moves with temperature",
        subject="drift",
        equation="drift w, w = u - reference, tau du/dt = temperature - u "
        "(or w = warm_up (1 - exp(-t / tau)))",
        signature="a slow shift, the same in both directions, with a time constant of minutes to an hour",
        consequence="all positions are off by the same amount until the axis is as warm as "
        "in its calibration",
        remedy="warm up before work; home warm; a temperature sensor at the gear makes it predictable",
        experiment="return to a reference pose repeatedly while the axis warms and cools; record the "
        "temperature",
        aliases=("creep", "wear", "count_loss", "load_order", "ratio_error"),
        source="thermal expansion with a first-order lag",
        size="5-60 arcsec, tau 10-60 min",
        apart={
            "count_loss": Experiment(
                4, "return to one reference pose every half minute: a step is over, a drift continues"
            ),
            "creep": Experiment(
                10,
                "stand still for ten minutes after a move in each direction: creep takes the sign of the "
                "direction",
            ),
            "ratio_error": Experiment(
                3,
                "sweep a load turn forth and back at twice the speed: a ramp depends on the angle, a "
                "drift on time",
            ),
        },
    )
    compensable = Compensable(
        True, "if the temperature is measured on line; driven by time only after a cold start"
    )
    linear = ("drift_arcsec_per_k",)
    typical = {"drift_arcsec_per_k": 1.0, "tau_s": 1800.0}

    drift_arcsec_per_k: float = Field(ge=-1000, le=1000, description="shift per kelvin")

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields drifts that depend on temperature if it varies in the record, else on time."""
        for driven_by, tau_s in cls.lags(observations):
            yield cls(drift_arcsec_per_k=1.0, tau_s=tau_s, driven_by=driven_by)

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the time, because a plot over time shows the drift of the zero position."""
        return over.time(motion)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a drift of 1 arcsec per kelvin, shape (n, 1)."""
        return self.warmth(motion)[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return WarmthTracker(self, self.drift_arcsec_per_k)

    def bound_arcsec(self) -> float:
        return abs(self.drift_arcsec_per_k) * self.limit_k

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0
