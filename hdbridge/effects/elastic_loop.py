"""What the laws of the elastic loop share: offset, width and exponent, and the branch.

The error is the offset times a loop of unit height (`_unit`), which is what one law has and another has not.

The offset has a sign. Positive: the load is ahead in the direction of motion, and the error rises along
the path. Negative: the load lags, as it does behind friction at the load, and the error falls along the path.
Then the load stands still until the gear has wound up in the other direction, so the fall is at most the
gear's own slope, 3600 / N arcsec per motor degree. Just after a reversal the formula is steeper; there the
inverse takes it with a slope that it can invert (`gentle_tracker`).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field

from hdbridge.effects.base import (
    Coefficient,
    Compensable,
    Effect,
    FloatArray,
    Motion,
    Part,
    Shape,
    Start,
    Tracker,
)
from hdbridge.effects.path import once


def rise(xi: FloatArray, n: float) -> FloatArray:
    """The branch g(xi): 0 at 0, 1 with zero slope at 1 and beyond.

    g(xi) = (xi^(n-1) - (n-1) xi) / (2-n), and xi (1 - ln xi) for n = 2; written with expm1 so that it is
    exact on both sides of n = 2 and through it.
    """
    clipped = np.minimum(xi, 1.0)
    result = np.zeros_like(clipped)
    inside = clipped > 0.0
    logs = -np.log(clipped[inside])
    m = 2.0 - n
    bulge = logs if m == 0.0 else np.expm1(m * logs) / m
    result[inside] = clipped[inside] * (1.0 + bulge)
    return result


def rise_at(xi: float, n: float, steepest: float = math.inf) -> float:
    """`rise` for one number, in plain floats for the control loop; nowhere above ``steepest`` times xi."""
    if xi <= 0.0:
        return 0.0
    if xi >= 1.0:
        return 1.0
    log = -math.log(xi)
    m = 2.0 - n
    slope = 1.0 + (log if m == 0.0 else math.expm1(m * log) / m)
    return xi * (slope if slope < steepest else steepest)


class ElasticLoop(Effect):
    """Base for laws of a loop between plus and minus the offset, homogeneous in it."""

    compensable: ClassVar[Compensable] = Compensable(
        True, "the load really moves so, and the command says where it reverses"
    )
    shape: ClassVar[tuple[Shape, ...]] = (
        Shape("width_deg", 0.5, 120.0, logarithmic=True),
        Shape("exponent", 1.02, 4.0),
    )
    typical: ClassVar[Mapping[str, Any]] = {"offset_arcsec": 40.0, "width_deg": 20.0, "exponent": 1.6}
    """A published gear of ratio 50."""
    part: ClassVar[Part | None] = Part.LOOP
    drifting: ClassVar[tuple[str, ...]] = ("offset_arcsec",)
    """Preload settles, grease and friction change; width and exponent keep their shape."""

    offset_arcsec: Annotated[
        float,
        Field(
            ge=-3600,
            le=3600,
            description="half the height of the loop, at the load; negative where the load lags",
        ),
    ]
    width_deg: Annotated[float, Field(gt=0, le=3600, description="motor angle that a full crossing takes")]
    exponent: Annotated[float, Field(gt=1, le=6, description="shape n of the branch")]

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec, shape (n,)."""
        return self.offset_arcsec * self._loop(motion.motor_deg, start)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """The loop of unit offset, shape (n, 1)."""
        return self._loop(motion.motor_deg, start)[:, np.newaxis]

    def coefficients(self) -> FloatArray:
        """The offset, arcsec, shape (1,)."""
        return np.array([self.offset_arcsec])

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        """The offset."""
        return (Coefficient("offset_arcsec", (0,), ("offset_arcsec",)),)

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Another offset, and another width and exponent where given."""
        return self.model_copy(update={"offset_arcsec": float(coefficients[0]), **dict(shape or {})})

    def bound_arcsec(self) -> float:
        """The offset's size."""
        return abs(self.offset_arcsec)

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """On-line tracker; its first `advance` only says where the motor stands."""
        return self._tracker(start, self.width_deg, math.inf)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Zero where the load leads: along its path the error only rises. Where it lags, the slope at a
        reversal, which is without bound for exponents up to 2.
        """
        if self.offset_arcsec >= 0.0:
            return 0.0
        n = self.exponent
        return -2.0 * self.offset_arcsec / self.width_deg * (n - 1.0) / (n - 2.0) if n > 2.0 else math.inf

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Of a load that lags: the same branch, from each reversal on no steeper than that."""
        if self.offset_arcsec >= 0.0:
            return None
        height = -2.0 * self.offset_arcsec
        width = max(self.width_deg, height / fall_arcsec_per_deg)
        return self._tracker(start, width, fall_arcsec_per_deg * width / height)

    @abstractmethod
    def _tracker(self, start: Start, width_deg: float, steepest: float) -> Tracker:
        """A tracker with this width, whose branch rises by no more than ``steepest`` per width."""

    def _loop(self, motor_deg: FloatArray, start: Start) -> FloatArray:
        """`_unit`, worked out once for all that carry this loop."""
        if not len(motor_deg):
            return np.empty(0)
        key = (self.name, self.width_deg, self.exponent, start)
        return once(motor_deg, start, key, lambda: self._unit(motor_deg, start))

    @abstractmethod
    def _unit(self, motor_deg: FloatArray, start: Start) -> FloatArray:
        """The loop for an offset of one, shape (n,)."""
