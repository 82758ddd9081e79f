"""Lost motion that grows with the distance run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from hdbridge.effects.base import (
    Cause,
    Compensable,
    FloatArray,
    Linear,
    Moment,
    Motion,
    Shape,
    Start,
    Tracker,
)
from hdbridge.effects.play import Stop, stop
from hdbridge.units import DEG_PER_TURN


class Wear(Linear):
    """(growth / 2) run s: a loop whose height grows with the motor turns run since the model was measured.

    Growth is signed: a loop that widens in the sense of the elastic one is positive, a growing gap (the load
    lags) negative.
    """

    name: ClassVar[str] = "wear"
    about: ClassVar[Cause] = Cause(
        title="lost motion that grows",
        equation="(growth / 2) run s, run = turns_before + sum |d theta_M| / 360, s = clip(s_before + 2 d "
        "theta_M / width, -1, 1)",
        signature="the distance between the two directions grows steadily with the turns run, at one "
        "temperature",
        consequence="repeatability from either side gets worse with time",
        remedy="calibrate again at intervals; watch the rate; grease; replace the gear when it speeds up",
        experiment="the same stepping test again, cold, some hours of running apart",
        aliases=("amplitude_drift", "zero_drift", "ratio_error", "backlash"),
        source="lost motion proportional to sliding distance (Archard's law)",
        size="grows by 0.1-10 arcsec per thousand motor turns in a fast test",
    )
    compensable: ClassVar[Compensable] = Compensable(
        True, "the turns run are known; they have to be carried over from run to run in turns_before"
    )
    shape: ClassVar[tuple[Shape, ...]] = (Shape("width_deg", 0.05, 60.0, logarithmic=True),)
    linear: ClassVar[tuple[str, ...]] = ("growth_arcsec_per_kiloturn",)
    typical: ClassVar[Mapping[str, Any]] = {"growth_arcsec_per_kiloturn": 1.0, "width_deg": 2.0}
    """One arcsec per thousand turns, crossed in two degrees."""

    growth_arcsec_per_kiloturn: Annotated[
        float, Field(ge=-1000, le=1000, description="growth of the loop's height per 1000 motor turns")
    ]
    width_deg: Annotated[float, Field(gt=0, le=360, description="motor angle of a full crossing")]
    turns_before: Annotated[
        float, Field(ge=0, le=1e9, description="motor turns run before the first sample")
    ] = 0.0
    turns_limit: Annotated[
        float, Field(gt=0, le=1e9, description="motor turns from which on the height is held")
    ] = 10_000.0

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """A growth of one arcsec per 1000 turns, shape (n, 1)."""
        angle = motion.motor_deg
        run = self.turns_before + np.cumsum(np.abs(np.diff(angle, prepend=angle[:1]))) / DEG_PER_TURN
        height = 0.5e-3 * np.minimum(run, self.turns_limit)
        return (height * stop(angle, self.width_deg, start))[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """On-line tracker; its first `advance` only says where the motor stands."""
        return _Tracker(self, start)

    def bound_arcsec(self) -> float:
        """The height at the limit."""
        return 0.5e-3 * abs(self.growth_arcsec_per_kiloturn) * self.turns_limit

    def slope_bound_arcsec_per_deg(self) -> float:
        """The crossing at full height (where it crosses downwards), and the growth along the way."""
        height = self.bound_arcsec()
        crossing = 2.0 * height / self.width_deg if self.growth_arcsec_per_kiloturn < 0.0 else 0.0
        return crossing + 0.5e-3 * abs(self.growth_arcsec_per_kiloturn) / DEG_PER_TURN


class _Tracker(Tracker):
    """State: the stop operator, the distance run (degrees), the last angle."""

    __slots__ = ("_angle", "_before", "_distance", "_limit", "_rate", "_stop")

    def __init__(self, effect: Wear, start: Start) -> None:
        self._rate = 0.5e-3 * effect.growth_arcsec_per_kiloturn
        self._before = effect.turns_before
        self._limit = effect.turns_limit
        self._stop = Stop(effect.width_deg, start)
        self._distance = 0.0
        self._angle: float | None = None

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._rate * self._run(self._to(motor_deg)) * self._stop.at(motor_deg)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        self._distance = self._to(motor_deg)
        self._angle = motor_deg
        return self._rate * self._run(self._distance) * self._stop.to(motor_deg)

    def _to(self, motor_deg: float) -> float:
        return self._distance if self._angle is None else self._distance + abs(motor_deg - self._angle)

    def _run(self, distance_deg: float) -> float:
        return min(self._before + distance_deg / DEG_PER_TURN, self._limit)
