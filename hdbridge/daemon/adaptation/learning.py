"""What an axis teaches: windows of observations, judged, and taken into the estimate.

A window is complete once the axis has moved enough (`Excitation`). It is refused as a whole where it cannot
be wear or temperature (`plausibility`); then nothing is learnt until the doubt is over, and what the last
windows before it taught is forgotten.
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
"""Times the turns of `Excitation` after which a window without reversals is used for what needs none."""
CLEAR_WINDOWS = 3
"""Plausible windows in a row that end a doubt that does not last."""
UNLEARNT = 3
"""Windows before a fault was noticed that are forgotten."""


@dataclass(frozen=True, slots=True)
class Reading:
    """How well an axis can be measured at all."""

    motor_count_arcsec: float
    """A count of the motor encoder, at the load."""
    load_count_arcsec: float
    channels: tuple[Channel, ...] = ()
    """Of the axis file, in the order of the samples' readings."""

    @property
    def sigma_arcsec(self) -> float:
        """Of an observation: the motor may stand anywhere within its count."""
        return math.hypot(self.motor_count_arcsec, self.load_count_arcsec) / math.sqrt(12.0)


class Learning:
    """The estimate of one axis, as changes of the committed coefficients."""

    def __init__(
        self,
        model: TransmissionModel,
        settings: AdaptationSettings,
        reading: Reading,
        tell: Callable[..., None],
    ) -> None:
        """``tell(event, **facts)`` hears of doubts and of their ends."""
        self.regressors = Regressors(model, settings.parameters)
        self.bounds_arcsec = bounds_arcsec(self.regressors, settings)
        """The most that each coefficient may change, (f,)."""
        self.doubt: Doubt | None = None
        """Why nothing is learnt just now."""
        self.windows = 0
        """That were learnt from."""
        self.begun_s: float | None = None
        """Since when it has been learning without a doubt; None before the first window."""
        self.learnt_s = 0.0
        """End of the last window that was learnt from."""
        self._settings = settings
        self._sigma_arcsec = reading.sigma_arcsec
        self._tell = tell
        self._nuisances = self.regressors.remembers.copy()
        self._nuisances[self.regressors.zero :] = True
        """The columns that a drift must not be taken for: the loop, the zero, the load encoder's disc."""
        self._measuring = Measuring(self.regressors, settings.slow_deg_s, reading.channels)
        self._plausibility = Plausibility(settings.zero_rate_arcsec_per_hour, reading.load_count_arcsec)
        self._estimator = estimator_of(self.regressors, settings)
        self._window: list[Observation] = []
        self._zero_arcsec: float | None = None
        """Where the zero was when it was taken."""
        self._cleared = 0
        self._earlier: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=UNLEARNT)
        """Estimates and covariances before the last windows."""
        self._seen_s: float | None = None
        """End of the last window, learnt from or not."""

    @property
    def known(self) -> bool:
        """Whether the state of the hysteresis no longer depends on what is not known."""
        return self._measuring.known

    @property
    def change_arcsec(self) -> FloatArray:
        """Estimated changes of the followed coefficients, within the bounds, (f,)."""
        return self._estimator.estimate[: self.regressors.followed].copy()

    @property
    def covariance(self) -> FloatArray:
        """Of all columns, (count, count)."""
        return self._estimator.covariance

    @property
    def estimate(self) -> FloatArray:
        """Of all columns, (count,)."""
        return self._estimator.estimate

    @property
    def zero_moved_arcsec(self) -> float | None:
        """How far the zero has moved since it was taken; None before that."""
        return None if self._zero_arcsec is None else self._zero() - self._zero_arcsec

    def take(self, times_s: FloatArray, axis: NDArray[Any], usable: NDArray[np.bool_]) -> None:
        """Samples as `Measuring.take` has them."""
        for each in self._measuring.take(times_s, axis, usable):
            self._window.append(each)
            if self._complete():
                window, self._window = self._window, []
                self._close(window)

    def lose_path(self) -> None:
        """Samples are missing or the axis had no power: the state of the gear is not known any more."""
        self._measuring.restart()
        self._window.clear()

    def lose_zero(self) -> None:
        """The drive's zero may be another one: homed, or switched off. Ends a doubt about the zero."""
        if self._zero_arcsec is None and self.doubt is None:
            return
        self._free_zero()
        if self.doubt is not None and self.doubt.lasting:
            self._believe("the zero was taken again")

    def begin_anew(self) -> None:
        """Forget all but the calibration."""
        self._estimator = estimator_of(self.regressors, self._settings)
        self._free_zero()
        self._believe("begun anew")

    def believe(self) -> None:
        """End a doubt, whatever the load encoder reads: all may have changed since."""
        estimator = self._estimator
        estimator.covariance = estimator.covariance + np.diag(estimator.scale**2)
        self._free_zero()
        self._believe("by command")

    def go_on(self, estimate: FloatArray, covariance: FloatArray, windows: int) -> None:
        """From what was known before; the zero has to be taken again."""
        self._estimator.estimate, self._estimator.covariance = estimate, covariance
        self.windows = windows
        self._free_zero()

    def question(self, doubt: Doubt) -> None:
        """Learn nothing until this is over, and forget what the last windows taught."""
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
        """Judge a window, and learn from it."""
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
        """What may have changed, within the rates, in the time in which nothing was seen, (n,)."""
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
        """Begin from the median of a window: what scatters about it is judged, not the zero itself."""
        at = self.regressors.zero
        estimate = self.estimate.copy()
        estimate[at] = 0.0
        estimate[at] = float(np.median(observed - rows @ estimate))
        self._estimator.estimate = estimate
        self._set_zero_sigma(self._sigma_arcsec)
        self._zero_arcsec = float(estimate[at])

    def _free_zero(self) -> None:
        """Nothing is known of the zero any more."""
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
