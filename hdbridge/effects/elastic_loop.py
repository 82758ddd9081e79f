"""What the laws of the elastic loop share: offset, width and exponent, and the branch.

The error is the offset times a loop of unit height (`_unit`), which is what one law has and another has not.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field

from hdbridge.effects.base import Compensable, Effect, FloatArray, Motion, Shape, Start


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


def rise_at(xi: float, n: float) -> float:
    """`rise` for one number, in plain floats for the control loop."""
    if xi <= 0.0:
        return 0.0
    if xi >= 1.0:
        return 1.0
    log = -math.log(xi)
    m = 2.0 - n
    return xi * (1.0 + (log if m == 0.0 else math.expm1(m * log) / m))


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

    offset_arcsec: Annotated[
        float, Field(ge=0, le=3600, description="half the height of the loop, at the load")
    ]
    width_deg: Annotated[float, Field(gt=0, le=3600, description="motor angle that a full crossing takes")]
    exponent: Annotated[float, Field(gt=1, le=6, description="shape n of the branch")]

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec, shape (n,)."""
        return self.offset_arcsec * self._unit(motion.motor_deg, start)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """The loop of unit offset, shape (n, 1)."""
        return self._unit(motion.motor_deg, start)[:, np.newaxis]

    def coefficients(self) -> FloatArray:
        """The offset, arcsec, shape (1,)."""
        return np.array([self.offset_arcsec])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Another offset, and another width and exponent where given."""
        return self.model_copy(update={"offset_arcsec": float(coefficients[0]), **dict(shape or {})})

    def bound_arcsec(self) -> float:
        """The offset."""
        return self.offset_arcsec

    def slope_bound_arcsec_per_deg(self) -> float:
        """Zero: along its path hysteresis only rises."""
        return 0.0

    @abstractmethod
    def _unit(self, motor_deg: FloatArray, start: Start) -> FloatArray:
        """The loop for an offset of one, shape (n,)."""
