"""Validity of the model: tests recent observations against the model's confidence intervals.

If the model is valid, the observed error minus the predicted one is noise plus the errors of its parameters:

    observed - predicted = columns @ change + zero + trend of the zero + load encoder disc + noise

``change`` has the covariance of the model file's intervals, or of a typical calibration if the file has none
(as in `diagnose.changes`). The noise is the model's residual on held-out data, or the motor encoder's
resolution if that is larger. Three tests use generalised least squares:

* Has a part of the model changed by more than its interval and the errors of this fit allow (chi square)?
* Has the zero moved since it was learned?
* Is the residual, with every part free to change, larger than the noise allows (chi square)?

The significance level follows from `Allowed.false_alarms_per_day`, divided by the number of tests per day.
Observations at one place in one direction count as one: averaging more of them does not reduce the part of
the error that repeats there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtri

from hdbridge.analysis.scales import Scales
from hdbridge.daemon.adaptation.measuring import Observation
from hdbridge.daemon.adaptation.prior import bounds_arcsec, estimator_of
from hdbridge.daemon.adaptation.proposal import changes_between
from hdbridge.daemon.adaptation.regressors import Regressors, Term
from hdbridge.daemon.adaptation.settings import AdaptationSettings
from hdbridge.effects import FloatArray
from hdbridge.model import TransmissionModel

DAY_S: Final = 86_400.0
SPARE: Final = 20
"""Places required in addition to one per column."""
CLEARLY: Final = 0.8
TREND_ARCSEC: Final = 60.0
"""Scale of the zero's trend, from the middle of the observations to one end."""
TOLD: Final = 0.02
"""Relative change of a parameter above which it is reported."""
CELL: Final = 0.1
"""Rounding of the columns; rows that agree after it are one place."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """Thresholds of the tests."""

    false_alarms_per_day: float = 1.0 / 365.0
    """False alarms per axis with a valid model: one per year."""
    every_s: float = 10.0
    """Interval between tests."""
    noise: float = 1.5
    """Noise in operation relative to that of a calibration."""
    order_arcsec: float = 0.8
    """Smallest change of the orders that counts, at the load."""
    loop_arcsec: float = 1.5
    loop_share: float = 3.0 * Scales().calibrated
    """Smallest change of a hysteresis loop: the larger of ``loop_arcsec`` and this share of the loop."""
    zero_arcsec: float = 5.0
    """Smallest change of the zero that counts: the smallest effect of warming up (`effects.zero_drift`)."""
    left_arcsec: float = 0.5
    """Smallest unexplained residual that counts, rms, in addition to the noise."""


class Moved(NamedTuple):
    """A part of the model that has changed."""

    name: str
    """Name of the effect, or ``zero``."""
    words: str
    """Description of the change."""
    size_arcsec: float
    """Rms change of the error."""
    within_kind: bool
    """True if wear, temperature or ageing can cause such a change; else it has another cause."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Result of the tests over the recent operation of an axis."""

    places: int
    """Number of distinct places observed."""
    rms_arcsec: float
    """Rms difference of measured and predicted error about its zero."""
    allowed_arcsec: float
    """Upper limit of that by noise and the model's intervals."""
    left_arcsec: float
    """Rms residual with every part of the model free to change."""
    left_allowed_arcsec: float
    zero: FloatArray
    """Zero in arcsec, and the coefficients of the load encoder's disc."""
    moved: tuple[Moved, ...]

    @property
    def holds(self) -> bool:
        """True if no test finds a change."""
        return not self.moved and not self.unexplained

    @property
    def clearly_holds(self) -> bool:
        """True if also no value is near its limit, which withdraws a verdict."""
        return self.holds and self.left_arcsec < CLEARLY * self.left_allowed_arcsec

    @property
    def unexplained(self) -> bool:
        """True if the residual exceeds what changes of the model's parts explain."""
        return self.left_arcsec > self.left_allowed_arcsec

    @property
    def explained(self) -> bool:
        """True if the model's parts changed, all within what wear can cause, and nothing else did."""
        return bool(self.moved) and not self.unexplained and all(each.within_kind for each in self.moved)

    def words(self) -> str:
        """Returns the result in words with figures."""
        moved = "; ".join(each.words for each in self.moved) or "no part of the model moved"
        return (
            f"{moved}. Over {self.places} places the load is {self.rms_arcsec:.2f} arcsec rms off the model "
            f"(its intervals and the noise allow {self.allowed_arcsec:.2f}), "
            f"{self.left_arcsec:.2f} with the model's parts free to move (the noise allows "
            f"{self.left_allowed_arcsec:.2f})"
        )


class Judge:
    """Tests one model; ``noise_arcsec`` is the standard deviation of an observation."""

    def __init__(self, regressors: Regressors, noise_arcsec: float, allowed: Allowed | None = None) -> None:
        self._regressors = regressors
        self._allowed = allowed = allowed or Allowed()
        self._noise = allowed.noise * noise_arcsec
        settings = AdaptationSettings()
        prior = estimator_of(regressors, settings)
        self._calibrated = prior.covariance
        for each in regressors.terms:
            if each.effect.name not in regressors.model.uncertainty:
                share = Scales().calibrated * float(np.linalg.norm(each.effect.coefficients(), np.inf))
                self._calibrated[each.columns, each.columns] = share**2 * np.eye(
                    len(each.effect.coefficients())
                )
        self._scale = prior.scale
        self._bounds = bounds_arcsec(regressors, settings)
        questions = (len(regressors.terms) + 2) * DAY_S / allowed.every_s
        self.alpha = allowed.false_alarms_per_day / questions
        """Probability of a false positive in one test."""

    @property
    def least_places(self) -> int:
        """Minimum number of places."""
        return self._regressors.count + 1 + SPARE

    def judge(self, observations: Sequence[Observation], zero: FloatArray | None) -> Evidence | None:
        """Tests the observations; returns None if they are too few.

        ``zero`` is `Evidence.zero` from when it was learned; None if it is not known yet.
        """
        if len(observations) < self.least_places:
            return None
        rows, observed = _places(observations)
        count, columns = rows.shape
        if count < self.least_places:
            return None
        change, spread = self._fit(rows, observed)
        free = max(count - columns, 1)
        left = observed - rows @ change
        as_calibrated, allowed = self._as_calibrated(rows, observed)
        moved = [
            found for each in self._regressors.terms if (found := self._moved(each, rows, change, spread))
        ]
        if zero is not None and (found := self._zero_moved(rows, observed, zero)):
            moved.append(found)
        left_allowed = self._noise * float(np.sqrt(chdtri(free, self.alpha) / free))
        return Evidence(
            places=count,
            rms_arcsec=as_calibrated,
            allowed_arcsec=allowed,
            left_arcsec=float(np.sqrt(left @ left / free)),
            left_allowed_arcsec=float(np.hypot(left_allowed, self._allowed.left_arcsec)),
            zero=change[self._regressors.zero : self._regressors.count],
            moved=tuple(moved),
        )

    def _fit(
        self, rows: FloatArray, observed: FloatArray, columns: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[FloatArray, FloatArray]:
        """Fits all parts within their possible range; returns the change and its covariance.

        ``columns`` selects the columns that the rows contain.
        """
        scale = np.append(self._scale, TREND_ARCSEC)[columns]
        information = rows.T @ rows / self._noise**2 + np.diag(1.0 / scale**2)
        spread = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return spread @ (rows.T @ observed) / self._noise**2, spread

    def _as_calibrated(self, rows: FloatArray, observed: FloatArray) -> tuple[float, float]:
        """Returns the rms about zero and disc, and its upper limit by the model's intervals."""
        zero = self._regressors.zero
        nuisance, followed = rows[:, zero:], rows[:, :zero]
        basis, _ = np.linalg.qr(nuisance)
        about = observed - basis @ (basis.T @ observed)
        free = max(len(observed) - nuisance.shape[1], 1)
        calibrated = self._calibrated[:zero, :zero]
        allowed = float(np.mean(np.einsum("ij,jk,ik->i", followed, calibrated, followed))) if zero else 0.0
        share = chdtri(free, self.alpha) / free
        return float(np.sqrt(about @ about / free)), float(np.sqrt(share * (self._noise**2 + allowed)))

    def _moved(self, term: Term, rows: FloatArray, change: FloatArray, spread: FloatArray) -> Moved | None:
        """Returns the change of an effect, if it exceeds the effect's interval and this fit's errors."""
        at, allowed = term.columns, self._allowed
        own = change[at]
        variance = self._calibrated[at, at] + spread[at, at]
        if float(own @ np.linalg.solve(variance, own)) < chdtri(len(own), self.alpha):
            return None
        does = rows[:, at] @ own
        size = float(np.std(does))
        if term.memory:
            least = max(
                allowed.loop_arcsec,
                allowed.loop_share * float(np.std(rows[:, at] @ term.effect.coefficients())),
            )
        else:
            least = allowed.order_arcsec
        if size < least:
            return None
        only = np.zeros(self._regressors.followed)
        only[at] = own
        changed = self._regressors.changed(only)
        within = bool(np.all(np.abs(own) <= self._bounds[at]))
        within &= not changed.effects[term.place].violations()
        return Moved(term.effect.name, _words(self._regressors.model, changed), size, within)

    def _zero_moved(self, rows: FloatArray, observed: FloatArray, before: FloatArray) -> Moved | None:
        """Returns the change of the zero against the learned one, if significant.

        The disc is fixed as learned, because over part of a turn it is hardly separable from the zero.
        """
        zero, disc = self._regressors.zero, slice(self._regressors.zero + 1, self._regressors.count)
        known = np.delete(np.arange(rows.shape[1]), np.arange(disc.start, disc.stop))
        change, spread = self._fit(rows[:, known], observed - rows[:, disc] @ before[1:], known)
        by = float(change[zero] - before[0])
        error = float(np.sqrt(2.0 * spread[zero, zero]))
        if abs(by) < max(self._allowed.zero_arcsec, -ndtri(0.5 * self.alpha) * error):
            return None
        return Moved("zero", f"zero: by {by:+.1f} arcsec", abs(by), abs(by) <= float(self._bounds[-1]))


def _words(before: TransmissionModel, after: TransmissionModel) -> str:
    """Describes the four largest relative changes of parameters."""
    changes = changes_between(before, before, after)
    by = {each: abs(each.after - each.before) / max(abs(each.before), 1e-9) for each in changes}
    most = [each for each in sorted(changes, key=lambda each: -by[each]) if by[each] > TOLD]
    return ", ".join(f"{each.parameter} {each.before:.4g} to {each.after:.4g}" for each in most[:4])


def _places(observations: Sequence[Observation]) -> tuple[FloatArray, FloatArray]:
    """Returns columns and mean error of each place; the last column is time from -1 to 1."""
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
