"""Nonlinear-elastic part: hysteresis of the flexspline after each reversal of the motor.

The law is the rolling-friction law of the literature on transmission error, with three points defined that
are usually left open:

* At a reversal the error is continuous: each branch starts from the last value of the one before, and
  rises by ``2 offset g(xi)`` along the new direction until it meets the offset.
* It saturates only in the direction of travel. (Taken literally, "saturated when |error| >= offset" would
  be a relay that jumps by twice the offset at each reversal.)
* At rest the last direction is held.

For 1 < n <= 2 the slope at a reversal is infinite. The input must therefore be the command, not a measured,
quantised angle: one encoder count of chatter would cause an error of several arcseconds.
"""

from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.described import Cause, Observations, Part, Tracker
from hdbridge.axis.effects.elastic_loop import ElasticLoop, rise, rise_at
from hdbridge.axis.effects.motion import FloatArray, Moment, Start
from hdbridge.axis.effects.path import path_of


class Hysteresis(ElasticLoop):
    """Continuous branches ``theta_rev + sgn 2 offset g(|theta_M - theta_M,rev| / width)``.

    Each branch is limited to the offset in its direction.
    """

    name = "hysteresis"
    about = Cause(
        title="nonlinear-elastic transmission error (hysteresis)",
        equation="theta_rev + sgn(omega) 2 offset g(xi), limited to sgn(omega) offset; "
        "xi = |theta_M - theta_M,rev| / width; offset > 0: the load leads, offset < 0: it lags",
        signature="a loop of constant height between the two directions; after a reversal it takes a fixed "
        "motor angle to cross",
        consequence="the load overshoots its target (offset > 0) or stops short of it (offset < 0), from "
        "either side",
        remedy="compensate it; a leading loop grows with preload and friction of the mesh, a lagging one "
        "with friction at the load",
        experiment="slow sines of several amplitudes, some smaller than the width",
        aliases=("backlash",),
        source="rolling-friction law with exponent n; the height is twice the offset",
        size="10-80 arcsec from side to side",
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields a narrow, a typical and a wide loop for a model without a loop."""
        if all(each.part is not Part.LOOP for each in base):
            for width in (3.0, 20.0, 60.0):
                yield cls(offset_arcsec=1.0, width_deg=width, exponent=1.6)

    def _tracker(self, start: Start, width_deg: float, steepest: float) -> Tracker:
        return _HysteresisTracker(self.offset_arcsec, width_deg, self.exponent, start, steepest)

    def _unit(self, motor_deg: FloatArray, start: Start) -> FloatArray:
        """Returns the hysteresis for an offset of 1 arcsec; vectorised except for a loop over branches."""
        path = path_of(motor_deg, start)
        value = float(start.value)
        values = []
        crossed = np.abs(path.steps_deg) / self.width_deg
        heights = 2.0 * rise(crossed, self.exponent)
        if start is Start.VIRGIN:
            heights[:1] = rise(2.0 * crossed[:1], self.exponent)
        for height, sign in zip(heights.tolist(), path.signs, strict=True):
            values.append(value)
            value = sign * min(sign * value + height, 1.0)
        first = path.turning[0] + 1
        result = np.full(len(motor_deg), float(start.value))
        result[first:] = path.sense
        # All samples further from the reversal than the width are saturated.
        way_deg = np.abs(path.away_deg)
        near = np.flatnonzero(way_deg < self.width_deg)
        sense, begun = path.sense[near], np.repeat(values, path.lengths)[near]
        xi_of = way_deg[near] / self.width_deg
        height = 2.0 * rise(xi_of, self.exponent)
        if start is Start.VIRGIN:
            virgin = near < np.sum(path.lengths[:1])
            height[virgin] = rise(2.0 * xi_of[virgin], self.exponent)
        result[first + near] = sense * np.minimum(sense * begun + height, 1.0)
        return result


class _HysteresisTracker(Tracker):
    """Tracker of a hysteresis loop.

    The state consists of the current branch (initial angle and value, direction) and the last angle and
    value. Values are those of a loop of unit offset.
    """

    def __init__(self, offset: float, width: float, exponent: float, start: Start, steepest: float) -> None:
        self._offset = offset
        self._width = width
        self._exponent = exponent
        self._steepest = steepest
        self._sign = start.value
        self._value = float(start.value)
        self._virgin = start is Start.VIRGIN
        self._angle: float | None = None
        self._branch_angle = 0.0
        self._branch_value = self._value

    @property
    def memory_deg(self) -> float:
        """The width, the motor travel from one side of the loop to the other."""
        return self._width

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._offset * self._at(motor_deg)

    def _at(self, motor_deg: float) -> float:
        last = self._angle
        if last is None or motor_deg == last:
            return self._value
        sign = 1 if motor_deg > last else -1
        if sign == self._sign:
            origin, value, virgin = self._branch_angle, self._branch_value, self._virgin
        else:
            origin, value, virgin = last, self._value, self._virgin and self._sign == 0
        xi = abs(motor_deg - origin) / self._width
        if xi >= 1.0:
            return float(sign)  # every branch ends here
        if virgin:
            height = rise_at(2.0 * xi, self._exponent, self._steepest)
        else:
            height = 2.0 * rise_at(xi, self._exponent, self._steepest)
        return sign * min(sign * value + height, 1.0)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        last = self._angle
        if last is None:
            self._angle = self._branch_angle = motor_deg
            return self._offset * self._value
        value = self._at(motor_deg)
        if motor_deg != last:
            sign = 1 if motor_deg > last else -1
            if sign != self._sign:
                self._virgin = self._virgin and self._sign == 0
                self._branch_angle, self._branch_value, self._sign = last, self._value, sign
            self._angle = motor_deg
            self._value = value
        return self._offset * value
