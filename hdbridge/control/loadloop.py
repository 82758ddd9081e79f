"""Slow loop closed over the load encoder: removes the mean error at rest that the model leaves.

The compensation is feed-forward, so the error left by an outdated model goes undetected. This loop integrates
the error (load target minus load encoder) at rest and adds the result to the load target. In motion the error
is mostly delay, and the value is held. The value is bounded and its slew is limited. It fades out in three
cases, with the reason in `LoadLoop.doubt`:

    the error is too large             more than twice the bound; ends when it is smaller
    the load encoder moved at rest     without the motor; ends when it has moved back
    the load encoder does not follow   the motor, which the loop moves at rest; ends when it follows

The last two compare the load encoder with the load angle from motor encoder and model. A difference is
explained up to one count of each encoder at the load plus the noise of the difference. In the last case, the
assumed maximum error of the model's hysteresis (the slack) is added to this limit. The noise is measured at
rest, and a slow drift of the load against the motor is tracked. If a doubt about the encoder does not end at
the position where it arose, it ends when both encoders have agreed at rest after motion in both directions.

Pure: no clock, no bus.
"""

from __future__ import annotations

import math
from typing import Final

from hdbridge.axis.effects import Moment, Start
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError

SETTLED_S: Final = 0.3
"""Settling time of the load: time at rest before the loop acts."""
_AVERAGED_S: Final = 0.05
"""Time constant of the averages at rest."""
_NOISE_S: Final = 1.0
"""Time constant of the noise estimate."""
_DRIFT_S: Final = 600.0
"""Time constant for tracking a drift of the load against the motor at rest."""
_AGREED_S: Final = 1.0
"""Time at rest for which a load encoder that has moved back must keep its position to end a doubt; doubled at
each further doubt."""
_AGREED_MAX_S: Final = 600.0
_SIGMAS: Final = 8.0
"""Maximum deviation that counts as noise, in standard deviations."""
_SIGMA_OF_MEAN_DEVIATION: Final = math.sqrt(math.pi / 2.0)
"""Ratio of the standard deviation to the mean absolute deviation of normal readings."""
_LEAST_SHARE: Final = 0.5
"""Minimum ratio of the loop's bound to the mean error; below it, the loop does not act."""
_OUTLIERS: Final = 2
"""Number of consecutive unexplained readings after which the load encoder counts as displaced."""
_AGREEMENT: Final = 1.0 / 3.0
"""Fraction of the greatest disagreement between the encoders below which they agree again."""
_MODEL_ERROR: Final = 0.25
"""Assumed maximum relative error of a model's hysteresis."""
_PLACES: Final = 24
"""Number of intervals between the positions at which the width of a hysteresis loop is evaluated."""
_BOTH: Final = frozenset({-1, 1})


def loop_width_arcsec(model: TransmissionModel) -> float:
    """Returns the greatest width of a model's hysteresis loop, arcsec at the load; 0 without memory."""
    tracker, moment = model.tracker(Start.VIRGIN), Moment()
    span_deg = 2.0 * tracker.memory_deg
    if not 0.0 < span_deg < math.inf:
        return 0.0
    tracker.advance(-span_deg, moment)
    places_deg = [span_deg * place / _PLACES for place in range(_PLACES + 1)]
    forward = [tracker.advance(each, moment) for each in places_deg]
    tracker.advance(2.0 * span_deg, moment)
    backward = [tracker.advance(each, moment) for each in reversed(places_deg)]
    return max(abs(one - other) for one, other in zip(forward, reversed(backward), strict=True))


class LoadLoop:
    """Load loop of one axis; `step` is called once per control period. All values are arcsec at the load."""

    def __init__(
        self,
        gain_1_s: float,
        maximum_arcsec: float,
        slew_arcsec_s: float,
        period_s: float,
        *,
        counts_arcsec: float,
    ) -> None:
        """``gain_1_s`` is the fraction of the error removed per second; ``maximum_arcsec`` bounds the value.

        ``counts_arcsec`` is one count of the motor encoder plus one of the load encoder, both at the load.
        Raises InputError for numbers that are not finite and positive, and for a gain at which the loop would
        oscillate.
        """
        for name, number in (
            ("gain_1_s", gain_1_s),
            ("maximum_arcsec", maximum_arcsec),
            ("slew_arcsec_s", slew_arcsec_s),
            ("period_s", period_s),
            ("counts_arcsec", counts_arcsec),
        ):
            if not (math.isfinite(number) and number > 0.0):
                raise InputError(f"load loop: {name} is {number!r}; expected a finite number above 0")
        if gain_1_s * _AVERAGED_S > 0.25:
            raise InputError(
                f"load loop: gain_1_s is {gain_1_s:g}; expected at most {0.25 / _AVERAGED_S:g}: it must "
                "be slower than the settling of drive and gear"
            )
        self._gain_step = gain_1_s * period_s
        self._maximum = maximum_arcsec
        self._most = maximum_arcsec / _LEAST_SHARE
        self._slew_step = slew_arcsec_s * period_s
        self._counts = counts_arcsec
        self._share = min(period_s / _AVERAGED_S, 1.0)
        self._noise_share = min(period_s / _NOISE_S, 1.0)
        self._drift_share = min(period_s / _DRIFT_S, 1.0)
        self._patience = 0
        self._patience_min = math.ceil(_AGREED_S / period_s)
        self._patience_max = math.ceil(_AGREED_MAX_S / period_s)
        self._settled = max(math.ceil(SETTLED_S / period_s), 1)
        self._slack = maximum_arcsec
        """Assumed maximum lag of the load behind the motor beyond the predicted hysteresis."""
        self._value = 0.0
        self._standing = self._outliers = 0
        """Number of periods at rest, and of consecutive readings outside the explained range."""
        self._difference = self._motor = self._error = 0.0
        """Averages at rest: load encoder minus load angle from motor encoder and model, that load angle, and
        the error without this loop."""
        self._noise = 0.0
        """Mean absolute deviation of the difference from its average at rest, minus that of the motor."""
        self._noise_readings = 0
        self._reference = self._rest_motor = 0.0
        """Averages when the axis came to rest; during a doubt about the encoder, the averages before the
        doubt."""
        self._doubt = ""
        self._beyond = False
        """True if the doubt is about the size of the error rather than the encoder."""
        self._jumped = self._jumped_most = self._off = 0.0
        """During a doubt about the encoder: sum of the load encoder's displacements at rest, the greatest
        such sum, and the greatest disagreement between the encoders."""
        self._agreeing = 0
        """Number of readings since the sum of the load encoder's displacements at rest became small."""
        self._agreed = frozenset[int]()
        """Directions of motion after which the encoders have agreed again."""

    @property
    def value_arcsec(self) -> float:
        """Current addition to the load target."""
        return self._value

    @property
    def doubt(self) -> str:
        """Reason why the loop does not act, in words; empty while it acts."""
        return self._doubt

    def use_models(self, whole: TransmissionModel, predicting: TransmissionModel) -> None:
        """Sets the models: ``predicting`` gives the ``motor`` of `step`, ``whole`` has the full hysteresis.

        The load may lag the motor by the unpredicted part of the hysteresis, and by a fraction of the
        predicted part. If the hysteresis is unknown, only the loop's own bound limits the lag.
        """
        width = loop_width_arcsec(whole)
        known = (1.0 - _MODEL_ERROR) * loop_width_arcsec(predicting)
        self._slack = width - known if width else self._maximum
        self._standing = 0

    def reset(self, value_arcsec: float = 0.0) -> None:
        """Restarts at ``value_arcsec``, which the load target already contains, and clears a doubt."""
        if not math.isfinite(value_arcsec):
            raise InputError(f"load loop: a value of {value_arcsec!r} arcsec; expected a finite number")
        self._value = min(max(value_arcsec, -self._maximum), self._maximum)
        self._doubt, self._beyond = "", False
        self._patience = 0
        self._standing = 0

    def step(self, target: float, load: float | None, motor: float, moving: bool) -> float:
        """Runs one period; returns the slew-limited addition to the load target, arcsec.

        ``target`` is the load target without this addition, ``load`` the load encoder (None without a fresh
        reading), ``motor`` the load angle by the motor encoder and the model.
        """
        if load is None or not math.isfinite(load) or not math.isfinite(motor):
            self._standing = 0
            return self._fade()
        if moving:
            self._standing = 0
        else:
            self._standing += 1
            # Error without this loop.
            error = target + self._value - load
            if self._standing <= self._settled:
                self._settle(error, load - motor, motor)
            else:
                self._observe(error, load - motor, motor)
        if self._doubt:
            return self._fade()
        if self._standing > self._settled and not self._outliers:
            step = min(max(self._gain_step * (target - load), -self._slew_step), self._slew_step)
            self._value = min(max(self._value + step, -self._maximum), self._maximum)
        return self._value

    # ---------------------------------------------------------------- at rest

    def _settle(self, error: float, difference: float, motor: float) -> None:
        """Adds a reading during settling to the averages, in which the first readings lose their weight."""
        self._outliers = 0
        self._average(error, difference, motor, max(self._share, 1.0 / self._standing))
        if self._standing < self._settled:
            return
        if self._doubt and not self._beyond:
            self._compare()
        if not self._doubt or self._beyond:
            self._reference, self._rest_motor = self._difference, self._motor
        if self._beyond and abs(self._error) <= self._most:
            self._end()

    def _observe(self, error: float, difference: float, motor: float) -> None:
        """Evaluates a reading at rest, after the load has settled; begins or ends a doubt."""
        deviation = difference - self._difference
        explained = self._explained() + 2.0 * abs(motor - self._motor)
        if abs(deviation) > explained:
            self._outliers += 1
            if self._outliers == _OUTLIERS:
                self._jump(deviation, explained)
            return
        self._outliers = 0
        self._average(error, difference, motor, self._share)
        if self._doubt and not self._beyond:
            back = abs(self._jumped) <= max(self._explained(), _AGREEMENT * self._jumped_most)
            self._agreeing = self._agreeing + 1 if back else 0
            if self._agreeing >= self._patience:
                self._end()
            return
        self._reference += self._drift_share * (self._difference - self._reference)
        self._rest_motor += self._drift_share * (self._motor - self._rest_motor)
        moved = self._motor - self._rest_motor
        missing = math.copysign(1.0, moved) * (self._reference - self._difference)
        explained = self._explained() + self._slack
        if min(missing, abs(moved)) > explained:
            self._suspect(
                f"the load encoder lags the motor by {missing:.1f} arcsec at rest; count, noise and "
                f"hysteresis of this axis explain {explained:.1f}", self._difference - self._reference,
            )  # fmt: skip
        elif not self._doubt and abs(self._error) > self._most:
            self._beyond = True
            self._doubt = (
                f"the mean error at rest is {self._error:.1f} arcsec without the loop, which adds at most "
                f"{self._maximum:g}"
            )
        elif self._beyond and abs(self._error) < self._most - self._explained():
            self._end()

    def _average(self, error: float, difference: float, motor: float, share: float) -> None:
        deviation, moved = difference - self._difference, motor - self._motor
        self._difference += share * deviation
        self._motor += share * moved
        self._error += share * (error - self._error)
        if self._standing > self._settled or (self._standing > 1 and self._noise_readings < self._settled):
            self._noise_readings += 1
            noise_share = max(self._noise_share, 1.0 / self._noise_readings)
            self._noise += noise_share * (max(abs(deviation) - abs(moved), 0.0) - self._noise)

    def _explained(self) -> float:
        """Returns the largest encoder difference at rest that counts and noise can explain."""
        return self._counts + _SIGMAS * _SIGMA_OF_MEAN_DEVIATION * self._noise

    # ---------------------------------------------------------------- doubt about the encoder

    def _jump(self, size: float, explained: float) -> None:
        """Records that the load encoder moved by ``size`` at rest, and shifts the averages accordingly."""
        self._outliers = 0
        self._difference += size
        self._error -= size
        if self._doubt and not self._beyond:
            self._jumped += size
            self._jumped_most = max(self._jumped_most, abs(self._jumped))
            self._agreeing = 0
            return
        self._suspect(
            f"the load encoder moved by {size:.1f} arcsec without the motor; count and noise of this axis "
            f"explain {explained:.1f}", size,
        )  # fmt: skip

    def _suspect(self, words: str, size: float) -> None:
        self._doubt, self._beyond = words, False
        self._jumped, self._agreed, self._agreeing = size, frozenset(), 0
        self._off = self._jumped_most = abs(size)
        self._patience = min(max(2 * self._patience, self._patience_min), self._patience_max)

    def _compare(self) -> None:
        """Ends the doubt if the encoders have agreed at rest after motion in both directions."""
        off = abs(self._difference - self._reference)
        self._off = max(self._off, off)
        tolerance = max(self._explained(), min(_AGREEMENT * self._off, self._maximum))
        if off > tolerance:
            self._agreed = frozenset()
        moved = self._motor - self._rest_motor
        # A load encoder that is stuck cannot agree at both of two rest positions that are farther apart.
        if abs(moved) > max(self._explained() + self._slack, 3.0 * tolerance):
            self._rest_motor = self._motor
            if off <= tolerance:
                self._agreed |= {1 if moved > 0.0 else -1}
                if self._agreed == _BOTH:
                    self._end()

    def _end(self) -> None:
        """Ends the doubt; the loop continues from its faded value."""
        self._doubt, self._beyond = "", False
        self._reference, self._rest_motor = self._difference, self._motor

    def _fade(self) -> float:
        value, step = self._value, self._slew_step
        self._value = 0.0 if abs(value) <= step else value - math.copysign(step, value)
        return self._value
