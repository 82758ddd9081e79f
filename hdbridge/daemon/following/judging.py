"""Judging: tests recent observations against the model's confidence intervals, and raises verdicts.

If the model is valid, the observed error minus the predicted one is noise plus the errors of its parameters:

    observed - predicted = columns @ change + zero + trend of the zero + load encoder disc + noise

``change`` has the covariance of the model file's intervals, or of a typical calibration if the file has none
(as in `analysis.calibrated`). The noise is the model's residual on held-out data, or the motor encoder's
resolution if that is larger. Three tests use generalised least squares:

* Has a part of the model changed by more than its interval and the errors of this fit allow (chi square)?
* Has the zero moved since it was learned (by `zero`)?
* Is the residual, with every part free to change, larger than the noise allows (chi square)?

The significance level follows from `FALSE_ALARMS_PER_DAY`, divided by the number of tests per
day. Observations at one place in one direction count as one: averaging more of them does not reduce the part
of the error that repeats there.

A verdict is raised when its evidence has persisted, and withdrawn when the evidence has been absent for
longer, so one bad second or move raises nothing. There are no verdicts about the gear during a fault of the
load encoder.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from hdbridge.analysis.scales import Scales
from hdbridge.axis.effects import FloatArray
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.following.estimator import (
    bounds_arcsec,
    calibrated_estimator,
    changes_between,
    ranged_fit,
)
from hdbridge.daemon.following.health import EncoderStatus
from hdbridge.daemon.following.measuring import DriftModel, Observation, Term
from hdbridge.daemon.following.zero import Displacement
from hdbridge.daemon.machinefile import AdaptationSettings

DAY_S: Final = 86_400.0
FALSE_ALARMS_PER_DAY: Final = 1.0 / 365.0
"""False alarms per axis with a valid model: one per year."""
EVERY_S: Final = 10.0
"""Interval between tests."""
WINDOW_S: Final = 900.0
"""Maximum age of an observation."""
RAISE_S: Final = 60.0
"""Time for which evidence must persist before a verdict is raised."""
WITHDRAW_S: Final = 300.0
"""Time without evidence after which a verdict is withdrawn."""
NOISE_RATIO: Final = 1.5
"""Assumed ratio of the noise in operation to that of a calibration."""
ORDER_ARCSEC: Final = 0.8
"""Smallest relevant change of the orders, at the load."""
LOOP_ARCSEC: Final = 1.5
LOOP_SHARE: Final = 3.0 * Scales().calibrated
"""Smallest relevant change of a loop: the larger of `LOOP_ARCSEC` and this fraction of the loop."""
ZERO_ARCSEC: Final = 5.0
"""Smallest relevant change of the zero: the smallest effect of warming up (`effects.zero_drift`)."""
MIN_RESIDUAL_ARCSEC: Final = 0.5
"""Smallest relevant unexplained residual, rms, in addition to the noise."""
MAX_OBSERVATIONS: Final = 600
"""Maximum number of observations that are evaluated together."""
MIN_EXTRA_PLACES: Final = 20
"""Number of places required in addition to one per column."""
CLEAR_SHARE: Final = 0.8
"""Fraction of a limit below which a value counts as clearly within the limit."""
TREND_ARCSEC: Final = 60.0
"""Scale of the zero's trend, from the middle of the observations to one end."""
REPORTED_SHARE: Final = 0.02
"""Relative change of a parameter above which it is reported."""
CELL: Final = 0.1
"""Rounding of the columns; rows that are equal after rounding count as one place."""


class Verdict(Enum):
    """Verdict on an axis."""

    HOLDS = "the model holds"
    RECALIBRATE = "recalibrate"
    """Parts of the model have changed in a way that wear, temperature or ageing causes and a calibration
    corrects."""
    SOMETHING_CHANGED = "something changed"
    """No such change explains the measurements, so a diagnosis is required."""
    ENCODER = "the load encoder is not believed"
    RETUNED = "measure the response in motion again"
    """The servo's response differs from the measured response, so the correction in motion is wrong."""


class RaisedVerdict(NamedTuple):
    """A new verdict."""

    verdict: Verdict
    evidence: str
    """Evidence in words, with the measured values."""

    @property
    def text(self) -> str:
        """Verdict and evidence in words."""
        return f"{self.verdict.value}: {self.evidence}" if self.evidence else self.verdict.value


class PartChange(NamedTuple):
    """Changed part of the model."""

    text: str
    """Description of the change."""
    wear: bool
    """True if wear, temperature or ageing can cause such a change."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Result of the tests over the recent operation of an axis."""

    places: int
    """Number of distinct places observed."""
    rms_arcsec: float
    """Rms difference of measured and predicted error about its zero."""
    allowed_arcsec: float
    """Upper limit of that difference, given the noise and the model's intervals."""
    residual_arcsec: float
    """Rms residual with every part of the model free to change."""
    residual_limit_arcsec: float
    changes: tuple[PartChange, ...]

    @property
    def unexplained(self) -> bool:
        """True if the residual exceeds what changes of the model's parts explain."""
        return self.residual_arcsec > self.residual_limit_arcsec

    def verdict(self, before: Verdict) -> Verdict:
        """Returns the verdict; if the residual is only just below its limit, the verdict ``before``."""
        if not self.changes and not self.unexplained:
            clear = self.residual_arcsec < CLEAR_SHARE * self.residual_limit_arcsec
            return Verdict.HOLDS if clear else before
        wear = not self.unexplained and all(each.wear for each in self.changes)
        return Verdict.RECALIBRATE if wear else Verdict.SOMETHING_CHANGED

    @property
    def text(self) -> str:
        """Result in words, with the measured values."""
        changes = "; ".join(each.text for each in self.changes) or "no part of the model changed"
        return (
            f"{changes}. At {self.places} places the load deviates from the model by {self.rms_arcsec:.2f} "
            f"arcsec rms (its intervals and the noise allow {self.allowed_arcsec:.2f}). With all parts of "
            f"the model free to change, {self.residual_arcsec:.2f} remain (the noise allows "
            f"{self.residual_limit_arcsec:.2f})"
        )


def _largest_changes(before: TransmissionModel, after: TransmissionModel) -> str:
    """Describes the four largest relative changes of parameters."""
    changes = changes_between(before, before, after)
    by = {each: abs(each.after - each.before) / max(abs(each.before), 1e-9) for each in changes}
    most = [each for each in sorted(changes, key=lambda each: -by[each]) if by[each] > REPORTED_SHARE]
    return ", ".join(f"{each.parameter} {each.before:.4g} to {each.after:.4g}" for each in most[:4])


def _places(observations: Sequence[Observation]) -> tuple[FloatArray, FloatArray]:
    """Averages observations of about the same motor angle and state; returns their regressors and errors.

    Time, scaled to -1 to 1, is appended as the last regressor.
    """
    rows = np.array([each.row for each in observations])
    time_s = np.array([each.time_s for each in observations])
    error = np.array([each.error_arcsec for each in observations])
    _, place, count = np.unique(np.round(rows / CELL), axis=0, return_inverse=True, return_counts=True)
    place = place.reshape(-1)
    middle, half = 0.5 * (time_s[0] + time_s[-1]), 0.5 * float(np.ptp(time_s)) or 1.0
    rows = np.column_stack([rows, (time_s - middle) / half])
    means = np.zeros((len(count), rows.shape[1]))
    np.add.at(means, place, rows)
    return means / count[:, np.newaxis], np.bincount(place, error) / count


class Watch:
    """Raises and withdraws verdicts on one axis and its model."""

    def __init__(self, drift: DriftModel, noise_arcsec: float) -> None:
        """``noise_arcsec`` is the standard deviation of an observation."""
        self.evidence: Evidence | None = None
        """Last evidence; None until enough observations exist."""
        self._drift = drift
        self._noise = NOISE_RATIO * noise_arcsec
        settings = AdaptationSettings()
        prior = calibrated_estimator(drift, settings)
        self._calibrated = prior.covariance
        for each in drift.terms:
            if each.effect.name not in drift.model.uncertainty:
                coefficients = each.effect.coefficients()
                share = Scales().calibrated * float(np.linalg.norm(coefficients, np.inf))
                self._calibrated[each.columns, each.columns] = share**2 * np.eye(len(coefficients))
        self._information = np.append(prior.scale, TREND_ARCSEC) ** -2
        self._bounds, self._zero_bound = bounds_arcsec(drift, settings), settings.zero_bound_arcsec
        tests = (len(drift.terms) + 2) * DAY_S / EVERY_S
        self._alpha = FALSE_ALARMS_PER_DAY / tests
        """Probability of a false positive in one test."""
        self._adopted = self._other = Verdict.HOLDS
        """Verdict on the gear, and the different verdict that must persist before it is adopted."""
        self._persisted_s = 0.0
        self._faulty = False
        self._observations: deque[Observation] = deque(maxlen=MAX_OBSERVATIONS)
        self._new = False
        self._tested_s = -EVERY_S

    @property
    def verdict(self) -> Verdict:
        return Verdict.ENCODER if self._faulty else self._adopted

    def take(
        self,
        observations: Sequence[Observation],
        status: EncoderStatus,
        zero: Displacement | None,
        now_s: float,
    ) -> list[RaisedVerdict]:
        """Takes observations, state and zero of the load encoder; returns new verdicts."""
        raised: list[RaisedVerdict] = []
        if (status.fault is not None) != self._faulty:
            self._faulty = status.fault is not None
            self._observations.clear()
            reason = status.reason or "no evidence against the load encoder"
            raised.append(RaisedVerdict(self.verdict, reason))
        self._observations.extend(observations)
        self._new |= bool(observations)
        passed_s = now_s - self._tested_s
        if not 0.0 <= passed_s < EVERY_S:
            self._tested_s = now_s
            if self._test(zero, now_s, min(passed_s, 2.0 * EVERY_S)) and self.evidence is not None:
                raised.append(RaisedVerdict(self.verdict, self.evidence.text))
        return raised

    def _test(self, zero: Displacement | None, now_s: float, passed_s: float) -> bool:
        """Tests the recent observations; returns True if the verdict changes."""
        recent = self._observations
        while recent and not 0.0 <= now_s - recent[0].time_s <= WINDOW_S:
            recent.popleft()
        # An axis at rest provides no new evidence, and an uncalibrated one has no model to test.
        if not self._new or self._faulty or not self._drift.model.effects:
            return False
        self._new = False
        evidence = self._evidence(recent, zero)
        if evidence is None:
            return False
        self.evidence = evidence
        return self._adopts(evidence.verdict(self._adopted), passed_s)

    def _adopts(self, verdict: Verdict, passed_s: float) -> bool:
        """Takes the current verdict and the time since the last test; returns True once it has persisted."""
        if verdict is self._adopted or verdict is not self._other:
            self._other, self._persisted_s = verdict, 0.0
        if verdict is self._adopted:
            return False
        self._persisted_s += passed_s
        if self._persisted_s < (WITHDRAW_S if verdict is Verdict.HOLDS else RAISE_S):
            return False
        self._adopted, self._persisted_s = verdict, 0.0
        return True

    # ------------------------------------------------------------------ the tests

    def _evidence(self, observations: Sequence[Observation], zero: Displacement | None) -> Evidence | None:
        """Tests the observations; None if they are too few. ``zero`` is None if it is not known yet."""
        required = self._drift.count + 1 + MIN_EXTRA_PLACES
        if len(observations) < required:
            return None
        rows, observed = _places(observations)
        count, columns = rows.shape
        if count < required:
            return None
        change, spread = ranged_fit(rows, observed, self._noise, self._information)
        free = max(count - columns, 1)
        residual = observed - rows @ change
        rms, allowed = self._as_calibrated(rows, observed)
        changes = [self._part_change(each, rows, change, spread) for each in self._drift.terms]
        if zero is not None:
            changes.append(self._zero_change(zero))
        residual_limit = self._noise * float(np.sqrt(self._chi_square(free) / free))
        return Evidence(
            places=count,
            rms_arcsec=rms,
            allowed_arcsec=allowed,
            residual_arcsec=float(np.sqrt(residual @ residual / free)),
            residual_limit_arcsec=float(np.hypot(residual_limit, MIN_RESIDUAL_ARCSEC)),
            changes=tuple(each for each in changes if each is not None),
        )

    def _as_calibrated(self, rows: FloatArray, observed: FloatArray) -> tuple[float, float]:
        """Returns the rms error without zero, disc and trend, and its limit by the intervals, arcsec."""
        zero = self._drift.zero
        nuisance, followed = rows[:, zero:], rows[:, :zero]
        basis, _ = np.linalg.qr(nuisance)
        about = observed - basis @ (basis.T @ observed)
        free = max(len(observed) - nuisance.shape[1], 1)
        calibrated = self._calibrated[:zero, :zero]
        allowed = float(np.mean(np.einsum("ij,jk,ik->i", followed, calibrated, followed))) if zero else 0.0
        share = self._chi_square(free) / free
        return float(np.sqrt(about @ about / free)), float(np.sqrt(share * (self._noise**2 + allowed)))

    def _chi_square(self, free: int) -> float:
        """Returns the critical chi square at the false-alarm probability, for ``free`` degrees of freedom."""
        from scipy.special import chdtri  # noqa: PLC0415 - the daemon's service starts without scipy

        return float(chdtri(free, self._alpha))

    def _part_change(
        self, term: Term, rows: FloatArray, change: FloatArray, spread: FloatArray
    ) -> PartChange | None:
        """Returns the change of an effect if it exceeds the effect's interval and the errors of this fit."""
        at = term.columns
        own = change[at]
        variance = self._calibrated[at, at] + spread[at, at]
        if float(own @ np.linalg.solve(variance, own)) < self._chi_square(len(own)):
            return None
        relevant = ORDER_ARCSEC
        if term.memory:
            loop = float(np.std(rows[:, at] @ term.effect.coefficients()))
            relevant = max(LOOP_ARCSEC, LOOP_SHARE * loop)
        if float(np.std(rows[:, at] @ own)) < relevant:
            return None
        only = np.zeros(self._drift.zero)
        only[at] = own
        changed = self._drift.changed(only)
        wear = bool(np.all(np.abs(own) <= self._bounds[at]))
        wear &= not changed.effects[term.number].violations()
        return PartChange(_largest_changes(self._drift.model, changed), wear)

    def _zero_change(self, zero: Displacement) -> PartChange | None:
        """Returns the change of the zero since it was learned; None if it is not significant."""
        if abs(zero.arcsec) < max(ZERO_ARCSEC, math.sqrt(self._chi_square(1)) * zero.error):
            return None
        return PartChange(f"zero: by {zero.arcsec:+.1f} arcsec", abs(zero.arcsec) <= self._zero_bound)
