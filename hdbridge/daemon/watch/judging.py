"""Does the model still hold? What was observed over a while, against what the model's intervals allow.

The observed error less the model's is, if the model holds, noise plus what its parameters may be off by:

    observed - predicted = columns @ change + zero + its trend + disc of the load encoder + noise

with ``change`` drawn from the model file's intervals (where it has none, from those of a usual calibration,
as `diagnose.changes` has them), and noise of the size that the model left on data that it had not seen (or of
the motor encoder's counts, where that is more). Three questions, by generalised least squares:

* has a part of the model moved by more than its interval and the errors of this fit allow (chi square)?
* has the zero moved since it was learned?
* is more left, with every part free to move, than the noise allows (chi square)?

What counts as a question's yes is set by how often it may be wrong: `Allowed.false_alarms_per_day` is divided
by the number of questions asked in a day. Observations at one place in one direction are one observation:
what the axis does not repeat is the noise, and what it repeats there is not known any better by waiting.
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
"""Places that must have been seen in addition to one for each column."""
CLEARLY: Final = 0.8
TREND_ARCSEC: Final = 60.0
"""What the zero may go by from one end of the observations to their middle."""
TOLD: Final = 0.02
"""Relative change of a parameter from which on it is told."""
CELL: Final = 0.1
"""Columns that differ by less are those of one place."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """From where on a change is a change."""

    false_alarms_per_day: float = 1.0 / 365.0
    """Of one axis, while its model holds: once a year."""
    every_s: float = 10.0
    """How often it is asked."""
    noise: float = 1.5
    """Noise of a day at work, by that of a calibration."""
    order_arcsec: float = 0.8
    """Least change of the orders that is one, at the load."""
    loop_arcsec: float = 1.5
    loop_share: float = 3.0 * Scales().calibrated
    """The same for a loop: the larger of a size and of this share of what the loop does."""
    zero_arcsec: float = 5.0
    """Least change of the zero: the least that a warm-up does (`effects.zero_drift`)."""
    left_arcsec: float = 0.5
    """Least of what no part of the model explains, root mean square, beyond the noise."""


class Moved(NamedTuple):
    """A part of the model that is no longer as it was."""

    name: str
    """Of the effect, or ``zero``."""
    words: str
    """What moved from where to where."""
    size_arcsec: float
    """Root mean square of what it does to the error."""
    within_kind: bool
    """Whether wear, warmth or age do such a thing; else it is something else that looks like it."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a while at work says about the model."""

    places: int
    """Different places at which the axis was observed."""
    rms_arcsec: float
    """Difference between measured and predicted error there, about its zero."""
    allowed_arcsec: float
    """The most of that which noise and the model's intervals make."""
    left_arcsec: float
    """What of it is left when every part of the model is free to move."""
    left_allowed_arcsec: float
    zero: FloatArray
    """The zero, arcsec, and the coefficients of the load encoder's disc."""
    moved: tuple[Moved, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing has changed."""
        return not self.moved and not self.unexplained

    @property
    def clearly_holds(self) -> bool:
        """Whether nothing is near its limit, either: for a verdict to be withdrawn."""
        return self.holds and self.left_arcsec < CLEARLY * self.left_allowed_arcsec

    @property
    def unexplained(self) -> bool:
        """Whether more is left than any change of the model's parts explains."""
        return self.left_arcsec > self.left_allowed_arcsec

    @property
    def explained(self) -> bool:
        """Whether a change within the kind of the model's parts is all there is."""
        return bool(self.moved) and not self.unexplained and all(each.within_kind for each in self.moved)

    def words(self) -> str:
        """With figures."""
        moved = "; ".join(each.words for each in self.moved) or "no part of the model moved"
        return (
            f"{moved}. Over {self.places} places the load is {self.rms_arcsec:.2f} arcsec rms off the model "
            f"(its intervals and the noise allow {self.allowed_arcsec:.2f}), "
            f"{self.left_arcsec:.2f} with the model's parts free to move (the noise allows "
            f"{self.left_allowed_arcsec:.2f})"
        )


class Judge:
    """Judges one model; ``noise_arcsec`` is the standard deviation of an observation."""

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
        """Probability of a wrong yes to one question."""

    @property
    def least_places(self) -> int:
        """So many places must have been seen."""
        return self._regressors.count + 1 + SPARE

    def judge(self, observations: Sequence[Observation], zero: FloatArray | None) -> Evidence | None:
        """None where too little was seen. ``zero`` is `Evidence.zero` of then; None: it is not known yet."""
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
        """Change and covariance with every part free to move within what is possible at all; ``columns`` says
        which of all columns the rows have.
        """
        scale = np.append(self._scale, TREND_ARCSEC)[columns]
        information = rows.T @ rows / self._noise**2 + np.diag(1.0 / scale**2)
        spread = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return spread @ (rows.T @ observed) / self._noise**2, spread

    def _as_calibrated(self, rows: FloatArray, observed: FloatArray) -> tuple[float, float]:
        """Root mean square about zero and disc, and the most of it that the model's intervals allow."""
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
        """Whether an effect has moved by more than its interval and this fit's errors."""
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
        """Against the zero that was learned, with the disc of then: over a part of a turn the two are hardly
        distinguished, but a disc does not change.
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
    """The parameters that have moved most, by their own size."""
    changes = changes_between(before, before, after)
    by = {each: abs(each.after - each.before) / max(abs(each.before), 1e-9) for each in changes}
    most = [each for each in sorted(changes, key=lambda each: -by[each]) if by[each] > TOLD]
    return ", ".join(f"{each.parameter} {each.before:.4g} to {each.after:.4g}" for each in most[:4])


def _places(observations: Sequence[Observation]) -> tuple[FloatArray, FloatArray]:
    """Columns and error of each place, the mean of its observations; the last column is time, -1 to 1."""
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
