"""Prefilter of the correction in motion: applies the filter of `Response` along the predicted path.

The correction is predicted for load targets a few cycles ahead, extrapolated from the last three targets at
constant acceleration. At rest the prediction equals the correction, and the filter returns it unchanged.

Pure: no clock, no bus.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import repeat
from operator import mul

from hdbridge.axis.effects import Channel, Moment
from hdbridge.axis.model.response import LeadFilter

_VARYING = frozenset({Channel.SPEED, Channel.LOAD_ANGLE})


class Prefilter:
    """Filters a correction; one call per cycle."""

    def __init__(self, lead: LeadFilter, period_s: float, needs: frozenset[Channel]) -> None:
        """``needs`` are the channels of the compensated effects; speed and load angle are extrapolated."""
        self._weights = lead.weights
        self._varies = not _VARYING.isdisjoint(needs)
        self._feedback = (*lead.feedback, 0.0, 0.0)[:2]
        self._output = self._before = 0.0
        """Outputs of the last two cycles, arcsec."""
        self._predicted = deque(repeat(0.0, len(lead.weights)), len(lead.weights))
        """Predicted corrections, arcsec, furthest ahead first."""
        first, per_cycle = lead.lead_cycles, lead.per_cycle
        ahead = [first - j / per_cycle for j in range(per_cycle - 1, -1, -1)]
        self._reaches = tuple((s, 0.5 * s * (s + 1.0)) for s in ahead)
        """Factors of the target's last step, and of the last change of this step, for each new prediction."""
        self._full_step = lead.full_speed_deg_s * period_s
        self._last: float | None = None
        self._step = 0.0

    def reset(self, correction_arcsec: float) -> None:
        """Starts at rest with this correction."""
        self._predicted.extend(repeat(correction_arcsec, len(self._weights)))
        self._output = self._before = correction_arcsec
        self._last = None
        self._step = 0.0

    def take_over(self, other: Prefilter | None, correction_arcsec: float) -> None:
        """Continues from another filter; starts with this correction if the two filters differ in form."""
        self.reset(correction_arcsec)
        if other is not None and (other._reaches, len(other._weights)) == (self._reaches, len(self._weights)):
            self._predicted = other._predicted.copy()
            self._last, self._step = other._last, other._step
            self._output, self._before = other._output, other._before

    def follow(
        self,
        load_deg: float,
        correction_arcsec: float,
        moment: Moment,
        predict: Callable[[float, Moment], float],
    ) -> float:
        """Returns the filtered correction of this cycle, arcsec.

        ``correction_arcsec`` belongs to the load target ``load_deg``; ``predict`` returns the correction at
        any load target without changing any state.
        """
        step = 0.0 if self._last is None else load_deg - self._last
        change = step - self._step if self._last is not None else 0.0
        self._last, self._step = load_deg, step
        predicted = self._predicted
        if step == 0.0 and change == 0.0:
            predicted.extendleft(repeat(correction_arcsec, len(self._reaches)))
            self._output, self._before = correction_arcsec, self._output
            return correction_arcsec
        then = moment
        grown = moment.motor_speed_deg_s * change / step if step else 0.0
        for by_step, by_change in self._reaches:
            ahead_deg = load_deg + by_step * step + by_change * change
            if self._varies:
                then = moment._replace(
                    motor_speed_deg_s=moment.motor_speed_deg_s + by_step * grown, load_deg=ahead_deg
                )
            predicted.appendleft(predict(ahead_deg, then))
        first, second = self._feedback
        output: float = sum(map(mul, self._weights, predicted)) - first * self._output - second * self._before
        self._output, self._before = output, self._output
        return correction_arcsec + min((step / self._full_step) ** 2, 1.0) * (output - correction_arcsec)
