"""Adaptation of one axis: observations update an estimate, and the model in use follows it within bounds.

A window of observations is complete once the axis has moved enough (`Excitation`). It is rejected as a whole
if neither wear nor temperature can explain it, because both are slow and act equally at all angles. Learning
is then frozen until the cause ends, and the updates by the last windows before the fault are reverted.
`health` and `zero` judge the load encoder; the tests here are those that need the estimate. There is no I/O
and no clock, because observations contain the time.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field

from hdbridge.analysis.intervals import difference
from hdbridge.axis.effects import FloatArray
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import Response
from hdbridge.control.compensation import Inverse
from hdbridge.daemon.following.estimator import (
    ZERO_ARCSEC,
    Change,
    bounds_arcsec,
    calibrated_estimator,
    changes_between,
    half_widths,
)
from hdbridge.daemon.following.measuring import DriftModel, Observation, reversals, turns
from hdbridge.daemon.following.zero import Rate
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.enums import AdaptationMode
from hdbridge.errors import InputError
from hdbridge.strictness import Strict

ONE_WAY_TURNS = 4.0
"""Multiple of `Excitation.turns` at which a window with too few reversals is complete. It updates only the
terms without hysteresis."""
CLEAR_WINDOWS = 3
"""Number of consecutive plausible windows that end a freeze."""
REVERTED_WINDOWS = 3
"""Number of windows before a fault whose updates are reverted."""
RATE_INTERVALS = 2.0
"""Maximum number of update intervals that count for the rate limit after a pause."""
MIN_RATE_LIMITED_SHARE = 0.99
"""Fraction of the permitted change per interval from which a change is applied, even below
`AdaptationSettings.smallest_arcsec`."""
GATE_SIGMAS = 6.0
"""Maximum deviation of an observation from the model, in standard deviations."""

Entry = Mapping[str, Any]
"""Line of the history: ``event``, ``axis_time_s`` and further data, all serialisable as JSON."""


@dataclass(frozen=True, slots=True)
class Freeze:
    """Reason for suspended learning."""

    reason: str
    """Reason in words, with the measured values."""
    lasting: bool = False
    """True if the freeze does not end automatically, but only with a new zero or by command."""


class Learned(Strict):
    """State that survives a restart of the service."""

    estimate: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    applied: tuple[float, ...]
    windows: int = Field(ge=0)
    response: Response | None = None
    """Refined response in motion; None for that of the committed model."""


class Adaptation:
    """Adaptation of one axis. `take` must be called with its observations in order, from one thread."""

    def __init__(
        self,
        whole: DriftModel,
        settings: AdaptationSettings,
        sigma_arcsec: float,
        learned: Learned | None,
    ) -> None:
        """``whole`` is the committed model to which the observations refer; ``sigma_arcsec`` their noise.

        ``learned`` is the state of an earlier adaptation of this model. Raises InputError if ``settings``
        name a parameter that the model lacks.
        """
        self.settings = settings
        self.mode: AdaptationMode = settings.mode
        self.committed = self.model = whole.model
        """Committed model, and the model that should be in use."""
        self.freeze_reason: Freeze | None = None
        self.windows = 0
        """Number of learned windows."""
        self.entries: list[Entry] = []
        """Lines of the history that have not been written yet."""
        self._drift = drift = DriftModel(whole.model, settings.parameters)
        self._columns = drift.columns_in(whole)
        self._estimator = calibrated_estimator(drift, settings)
        self._bounds = bounds_arcsec(drift, settings)
        self._sigma_arcsec = sigma_arcsec
        self._now_s = 0.0
        self._window: list[Observation] = []
        self._zero_arcsec: float | None = None
        """Zero as it was learned; None until then."""
        self._plausible_windows = 0
        self._previous_estimates: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=REVERTED_WINDOWS)
        """Estimates and covariances before each of the last windows."""
        self._learning_since_s: float | None = None
        """Start of the first window learned since the start or the last freeze; None before."""
        self._window_s: float | None = None
        """End of the last window, used or not."""
        self._proposed = self._used = np.zeros(drift.zero)
        """Changes of the coefficients in the last proposed model, applied or not, and in the model in use."""
        self._changed_s = -math.inf
        """Time at which a change was last proposed or considered."""
        self._refined_s = -math.inf
        """Time at which the response was last refined."""
        if learned is not None:
            self._restore(learned)

    def take(
        self, observations: Sequence[Observation], now_s: float, fault: str, rates: Sequence[Rate]
    ) -> None:
        """Takes observations in order; changes the model, or reports the change, when due.

        ``fault`` is a reason for not learning now, such as a fault of the load encoder, or empty. ``rates``
        are those of the zero.
        """
        if self.mode == "off":
            return
        self._now_s = now_s
        if fault:
            self.freeze(Freeze(fault))
        for each in observations:
            self._window.append(each._replace(row=each.row[self._columns]))
            if self._complete():
                window, self._window = self._window, []
                self._close(window, rates)
        self._propose()

    def set_mode(self, mode: AdaptationMode) -> None:
        """Changes the mode. ``on`` ends a freeze, whatever the load encoder reads."""
        if mode == "on" and self.freeze_reason is not None:
            estimator = self._estimator
            estimator.covariance = estimator.covariance + np.diag(estimator.scale**2)
            self._reset_zero()
            self._unfreeze("by command")
        if mode != self.mode:
            # Changes estimated in the mode "observe" must not be applied suddenly, so start from the model in
            # use.
            self._refined_s = self._now_s
            self._proposed, self._changed_s = self._used, self._now_s
            if self.mode == "off":
                self.forget_window()
            self._log_event("mode", mode=mode)
            self.mode = mode

    def revert(self) -> None:
        """Restores the committed model and only observes from now on, until `set_mode`."""
        changes = changes_between(self.committed, self.model, self.committed)
        self._estimator = calibrated_estimator(self._drift, self.settings)
        self._reset_zero()
        self._unfreeze("restarted")
        self._proposed = self._used = np.zeros(self._drift.zero)
        self.model = self.committed
        self.mode = AdaptationMode.OBSERVE
        self._log_event("back", changes=_changes_json(changes))

    @property
    def may_refine(self) -> bool:
        """False if the adaptation is off or frozen, or if the response was refined too recently."""
        recent = self._now_s - self._refined_s < self.settings.interval_s
        return not (self.mode == "off" or self.freeze_reason is not None or recent)

    def refine(self, response: Response) -> None:
        """Takes a refined response in motion, without a rate limit, because retuning a servo is sudden."""
        apply = self.mode == "on"
        self._refined_s = self._now_s if apply else math.inf  # only observed: reported once
        if apply:
            self.model = replace(self.model, response=response)
        self._log_event("refined" if apply else "would refine", following_lag_ms=response.following_lag_ms)

    def withdraw(self) -> None:
        """Restores the committed response after a refinement that increased the ripple, and freezes."""
        self.model = replace(self.model, response=self.committed.response)
        self.freeze(
            Freeze("the refined response in motion increased the ripple and was withdrawn", lasting=True)
        )

    def forget_window(self) -> None:
        """Discards the incomplete window, for example after lost samples."""
        self._window.clear()

    def invalidate_zero(self) -> None:
        """Handles a possible change of the drive's zero (homed or off), which ends a lasting freeze."""
        if self._zero_arcsec is not None or self.freeze_reason is not None:
            self._reset_zero()
            if self.freeze_reason is not None and self.freeze_reason.lasting:
                self._unfreeze("the zero was learned again")

    def freeze(self, found: Freeze) -> None:
        """Stops learning until the cause ends, and reverts the last windows."""
        self._window.clear()
        self._plausible_windows = 0
        before = self.freeze_reason
        if before is None:
            if self._previous_estimates:
                self._estimator.estimate, self._estimator.covariance = self._previous_estimates[0]
                self._previous_estimates.clear()
            self._log_event("frozen", reason=found.reason, lasting=found.lasting)
        if before is None or (found.lasting and not before.lasting):
            self.freeze_reason = found
        self._learning_since_s = None

    @property
    def estimate_arcsec(self) -> FloatArray:
        """Estimated changes of the adapted coefficients, within the bounds, (f,)."""
        return self._estimator.estimate[: self._drift.zero].copy()

    @property
    def zero_moved_arcsec(self) -> float | None:
        """Change of the zero since it was learned; None before. It is reported but never applied."""
        return None if self._zero_arcsec is None else self._zero - self._zero_arcsec

    def waiting_reason(self, *, path_known: bool) -> str | None:
        """Returns the reason for a freeze or a wait; None while the adaptation learns or is off."""
        if self.mode == "off":
            return None
        if self.freeze_reason is not None:
            return self.freeze_reason.reason
        if not path_known:
            return "the axis has not yet moved beyond the hysteresis width"
        return None if self.windows else "not enough motion yet"

    def estimated_changes(self) -> dict[str, float]:
        """Returns the estimated change of each parameter that differs, before rate limits, by name."""
        change = self.estimate_arcsec
        estimated = self._drift.changed(change) if np.any(change) else self.committed
        changes = changes_between(self.committed, self.committed, estimated)
        return {each.parameter: difference(each.parameter, each.before, each.after) for each in changes}

    def learned(self) -> Learned:
        """Returns the state to preserve over a restart."""
        estimator = self._estimator
        return Learned(
            estimate=estimator.estimate.tolist(),
            covariance=estimator.covariance.tolist(),
            applied=self._used.tolist(),
            windows=self.windows,
            response=None if self.model.response is self.committed.response else self.model.response,
        )

    def _restore(self, learned: Learned) -> None:
        """Continues from an earlier estimate; the zero must be learned again."""
        estimator = self._estimator
        estimate, covariance = np.array(learned.estimate), np.array(learned.covariance)
        applied = np.array(learned.applied)
        if estimate.shape != estimator.estimate.shape or covariance.shape != estimator.covariance.shape:
            return
        if applied.shape != self._used.shape:
            return
        estimator.estimate, estimator.covariance = estimate, covariance
        self.windows = learned.windows
        self._reset_zero()
        if self.mode == "on":
            self._proposed = self._used = np.clip(applied, -self._bounds, self._bounds)
            self.model = replace(self.model, response=learned.response or self.model.response)
            self.model = self._changed(self._used)

    # ------------------------------------------------------------------ windows

    def _complete(self) -> bool:
        required, window = self.settings.excitation, self._window
        turned = turns(window)
        if len(window) < required.samples or turned < required.turns:
            return False
        return reversals(window) >= required.reversals or turned >= ONE_WAY_TURNS * required.turns

    def _close(self, window: list[Observation], rates: Sequence[Rate]) -> None:
        """Tests a window and learns from it if it is plausible; ``rates`` are those of the zero."""
        rows = np.array([each.row for each in window])
        observed = np.array([each.error_arcsec for each in window])
        if self._zero_arcsec is None:
            self._learn_zero(rows, observed)
        residual = observed - rows @ self._estimator.estimate
        variance = np.einsum("ij,jk,ik->i", rows, self._estimator.covariance, rows)
        sigma = np.sqrt(variance + self._sigma_arcsec**2) + self._rate_allowance_arcsec(window, rows)
        found = _outlier_freeze(residual, GATE_SIGMAS * sigma) or self._zero_rate_freeze(rates)
        self._window_s = window[-1].time_s
        if found is not None:
            self.freeze(found)
            return
        if self.freeze_reason is not None:
            self._plausible_windows += not self.freeze_reason.lasting
            if self._plausible_windows < CLEAR_WINDOWS:
                return
            self._unfreeze("the load encoder agrees with the model again")
        self._learn(window, rows, observed)
        found = self._zero_bound_freeze()
        if found is not None:
            self.freeze(found)

    def _learn(self, window: list[Observation], rows: FloatArray, observed: FloatArray) -> None:
        estimator, zero = self._estimator, self._drift.zero
        self._previous_estimates.append((estimator.estimate, estimator.covariance))
        one_way = reversals(window) < self.settings.excitation.reversals
        estimator.update(
            rows,
            observed,
            self._sigma_arcsec,
            retention=0.5 ** (turns(window) / self.settings.half_life_turns),
            held=self._drift.has_memory if one_way else None,
        )
        estimator.estimate[:zero] = np.clip(estimator.estimate[:zero], -self._bounds, self._bounds)
        self.windows += 1
        if self._learning_since_s is None:
            self._learning_since_s = window[0].time_s

    def _rate_allowance_arcsec(self, window: list[Observation], rows: FloatArray) -> FloatArray:
        """Returns the change that the rate limits permit since the last window, (n,)."""
        if self._window_s is None:
            return np.zeros(len(window))
        gap_h = max(window[0].time_s - self._window_s, 0.0) / 3600.0
        adapted = np.abs(rows[:, : self._drift.zero]).sum(axis=1)
        settings = self.settings
        per_hour = settings.rate_arcsec_per_hour * adapted + settings.zero_rate_arcsec_per_hour
        return np.asarray(per_hour * gap_h)

    def _unfreeze(self, reason: str) -> None:
        if self.freeze_reason is not None:
            self._log_event("thawed", reason=reason)
        self.freeze_reason = None
        self._plausible_windows = 0
        self._learning_since_s = self._window_s = None

    # ------------------------------------------------------------------ the zero

    @property
    def _zero(self) -> float:
        return float(self._estimator.estimate[self._drift.zero])

    def _learn_zero(self, rows: FloatArray, observed: FloatArray) -> None:
        """Learns the zero as the median of a window, so that only the scatter about it is tested."""
        at = self._drift.zero
        estimate = self._estimator.estimate.copy()
        estimate[at] = 0.0
        estimate[at] = self._zero_arcsec = float(np.median(observed - rows @ estimate))
        self._estimator.estimate = estimate
        self._set_zero_sigma(self._sigma_arcsec)

    def _reset_zero(self) -> None:
        """Resets the zero to unknown."""
        self._set_zero_sigma(ZERO_ARCSEC)
        self._zero_arcsec = None
        self._window.clear()
        self._previous_estimates.clear()

    def _set_zero_sigma(self, sigma_arcsec: float) -> None:
        at = self._drift.zero
        covariance = self._estimator.covariance.copy()
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = sigma_arcsec**2
        self._estimator.covariance = covariance

    def _zero_rate_freeze(self, rates: Sequence[Rate]) -> Freeze | None:
        """Returns a lasting freeze if the zero moves faster than the settings permit."""
        most = self.settings.zero_rate_arcsec_per_hour
        for each in rates:
            if each.exceeds(most / 60.0):
                return Freeze(
                    f"the zero moves by {60.0 * each.arcsec_min:+.0f} arcsec per hour, faster than wear and "
                    f"temperature may ({most:.0f}): the load encoder slips or drifts",
                    lasting=True,
                )
        return None

    def _zero_bound_freeze(self) -> Freeze | None:
        moved, most = self.zero_moved_arcsec, self.settings.zero_bound_arcsec
        if moved is None or abs(moved) <= most:
            return None
        return Freeze(
            f"the zero has moved by {moved:+.1f} arcsec since it was learned (at most {most:g}): "
            "learn it again",
            lasting=True,
        )

    # ------------------------------------------------------------------ proposals

    def _propose(self) -> None:
        """Changes the model in use towards the estimate, or reports that it would change."""
        settings = self.settings
        if self._learning_since_s is None or self._window_s is None:
            return
        since_s = max(self._learning_since_s, self._changed_s)
        passed_s = min(self._window_s - since_s, RATE_INTERVALS * settings.interval_s)
        if passed_s < settings.interval_s:
            return
        self._changed_s = self._window_s
        most = settings.rate_arcsec_per_hour * passed_s / 3600.0
        step = np.clip(self.estimate_arcsec - self._proposed, -most, most)
        threshold = min(settings.smallest_arcsec, MIN_RATE_LIMITED_SHARE * most)
        if not len(step) or float(np.max(np.abs(step))) < threshold:
            return
        change = self._proposed + step
        model = self._changed(change)
        try:
            Inverse(model)
        except InputError as error:
            self._log_event("refused", reason=str(error))
            return
        changes = changes_between(self.committed, self._changed(self._proposed), model)
        self._proposed = change
        apply = self.mode == "on"
        if apply:
            self._used, self.model = change, model
        self._log_event("changed" if apply else "would change", changes=_changes_json(changes))

    def _changed(self, change: FloatArray) -> TransmissionModel:
        """Returns the committed model with changed coefficients and their current intervals."""
        response = self.model.response
        if not np.any(change):
            return replace(self.committed, response=response)
        model = self._drift.changed(change)
        uncertainty = dict(model.uncertainty)
        for each in self._drift.terms:
            effect = model.effects[each.number]
            own = self._estimator.covariance[each.columns, each.columns]
            uncertainty[effect.name] = half_widths(effect, own, uncertainty.get(effect.name, {}))
        provenance = {**model.provenance, "reason": "the committed model, adapted by the load encoder"}
        return replace(model, uncertainty=uncertainty, provenance=provenance, response=response)

    def _log_event(self, event: str, **facts: Any) -> None:
        self.entries.append({"event": event, "axis_time_s": self._now_s, **facts})


def _changes_json(changes: Sequence[Change]) -> dict[str, dict[str, float]]:
    return {
        each.parameter: {"committed": each.committed, "before": each.before, "after": each.after}
        for each in changes
    }


def _outlier_freeze(residual_arcsec: FloatArray, gate_arcsec: FloatArray) -> Freeze | None:
    """Returns a freeze if residuals exceed the gate for wear and temperature, both (n,).

    It is lasting if all residuals are shifted equally.
    """
    if np.all(np.abs(residual_arcsec) <= gate_arcsec):
        return None
    shift = float(np.median(residual_arcsec))
    common = np.all(np.abs(residual_arcsec - shift) <= gate_arcsec)
    if common and abs(shift) > float(np.median(gate_arcsec)):
        return Freeze(
            f"the load encoder has shifted by {shift:+.1f} arcsec at once, equally in both directions: "
            "a scale or coupling that slipped, or a lost zero",
            lasting=True,
        )
    worst = float(np.max(np.abs(residual_arcsec)))
    return Freeze(
        f"the load encoder deviates by up to {worst:.1f} arcsec from the model, more than the rate limits "
        "allow, and not equally at all places"
    )
