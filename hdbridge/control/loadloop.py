"""A slow loop over the load encoder: takes away what the model leaves of the mean error at rest.

The compensation is feed-forward: a model that has aged leaves an error that nobody sees. While the load encoder
can be believed, this loop integrates the error (load target less load encoder) and adds to the load target. It
is slow and bounded so that it can do little harm.

* It integrates at rest only. In motion the error is mostly delay, and the value is held.
* An error beyond the loop's own bound is not what it is there for: the value is faded out.
* The load encoder is compared with the motor encoder. Motor encoder and model say how far the load has moved
  since the axis came to rest. If the load encoder differs by more than this axis can explain, it is in doubt,
  and the value is faded out until the two agree again.

What an axis can explain is measured in its own units:

    the load moved without the motor     a motor count at the load, and the load encoder's noise
    the load did not follow the motor    the same, and the slack: what the model may miss of the hysteresis

The noise is measured at rest. Slow drift of the load against the motor is followed.

Pure: no clock, no bus.
"""

from __future__ import annotations

import math
from typing import Final

from hdbridge.effects import Moment, Start
from hdbridge.errors import InputError
from hdbridge.model import TransmissionModel

_SETTLED_S: Final = 0.3
"""At rest it only measures for so long: the load settles."""
_AVERAGED_S: Final = 0.05
"""Time constant of the averages at rest."""
_NOISE_S: Final = 1.0
"""Time constant of the noise estimate."""
_DRIFT_S: Final = 600.0
"""Time constant with which a drift of the load against the motor is followed at rest."""
_NOISE_LIMIT: Final = 8.0
"""Standard deviations of the load encoder that are noise."""
_OUTLIERS: Final = 2
"""Readings in a row that are no single disturbance."""
_AGREEMENT: Final = 1.0 / 3.0
"""The encoders agree again if they differ by less than this share of the greatest difference in the doubt."""
_SIGMA_OF_MEAN_STEP: Final = 0.886
"""Standard deviation of normal readings, by the mean absolute difference of two in a row."""
_MODEL_ERROR: Final = 0.25
"""Share of a hysteresis by which its model may be wrong."""
_PLACES: Final = 24
"""Positions at which the width of a hysteresis loop is looked at."""


def loop_width_arcsec(model: TransmissionModel) -> float:
    """Greatest difference of a model's error between the two directions of motion, arcsec at the load.

    0 for a model without memory of its path.
    """
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
    """One axis's; one call of `step` per control period. Everything is arcsec at the load."""

    __slots__ = (
        "_count", "_doubt", "_drift_share", "_gain_step", "_last", "_load", "_maximum", "_motor", "_noise",
        "_noise_share", "_off", "_outliers", "_reference", "_rest_motor", "_settled", "_share", "_slack",
        "_slew_step", "_standing", "_stuck_at", "_value",
    )  # fmt: skip

    def __init__(
        self,
        gain_1_s: float,
        maximum_arcsec: float,
        slew_arcsec_s: float,
        period_s: float,
        *,
        motor_count_arcsec: float,
        load_count_arcsec: float,
    ) -> None:
        """``gain_1_s``: share of the error that is taken away per second; ``maximum_arcsec``: bound of the value.

        ``motor_count_arcsec`` and ``load_count_arcsec`` are one count of each encoder, at the load. InputError
        for numbers that are not finite and above 0, and for a gain with which the loop would swing.
        """
        for name, number in (
            ("gain_1_s", gain_1_s),
            ("maximum_arcsec", maximum_arcsec),
            ("slew_arcsec_s", slew_arcsec_s),
            ("period_s", period_s),
            ("motor_count_arcsec", motor_count_arcsec),
            ("load_count_arcsec", load_count_arcsec),
        ):
            if not (math.isfinite(number) and number > 0.0):
                raise InputError(f"load loop: {name} is {number!r}; expected a finite number above 0")
        if gain_1_s * _AVERAGED_S > 0.25:
            raise InputError(
                f"load loop: gain_1_s is {gain_1_s:g}; expected at most {0.25 / _AVERAGED_S:g}: it is "
                "meant to be slower than the drive and the gear settle"
            )
        self._gain_step = gain_1_s * period_s
        self._maximum = maximum_arcsec
        self._slew_step = slew_arcsec_s * period_s
        self._count = motor_count_arcsec
        self._share = min(period_s / _AVERAGED_S, 1.0)
        self._noise_share = min(period_s / _NOISE_S, 1.0)
        self._drift_share = min(period_s / _DRIFT_S, 1.0)
        self._settled = max(math.ceil(_SETTLED_S / period_s), 1)
        self._noise = load_count_arcsec
        """Mean absolute difference of two readings in a row."""
        self._slack = maximum_arcsec
        """By how much the load may follow the motor less than the model says."""
        self._value = 0.0
        self._standing = self._outliers = 0
        """Periods at rest; readings in a row that are off."""
        self._load = self._motor = 0.0
        """Averages at rest, of the difference of the encoders and of the load by the motor encoder."""
        self._reference = self._rest_motor = 0.0
        """The same when the axis came to rest, or before the doubt."""
        self._last = 0.0
        """The last difference of the encoders."""
        self._doubt = ""
        self._off = 0.0
        """Greatest difference from the reference in the doubt."""
        self._stuck_at: float | None = None
        """Where the load was by the motor when the load encoder stopped following it; None: it moved alone."""

    @property
    def value_arcsec(self) -> float:
        """What it adds to the load target."""
        return self._value

    @property
    def doubt(self) -> str:
        """Why it does not believe the load encoder, in words; empty while it does."""
        return self._doubt

    def use_models(self, whole: TransmissionModel, predicting: TransmissionModel) -> None:
        """``whole`` knows the hysteresis of the gear, ``predicting`` is the part in `step`'s ``motor``.

        What is not predicted, and a share of what is, may keep the load from following the motor. If the
        hysteresis is not known, that is only bounded by the loop's own bound.
        """
        width = loop_width_arcsec(whole)
        known = (1.0 - _MODEL_ERROR) * loop_width_arcsec(predicting)
        self._slack = width - known if width else self._maximum

    def reset(self, value_arcsec: float = 0.0) -> None:
        """Begin again without any doubt, at this value, which the load target has in it already."""
        if not math.isfinite(value_arcsec):
            raise InputError(f"load loop: a value of {value_arcsec!r} arcsec; expected a finite number")
        self._value = min(max(value_arcsec, -self._maximum), self._maximum)
        self._doubt = ""
        self._standing = 0

    def step(self, target: float, load: float | None, motor: float, moving: bool) -> float:
        """One period: arcsec to add to the load target; it changes by at most the slew limit.

        ``target`` is the load target without what this adds, ``load`` the load encoder (None if there is no
        fresh reading), ``motor`` the load angle by the motor encoder and the model.
        """
        if load is None or not math.isfinite(load) or not math.isfinite(motor):
            self._standing = 0
            return self._fade()
        if moving:
            self._standing = 0
            return self._fade() if self._doubt else self._value
        self._standing += 1
        difference = load - motor
        if self._standing <= self._settled:
            self._settle(difference, motor)
        elif not self._believed(difference, motor):
            return self._fade() if self._doubt else self._value
        error = target - load
        if self._doubt or abs(error) > self._maximum:
            return self._fade()
        if self._standing > self._settled:
            step = min(max(self._gain_step * error, -self._slew_step), self._slew_step)
            self._value = min(max(self._value + step, -self._maximum), self._maximum)
        return self._value

    def _settle(self, difference: float, motor: float) -> None:
        """The axis has just come to rest: an average of what came last, without what was still settling."""
        share = max(self._share, 1.0 / self._standing)
        self._load += share * (difference - self._load)
        self._motor += share * (motor - self._motor)
        self._last = difference
        if self._standing < self._settled:
            return
        if self._doubt:
            self._standing = 0
            if not self._agree():
                return
            self._doubt = ""
        self._reference, self._rest_motor = self._load, self._motor

    def _agree(self) -> bool:
        """Whether the encoders agree again, after the doubt."""
        off = abs(self._load - self._reference)
        self._off = max(self._off, off)
        if self._stuck_at is not None and abs(self._motor - self._stuck_at) <= 4.0 * self._stuck_limit():
            return False  # an encoder that stands still agrees with a motor that has come back
        return off <= min(_AGREEMENT * self._off, self._maximum)

    def _limit(self) -> float:
        return self._count + _NOISE_LIMIT * _SIGMA_OF_MEAN_STEP * self._noise

    def _stuck_limit(self) -> float:
        return self._limit() + self._slack

    def _believed(self, difference: float, motor: float) -> bool:
        """Whether a reading at rest is believed; keeps averages and noise, and begins the doubt."""
        limit = self._limit()
        change = min(abs(difference - self._last), limit)
        self._noise += self._noise_share * (change - self._noise)
        self._last = difference
        off = abs(difference - self._load)
        explained = limit + 2.0 * abs(motor - self._motor)
        if off > explained:
            self._outliers += 1
            if self._outliers >= _OUTLIERS:
                self._begin_doubt(
                    f"the load encoder moved by {off:.1f} arcsec without the motor, of which "
                    f"{explained:.1f} are explained", self._load, None,
                )  # fmt: skip
            return False
        self._outliers = 0
        self._load += self._share * (difference - self._load)
        self._motor += self._share * (motor - self._motor)
        moved = self._motor - self._rest_motor
        missing = math.copysign(1.0, moved) * (self._reference - self._load)
        if min(missing, abs(moved)) > self._stuck_limit():
            self._begin_doubt(
                f"the load encoder did not follow the motor by {missing:.1f} arcsec, of which "
                f"{self._stuck_limit():.1f} are explained", self._reference, self._motor,
            )  # fmt: skip
            return False
        self._reference += self._drift_share * (self._load - self._reference)
        self._rest_motor += self._drift_share * moved
        return True

    def _begin_doubt(self, words: str, reference: float, stuck_at: float | None) -> None:
        self._doubt, self._reference, self._stuck_at = words, reference, stuck_at
        self._off = 0.0
        self._standing = self._outliers = 0

    def _fade(self) -> float:
        value, step = self._value, self._slew_step
        self._value = 0.0 if abs(value) <= step else value - math.copysign(step, value)
        return self._value
