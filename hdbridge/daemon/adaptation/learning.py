"""Learning: windows of observations are judged and update the estimate.

A window is complete once the axis has moved enough (`Excitation`). It is rejected as a whole if neither wear
nor temperature can cause it (`plausibility`). Then learning stops until the doubt ends, and the updates by
the last windows before it are reverted.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdbridge.daemon.adaptation.measuring import Measuring, Observation, turns
from hdbridge.daemon.adaptation.plausibility import Doubt, Plausibility
from hdbridge.daemon.adaptation.prior import ZERO_ARCSEC, bounds_arcsec, estimator_of
from hdbridge.daemon.adaptation.regressors import Regressors
from hdbridge.daemon.adaptation.settings import AdaptationSettings
from hdbridge.effects import Channel, FloatArray
from hdbridge.model import TransmissionModel

PATIENCE = 4.0
"""Multiple of the turns of `Excitation` after which a window without reversals updates the memoryless
terms."""
CLEAR_WINDOWS = 3
"""Consecutive plausible windows that end a passing doubt."""
UNLEARNT = 3
"""Number of windows before a fault that are reverted."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Measuring resolution of an axis."""

    motor_count_arcsec: float
    """One count of the motor encoder, at the load."""
    load_count_arcsec: float
    channels: tuple[Channel, ...] = ()
    """Channels of the axis file, in the order of the samples' readings."""

    @property
    def sigma_arcsec(self) -> float:
        """Standard deviation of an observation due to quantisation by the encoders' counts."""
        return math.hypot(self.motor_count_arcsec, self.load_count_arcsec) / math.sqrt(12.0)


class Learning:
    """Estimate of one axis, as changes of the committed coefficients."""

    def __init__(
        self,
        model: TransmissionModel,
        settings: AdaptationSettings,
        reading: Reading,
        tell: Callable[..., None],
    ) -> None:
        """``tell(event, **facts)`` is called when doubts begin and end."""
        self.regressors = Regressors(model, settings.parameters)
        self.bounds_arcsec = bounds_arcsec(self.regressors, settings)
        """Largest change of each coefficient, (f,)."""
        self.doubt: Doubt | None = None
        """Present doubt, which stops learning."""
        self.windows = 0
        """Number of windows learned from."""
        self.begun_s: float | None = None
        """Time since which it has learned without a doubt; None before the first window."""
        self.learnt_s = 0.0
        """End of the last window learned from."""
        self._settings = settings
        self._sigma_arcsec = reading.sigma_arcsec
        self._tell = tell
        self._nuisances = self.regressors.remembers.copy()
        self._nuisances[self.regressors.zero :] = True
        """Columns that may not be mistaken for a drift: the loop, the zero, the load encoder's disc."""
        self._measuring = Measuring(self.regressors, settings.slow_deg_s, reading.channels)
        self._plausibility = Plausibility(settings.zero_rate_arcsec_per_hour, reading.load_count_arcsec)
        self._estimator = estimator_of(self.regressors, settings)
        self._window: list[Observation] = []
        self._zero_arcsec: float | None = None
        """Zero when it was taken."""
        self._cleared = 0
        self._earlier: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=UNLEARNT)
        """Estimates and covariances before each of the last windows."""
        self._seen_s: float | None = None
        """End of the last window, used or not."""

    @property
    def known(self) -> bool:
        """True if the hysteresis state no longer depends on the unknown past."""
        return self._measuring.known

    @property
    def change_arcsec(self) -> FloatArray:
        """Estimated changes of the adapted coefficients, within the bounds, (f,)."""
        return self._estimator.estimate[: self.regressors.followed].copy()

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all columns, (count, count)."""
        return self._estimator.covariance

    @property
    def estimate(self) -> FloatArray:
        """Estimate of all columns, (count,)."""
        return self._estimator.estimate

    @property
    def zero_moved_arcsec(self) -> float | None:
        """Change of the zero since it was taken; None before."""
        return None if self._zero_arcsec is None else self._zero() - self._zero_arcsec

    def take(self, times_s: FloatArray, axis: NDArray[Any], usable: NDArray[np.bool_]) -> None:
        """Takes samples as `Measuring.take` does."""
        for each in self._measuring.take(times_s, axis, usable):
            self._window.append(each)
            if self._complete():
                window, self._window = self._window, []
                self._close(window)

    def lose_path(self) -> None:
        """Handles missing samples or lost power: the hysteresis state is unknown."""
        self._measuring.restart()
        self._window.clear()

    def lose_zero(self) -> None:
        """Handles a possible change of the drive's zero (homed or off). Ends a doubt about the zero."""
        if self._zero_arcsec is None and self.doubt is None:
            return
        self._free_zero()
        if self.doubt is not None and self.doubt.lasting:
            self._believe("the zero was taken again")

    def begin_anew(self) -> None:
        """Forgets everything but the calibration."""
        self._estimator = estimator_of(self.regressors, self._settings)
        self._free_zero()
        self._believe("begun anew")

    def believe(self) -> None:
        """Ends a doubt, whatever the load encoder reads, and widens the covariance."""
        estimator = self._estimator
        estimator.covariance = estimator.covariance + np.diag(estimator.scale**2)
        self._free_zero()
        self._believe("by command")

    def go_on(self, estimate: FloatArray, covariance: FloatArray, windows: int) -> None:
        """Continues from an earlier estimate; the zero must be taken again."""
        self._estimator.estimate, self._estimator.covariance = estimate, covariance
        self.windows = windows
        self._free_zero()

    def question(self, doubt: Doubt) -> None:
        """Stops learning until this doubt ends, and reverts the last windows."""
        self._window.clear()
        self._cleared = 0
        before = self.doubt
        if before is None:
            if self._earlier:
                self._estimator.estimate, self._estimator.covariance = self._earlier[0]
                self._earlier.clear()
            self._tell("frozen", reason=doubt.reason, lasting=doubt.lasting)
        if before is None or (doubt.lasting and not before.lasting):
            self.doubt = doubt
        self.begun_s = None

    # ------------------------------------------------------------------ windows

    def _complete(self) -> bool:
        asked, window = self._settings.excitation, self._window
        turned = turns(window)
        if len(window) < asked.samples or turned < asked.turns:
            return False
        return _reversals(window) >= asked.reversals or turned >= PATIENCE * asked.turns

    def _close(self, window: list[Observation]) -> None:
        """Judges a window and learns from it if it is plausible."""
        rows = np.array([each.row for each in window])
        observed = np.array([each.error_arcsec for each in window])
        doubt = self._judged(window, rows, observed)
        self._seen_s = window[-1].time_s
        if doubt is not None:
            self.question(doubt)
            return
        if self.doubt is not None:
            self._cleared += not self.doubt.lasting
            if self._cleared < CLEAR_WINDOWS:
                return
            self._believe("the load encoder agrees with the model again")
        self._learn(window, rows, observed)
        own_zero = self._zero() + float(np.mean(observed - rows @ self.estimate))
        doubt = self._plausibility.follow(window, own_zero) or self._too_far()
        if doubt is not None:
            self.question(doubt)

    def _judged(self, window: list[Observation], rows: FloatArray, observed: FloatArray) -> Doubt | None:
        if self._zero_arcsec is None:
            self._take_zero(rows, observed)
        residual = observed - rows @ self.estimate
        sigma = np.sqrt(self._estimator.variance_of(rows) + self._sigma_arcsec**2)
        may = sigma + self._earned_arcsec(window, rows)
        return self._plausibility.judge(window, residual, may, rows[:, self._nuisances])

    def _learn(self, window: list[Observation], rows: FloatArray, observed: FloatArray) -> None:
        estimator, followed = self._estimator, self.regressors.followed
        self._earlier.append((estimator.estimate, estimator.covariance))
        one_way = _reversals(window) < self._settings.excitation.reversals
        estimator.update(
            rows,
            observed,
            self._sigma_arcsec,
            keep=0.5 ** (turns(window) / self._settings.half_life_turns),
            held=self.regressors.remembers if one_way else None,
        )
        estimator.estimate[:followed] = np.clip(
            estimator.estimate[:followed], -self.bounds_arcsec, self.bounds_arcsec
        )
        self.windows += 1
        self.learnt_s = window[-1].time_s
        if self.begun_s is None:
            self.begun_s = window[0].time_s

    def _earned_arcsec(self, window: list[Observation], rows: FloatArray) -> FloatArray:
        """Returns the change that the rates permit during the time without observations, (n,)."""
        if self._seen_s is None:
            return np.zeros(len(window))
        gap_h = max(window[0].time_s - self._seen_s, 0.0) / 3600.0
        followed = np.abs(rows[:, : self.regressors.followed]).sum(axis=1)
        settings = self._settings
        per_hour = settings.rate_arcsec_per_hour * followed + settings.zero_rate_arcsec_per_hour
        return np.asarray(per_hour * gap_h)

    # ------------------------------------------------------------------ the zero, and doubts

    def _zero(self) -> float:
        return float(self.estimate[self.regressors.zero])

    def _take_zero(self, rows: FloatArray, observed: FloatArray) -> None:
        """Takes the zero as the median of a window, so that only the scatter about it is judged."""
        at = self.regressors.zero
        estimate = self.estimate.copy()
        estimate[at] = 0.0
        estimate[at] = float(np.median(observed - rows @ estimate))
        self._estimator.estimate = estimate
        self._set_zero_sigma(self._sigma_arcsec)
        self._zero_arcsec = float(estimate[at])

    def _free_zero(self) -> None:
        """Resets the zero to unknown."""
        self._set_zero_sigma(ZERO_ARCSEC)
        self._zero_arcsec = None
        self._window.clear()
        self._earlier.clear()
        self._plausibility.restart()

    def _set_zero_sigma(self, sigma_arcsec: float) -> None:
        at = self.regressors.zero
        covariance = self.covariance.copy()
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = sigma_arcsec**2
        self._estimator.covariance = covariance

    def _too_far(self) -> Doubt | None:
        moved, most = self.zero_moved_arcsec, self._settings.zero_bound_arcsec
        if moved is None or abs(moved) <= most:
            return None
        return Doubt(
            f"the zero has moved by {moved:+.1f} arcsec since it was taken (at most {most:g}): take it again",
            lasting=True,
        )

    def _believe(self, why: str) -> None:
        if self.doubt is not None:
            self._tell("thawed", reason=why)
        self.doubt = None
        self._cleared = 0
        self.begun_s = self._seen_s = None


def _reversals(window: list[Observation]) -> int:
    return sum(each.reversals for each in window)
