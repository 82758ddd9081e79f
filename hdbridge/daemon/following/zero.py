"""Zero of the load encoder: estimates its motion for encoder health, watch and adaptation.

The zero is the difference of the two encoders' zeros. A gear cannot make it step, and wear and temperature
move it slowly and not far. A faster or larger change comes from the load encoder or its coupling. One fit to
the recent observations serves all three users:

    error = columns @ change + zero + rate * time + load encoder disc + term proportional to speed + noise

The columns and the range of their changes are those of the adaptation, so wear of the gear is not mistaken
for motion of the zero, however few places the axis visits. The error refers to the committed model, so a
change of the model in use has no effect here. The noise is the larger of quantisation by the counts and rms
residual; standard errors allow for the correlation of residuals.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from hdbridge.axis.effects import FloatArray
from hdbridge.daemon.following.estimator import calibrated_estimator, ranged_fit, variance_factor
from hdbridge.daemon.following.health import EncoderFault
from hdbridge.daemon.following.measuring import DriftModel, Observation
from hdbridge.daemon.machinefile import AdaptationSettings

SPANS_S: Final = (15.0, 60.0, 180.0)
"""Durations of the spans up to now that are tested for a drift; the longest is also tested for a step."""
EVERY_S: Final = 2.0
"""Minimum interval between fits."""
MIN_OBSERVATIONS: Final = 16
"""Minimum number of observations in a span."""
SIGMAS: Final = 8.0
"""Number of standard errors by which a rate must exceed its limit, and a step must exceed zero."""
CONSECUTIVE_FITS: Final = 3
"""Number of successive fits that must agree on a drift; a knock does not last that long."""
RATE_ARCSEC_MIN: Final = 3.0
"""Maximum rate of a gear's zero. Warming up moves it by 5 to 60 arcsec in 10 to 60 minutes, typically by 1
per minute (`effects.zero_drift`)."""
MAX_ARCSEC: Final = 60.0
"""Maximum total change of a gear's zero."""
LEARNED_MIN: Final = 0.5
"""Minimum duration of the observations from which the zero is learned, minutes."""
FREE_COLUMNS: Final = 4
"""Number of columns without a known range: time, step, zero, and one for the speed."""
COUNTS_SHARE: Final = 0.3
"""Minimum noise of an observation (a mean), as a fraction of the quantisation noise of a single sample."""
SPEED_ARCSEC: Final = 5.0
"""Expected size of the error proportional to speed, at the highest speed of the span."""
STEP_ARCSEC: Final = 6.0
"""Smallest change of the zero that counts as a step."""
STEP_OBSERVATIONS: Final = 20
"""Minimum number of observations on either side of a step."""
MAX_STEP_TO_DRIFT_RATIO: Final = 0.6
"""Maximum ratio of the residual mean square with a step to that with a drift that begins there."""


class Rate(NamedTuple):
    """Rate of change of the zero over a span that ends at the newest observation."""

    arcsec_min: float
    error: float
    """Standard error of the rate, arcsec per minute."""
    minutes: float
    """Length of the span, minutes."""

    def exceeds(self, limit_arcsec_min: float) -> bool:
        """Returns True if the rate exceeds ``limit_arcsec_min`` by more than `SIGMAS` standard errors."""
        return abs(self.arcsec_min) - SIGMAS * self.error > limit_arcsec_min


class Displacement(NamedTuple):
    """Change of the zero since it was learned, evaluated at the middle of the observations."""

    arcsec: float
    error: float
    """Standard error, arcsec."""


class Zero:
    """Estimates the zero of one axis and its changes since the drive was verified."""

    def __init__(self, drift: DriftModel, sigma_arcsec: float) -> None:
        """``sigma_arcsec`` is the standard deviation of a single sample due to the encoders' counts."""
        self._has_model = bool(drift.model.effects)
        """False without a prediction, because the gear's own error may look like a moving zero."""
        self._sigma_arcsec = COUNTS_SHARE * sigma_arcsec
        self._at = 2 + drift.zero
        scale = calibrated_estimator(drift, AdaptationSettings()).scale
        self._information = np.concatenate([[0.0, SPEED_ARCSEC**-2], scale**-2])
        self._judged_s = 0.0
        self.restart()

    def restart(self) -> None:
        """Learns the zero again, because the drive was verified or homed."""
        self.forget()
        self.displacement: Displacement | None = None
        """Displacement at the last judgement; None until the zero is learned."""
        self._learned: tuple[Displacement, FloatArray] | None = None
        """Zero, and coefficients of the disc, when they were learned."""

    def forget(self) -> None:
        """Forgets the observations, but not the zero that was learned."""
        self.rates: list[Rate] = []
        """Rates at the last judgement, one per span with enough observations."""
        self._recent: deque[Observation] = deque()
        self._suspicious_fits = 0

    def take(self, observations: Sequence[Observation]) -> tuple[EncoderFault, str] | None:
        """Takes observations in order; returns a fault and its evidence once it is certain."""
        if not (observations and self._has_model):
            return None
        recent = self._recent
        recent.extend(observations)
        now_s = recent[-1].time_s
        while not 0.0 <= now_s - recent[0].time_s < SPANS_S[-1]:
            recent.popleft()
        if 0.0 <= now_s - self._judged_s < EVERY_S:
            return None
        self._judged_s = now_s
        time_s = np.array([each.time_s for each in recent])
        spans = [time_s > now_s - span_s for span_s in SPANS_S]
        rows = self._rows(time_s)
        error_arcsec = np.array([each.error_arcsec for each in recent])
        self.rates = [
            self._rate(rows[span], error_arcsec[span])
            for span in spans
            if np.count_nonzero(span) >= MIN_OBSERVATIONS
        ]
        if not self.rates:
            return None
        self._update_displacement(rows, error_arcsec)
        return self._step_fault(time_s, rows, error_arcsec) or self._drift_fault()

    def _rows(self, time_s: FloatArray) -> FloatArray:
        """Returns minutes from the middle, fraction of the highest speed, and the columns of `DriftModel`."""
        speed = np.array([each.speed_deg_s for each in self._recent])
        columns = np.array([each.row for each in self._recent])
        share = speed / max(float(np.max(np.abs(speed))), 1e-9)
        return np.column_stack([(time_s - 0.5 * (time_s[0] + time_s[-1])) / 60.0, share, columns])

    def _fit(
        self, rows: FloatArray, error_arcsec: FloatArray, information: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Returns the coefficients, their standard errors and the residual mean square."""
        sigma = self._sigma_arcsec
        for _ in range(2):  # the second pass uses the residual noise of the first
            change, covariance = ranged_fit(rows, error_arcsec, sigma, information)
            residual = error_arcsec - rows @ change
            sigma = max(sigma, float(np.sqrt(residual @ residual / (len(residual) - FREE_COLUMNS))))
        errors = np.sqrt(np.diag(covariance) * variance_factor(residual))
        return change, errors, float(residual @ residual) / len(residual)

    def _rate(self, rows: FloatArray, error_arcsec: FloatArray) -> Rate:
        change, errors, _ = self._fit(rows, error_arcsec, self._information)
        return Rate(float(change[0]), float(errors[0]), float(rows[-1, 0] - rows[0, 0]))

    def _update_displacement(self, rows: FloatArray, error_arcsec: FloatArray) -> None:
        """Learns the zero, or determines its displacement since then.

        The disc is fixed at its learned value, because over part of a turn it is hardly separable from the
        zero.
        """
        own, disc = rows[:, : self._at + 1], rows[:, self._at + 1 :]
        if self._learned is None:
            if rows[-1, 0] - rows[0, 0] < LEARNED_MIN:
                return
            change, *_ = self._fit(rows, error_arcsec, self._information)
            coefficients = change[self._at + 1 :]
        else:
            coefficients = self._learned[1]
        change, errors, _ = self._fit(
            own, error_arcsec - disc @ coefficients, self._information[: self._at + 1]
        )
        zero = Displacement(float(change[self._at]), float(errors[self._at]))
        if self._learned is None:
            self._learned = zero, coefficients
        before, _ = self._learned
        self.displacement = Displacement(
            zero.arcsec - before.arcsec, float(np.hypot(zero.error, before.error))
        )

    def _step_fault(
        self, time_s: FloatArray, rows: FloatArray, error_arcsec: FloatArray
    ) -> tuple[EncoderFault, str] | None:
        """Returns a fault if a step of the zero fits far better than a drift that begins at the same time."""
        count = len(rows)
        before = np.arange(STEP_OBSERVATIONS, count - STEP_OBSERVATIONS + 1)
        if not len(before):
            return None
        change, *_ = self._fit(rows, error_arcsec, self._information)
        change[0] = 0.0
        total = np.cumsum(error_arcsec - rows @ change)
        statistic = np.abs(total[before - 1] - total[-1] * before / count)
        row = int(before[np.argmax(statistic / np.sqrt(before * (count - before)))])
        information = np.append(0.0, self._information)
        stepped = np.column_stack([np.arange(count) >= row, rows])
        change, errors, step_residual = self._fit(stepped, error_arcsec, information)
        step, error = float(change[0]), float(errors[0])
        if abs(step) < max(STEP_ARCSEC, SIGMAS * error):
            return None
        drifted = np.column_stack([np.maximum(rows[:, 0] - rows[row, 0], 0.0), rows])
        *_, drift_residual = self._fit(drifted, error_arcsec, information)
        if step_residual > MAX_STEP_TO_DRIFT_RATIO * drift_residual:
            return None
        return EncoderFault.JUMPED, (
            f"its zero stepped by {step:+.1f} arcsec (standard error {error:.2f}) near {time_s[row]:.1f} s; "
            "the zero of a gear cannot step"
        )

    def _drift_fault(self) -> tuple[EncoderFault, str] | None:
        """Returns a fault once a drift too fast or too large for a gear has lasted."""
        away = 0.0 if self.displacement is None else self.displacement.arcsec
        drifts = any(each.exceeds(RATE_ARCSEC_MIN) for each in self.rates)
        self._suspicious_fits = self._suspicious_fits + 1 if drifts or abs(away) > MAX_ARCSEC else 0
        if self._suspicious_fits < CONSECUTIVE_FITS:
            return None
        rate = max(self.rates, key=lambda each: abs(each.arcsec_min) - SIGMAS * each.error)
        return EncoderFault.DRIFTING, (
            f"its zero moves by {rate.arcsec_min:+.2f} arcsec a minute (standard error {rate.error:.2f}, in "
            f"the last {rate.minutes:.1f} min), {away:+.1f} arcsec since it was verified; a gear's moves by "
            f"at most {RATE_ARCSEC_MIN:g} a minute and {MAX_ARCSEC:g} in all"
        )
