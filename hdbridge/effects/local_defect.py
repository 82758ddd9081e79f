"""A bump at one load angle: a damaged tooth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from hdbridge.effects.base import (
    Cause,
    Compensable,
    FloatArray,
    Linear,
    Memoryless,
    Moment,
    Motion,
    Shape,
    Start,
    Tracker,
)
from hdbridge.effects.load_order import Ratio
from hdbridge.units import DEG_PER_TURN


class LocalDefect(Linear):
    """height (1 + cos(pi u)) / 2 for |u| < 1, u = (theta_M / N - centre, wrapped) / half width."""

    name: ClassVar[str] = "local_defect"
    about: ClassVar[Cause] = Cause(
        title="bump at one load angle",
        equation="height (1 + cos(pi u)) / 2 where |u| < 1, u = ((theta_M / N - centre) mod 360 deg) / "
        "half_width",
        signature="the same bump on every pass over one load angle, in both directions, and nothing "
        "elsewhere",
        consequence="the load is off at this one place, and the tooth wears on",
        remedy="look at the tooth; compensate it meanwhile; a mark on the load encoder's disc looks the "
        "same: clean it",
        experiment="several slow passes over the place, both ways, and again with the load encoder "
        "re-clocked",
        aliases=("load_order",),
        source="raised cosine as a smooth bump of finite extent",
        size="1-20 arcsec",
    )
    compensable: ClassVar[Compensable] = Compensable(
        True, "the load really moves so, if it is a tooth and no mark on the encoder's disc"
    )
    shape: ClassVar[tuple[Shape, ...]] = (
        Shape("centre_deg", 0.0, 360.0),
        Shape("half_width_deg", 0.05, 30.0, logarithmic=True),
    )
    linear: ClassVar[tuple[str, ...]] = ("height_arcsec",)
    typical: ClassVar[Mapping[str, Any]] = {"height_arcsec": 5.0, "centre_deg": 0.0, "half_width_deg": 3.6}
    """Five arcsec, a tooth of 3.6 degrees wide."""

    ratio: Ratio
    height_arcsec: Annotated[float, Field(ge=-3600, le=3600, description="height of the bump")]
    centre_deg: Annotated[float, Field(ge=-360, le=360, description="load angle of its centre")]
    half_width_deg: Annotated[
        float, Field(gt=0, le=180, description="load angle from its centre to its foot")
    ]

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """A bump of one arcsec, shape (n, 1)."""
        turns = (motion.motor_deg / self.ratio - self.centre_deg) / DEG_PER_TURN
        away = np.abs(turns - np.round(turns)) * DEG_PER_TURN
        bump = 0.5 + 0.5 * np.cos(np.pi * np.minimum(away / self.half_width_deg, 1.0))
        return np.asarray(bump)[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """On-line tracker; it has no state."""
        return _Tracker(self)

    def bound_arcsec(self) -> float:
        """The height."""
        return abs(self.height_arcsec)

    def slope_bound_arcsec_per_deg(self) -> float:
        """The flank's steepest place."""
        return 0.5 * math.pi * abs(self.height_arcsec) / self.half_width_deg / self.ratio


class _Tracker(Memoryless):
    __slots__ = ("_centre", "_height", "_ratio", "_width")

    def __init__(self, effect: LocalDefect) -> None:
        self._height = effect.height_arcsec
        self._centre = effect.centre_deg
        self._width = effect.half_width_deg
        self._ratio = effect.ratio

    def peek(self, motor_deg: float, moment: Moment) -> float:
        turns = (motor_deg / self._ratio - self._centre) / DEG_PER_TURN
        u = abs(turns - round(turns)) * DEG_PER_TURN / self._width
        return self._height * (0.5 + 0.5 * math.cos(math.pi * u)) if u < 1.0 else 0.0
