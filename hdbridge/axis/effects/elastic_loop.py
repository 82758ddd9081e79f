"""Common base of the elastic-loop laws: offset, width and exponent, and the branch.

The error is the offset times a loop of unit offset (`_unit`), in which the laws differ.

If the offset is positive, the load leads in the direction of motion, and the error rises along the path. If
it is negative, the load lags, as it does with friction at the load, and the error falls along the path. After
a reversal a lagging load is at rest until the gear has wound up in the other direction, so the error falls
by no more than the gear's own slope, 3600 / N arcsec per motor degree. Just after a reversal the formula is
steeper. The inverse therefore uses a smaller slope there (`gentle_tracker`).
"""

import math
from abc import abstractmethod

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Linear
from hdbridge.axis.effects.described import Compensable, Part, Shape, Tracker
from hdbridge.axis.effects.motion import FloatArray, Motion, Start
from hdbridge.axis.effects.path import once


def rise(xi: FloatArray, n: float) -> FloatArray:
    """Returns the branch g(xi), which rises from 0 at xi = 0 to 1 at xi = 1 and remains constant beyond.

    g(xi) = (xi^(n-1) - (n-1) xi) / (2-n), and xi (1 - ln xi) for n = 2. The form with expm1 is accurate at
    and near n = 2.
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
    """Returns `rise` for one number in plain floats, for the control loop; at most ``steepest`` times xi."""
    if xi <= 0.0:
        return 0.0
    if xi >= 1.0:
        return 1.0
    log = -math.log(xi)
    m = 2.0 - n
    slope = 1.0 + (log if m == 0.0 else math.expm1(m * log) / m)
    return xi * (slope if slope < steepest else steepest)


class ElasticLoop(Linear):
    """Base class of hysteresis laws: a loop between plus and minus the offset, proportional to the offset."""

    compensable = Compensable(True, "the load really has this error, and the command says where it reverses")
    shape = (
        Shape("width_deg", 0.5, 120.0, logarithmic=True),
        Shape("exponent", 1.02, 4.0),
    )
    typical = {"offset_arcsec": 40.0, "width_deg": 20.0, "exponent": 1.6}
    """Loop of a published gear with ratio 50."""
    part = Part.LOOP
    linear = ("offset_arcsec",)
    drifting = ("offset_arcsec",)
    """Only the offset drifts, because preload settles and friction changes."""

    offset_arcsec: float = Field(
        ge=-3600,
        le=3600,
        description="half the height of the loop, at the load; negative if the load lags",
    )
    width_deg: float = Field(gt=0, le=3600, description="motor angle that a full crossing takes")
    exponent: float = Field(gt=1, le=6, description="shape n of the branch")

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        return self.offset_arcsec * self._loop(motion.motor_deg, start)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        return self._loop(motion.motor_deg, start)[:, np.newaxis]

    def bound_arcsec(self) -> float:
        return abs(self.offset_arcsec)

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return self._tracker(start, self.width_deg, math.inf)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns 0 if the load leads, because the error only rises along its path.

        If the load lags, returns the slope just after a reversal, which is infinite for exponents up to 2.
        """
        if self.offset_arcsec >= 0.0:
            return 0.0
        n = self.exponent
        return -2.0 * self.offset_arcsec / self.width_deg * (n - 1.0) / (n - 2.0) if n > 2.0 else math.inf

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Returns a tracker with limited slope after each reversal if the load lags, else None."""
        if self.offset_arcsec >= 0.0:
            return None
        height = -2.0 * self.offset_arcsec
        width = max(self.width_deg, height / fall_arcsec_per_deg)
        return self._tracker(start, width, fall_arcsec_per_deg * width / height)

    @abstractmethod
    def _tracker(self, start: Start, width_deg: float, steepest: float) -> Tracker:
        """Returns a tracker with this width; the slope of its branch is at most ``steepest`` per width."""

    def _loop(self, motor_deg: FloatArray, start: Start) -> FloatArray:
        """Returns `_unit`, computed only once for all effects that contain this loop."""
        if not len(motor_deg):
            return np.empty(0)
        key = (self.name, self.width_deg, self.exponent, start)
        return once(motor_deg, start, key, lambda: self._unit(motor_deg, start))

    @abstractmethod
    def _unit(self, motor_deg: FloatArray, start: Start) -> FloatArray:
        """Returns the loop for an offset of 1 arcsec, shape (n,)."""
