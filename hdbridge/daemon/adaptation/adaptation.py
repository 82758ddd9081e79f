"""Adaptation of one axis: turns samples into proposals of a changed model. Pure: samples contain the time.

`Learning` estimates what the load encoder shows. The model in use follows the estimate within its bounds, at
a limited rate.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdbridge.control.compensation import Inverse
from hdbridge.daemon.adaptation.learning import Learning, Reading
from hdbridge.daemon.adaptation.plausibility import Doubt
from hdbridge.daemon.adaptation.prior import uncertainty_of
from hdbridge.daemon.adaptation.proposal import Change, Log, Proposal, changes_between
from hdbridge.daemon.adaptation.settings import AdaptationSettings, Mode, Standing
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import NO_FAULT, SampleFlag
from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.model import TransmissionModel

ZERO_LOST = (AxisState.UNVERIFIED, AxisState.LENT, AxisState.LATCHED)
"""States after which the drive's zero may have changed."""
NEEDED = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
RATE_INTERVALS = 2.0
"""Maximum number of intervals for which a pause permits change."""
LEAST_SHARE = 0.99
"""Share of the change permitted per interval that is applied however small it is."""


@dataclass(frozen=True, slots=True)
class Memory:
    """State that survives a restart of the service."""

    estimate: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    applied: tuple[float, ...]
    windows: int


@dataclass(frozen=True, slots=True)
class Report:
    """State of an axis's adaptation, for clients."""

    mode: Mode
    standing: Standing
    reason: str
    """Reason why it is frozen or waits; empty while it follows."""
    estimated: TransmissionModel
    """Model that the load encoder shows now, before rate limits."""
    zero_arcsec: float | None
    """Change of the zero since it was taken; None before. It is reported, never applied."""
    windows: int


class Adaptation:
    """Adaptation of one axis. Call `take` with its samples in order, from one thread."""

    def __init__(
        self,
        model: TransmissionModel,
        settings: AdaptationSettings,
        reading: Reading,
        log: Log = lambda _: None,
        memory: Memory | None = None,
    ) -> None:
        """``model`` is the committed one; ``memory`` the state of an earlier adaptation of it (`memory`).

        Raises InputError if ``settings`` name a parameter that the model does not have.
        """
        self.settings = settings
        self.committed = model
        """Committed model, to which `back` returns."""
        self.mode: Mode = settings.mode
        self._log = log
        self._now_s = 0.0
        self._learning = Learning(model, settings, reading, self._tell)
        self._proposed = self._used = np.zeros(self._learning.regressors.followed)
        """Changes of the coefficients in the last proposed model, applied or not, and in the model in use."""
        self._in_use = model
        self._changed_s: float | None = None
        """Time at which a change was last made or considered."""
        if memory is not None:
            self._go_on(memory)

    def take(self, times_s: FloatArray, axis: NDArray[Any], disbelieved: str = "") -> Proposal | None:
        """Takes samples of `AXIS_SAMPLE`, shape (n,), in order; returns a proposal when one is due.

        ``disbelieved`` is the reason why the load encoder is not believed now; empty if it is.
        """
        if self.mode == "off" or not len(times_s):
            return None
        self._now_s = float(times_s[-1])
        others = np.flatnonzero(axis["state"] != AxisState.ENABLED)
        if len(others):
            self.lost_path()
            if np.any(np.isin(axis["state"][others], ZERO_LOST)):
                self._learning.lose_zero()
            times_s, axis = times_s[others[-1] + 1 :], axis[others[-1] + 1 :]
        stopped = axis["fault"] != NO_FAULT
        if np.any(stopped):
            self._learning.question(Doubt("the supervision has stopped the axis", lasting=False))
        elif disbelieved:
            self._learning.question(Doubt(disbelieved, lasting=False))
        usable = ((axis["flags"] & NEEDED) == NEEDED) & ~stopped & (not disbelieved)
        self._learning.take(times_s, axis, usable)
        return self._proposal()

    def lost_path(self) -> None:
        """Handles missing samples: the hysteresis state is unknown until the axis has passed its loop."""
        self._learning.lose_path()

    def resume(self) -> None:
        """Ends a doubt about the load encoder, whatever it reads, and learns from now on."""
        self._learning.believe()

    def adapt(self, mode: Mode) -> None:
        """Changes the mode; ``on`` after a doubt also calls `resume`."""
        if mode == "on" and self._learning.doubt is not None:
            self.resume()
        if mode != self.mode:
            # Changes that were only observed are not applied at once: start from the model in use.
            self._proposed, self._changed_s = self._used, self._now_s
            if self.mode == "off":
                self.lost_path()
            self._tell("mode", mode=mode)
            self.mode = mode

    def back(self) -> Proposal:
        """Restores the committed model and only observes from now on, until `adapt`."""
        changes = changes_between(self.committed, self._in_use, self.committed)
        self._learning.begin_anew()
        self._proposed = self._used = np.zeros(self._learning.regressors.followed)
        self._in_use = self.committed
        self.mode = "observe"
        self._tell("back", changes=_plain(changes))
        return Proposal(self.committed, changes, True, self._now_s)

    @property
    def model(self) -> TransmissionModel:
        """Model that should be in use: the last one proposed to be applied, or restored after a restart."""
        return self._in_use

    @property
    def estimate_arcsec(self) -> FloatArray:
        """Estimated changes of the adapted coefficients, (f,)."""
        return self._learning.change_arcsec

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the adapted coefficients, (f, f)."""
        followed = self._learning.regressors.followed
        return self._learning.covariance[:followed, :followed].copy()

    @property
    def used_arcsec(self) -> FloatArray:
        """Changes of the adapted coefficients in the model in use, (f,)."""
        return self._used.copy()

    def report(self) -> Report:
        """Returns its present state."""
        learning = self._learning
        standing, reason = Standing.FOLLOWING, ""
        if self.mode == "off":
            standing = Standing.OFF
        elif learning.doubt is not None:
            standing, reason = Standing.FROZEN, learning.doubt.reason
        elif not learning.known:
            standing, reason = Standing.WAITING, "the axis has not yet turned past its loop"
        elif not learning.windows:
            standing, reason = Standing.WAITING, "not enough motion yet"
        estimated = self._model_at(learning.change_arcsec)
        return Report(self.mode, standing, reason, estimated, learning.zero_moved_arcsec, learning.windows)

    def memory(self) -> Memory:
        """Returns the state to keep over a restart."""
        learning = self._learning
        return Memory(
            tuple(learning.estimate.tolist()),
            tuple(tuple(row) for row in learning.covariance.tolist()),
            tuple(self._used.tolist()),
            learning.windows,
        )

    def _go_on(self, memory: Memory) -> None:
        learning = self._learning
        estimate, covariance = np.array(memory.estimate), np.array(memory.covariance)
        applied = np.array(memory.applied)
        if estimate.shape != learning.estimate.shape or covariance.shape != learning.covariance.shape:
            return
        if applied.shape != self._used.shape:
            return
        learning.go_on(estimate, covariance, memory.windows)
        if self.mode == "on":
            self._used = np.clip(applied, -learning.bounds_arcsec, learning.bounds_arcsec)
            self._proposed, self._in_use = self._used, self._model_at(self._used)

    def _proposal(self) -> Proposal | None:
        settings, learning = self.settings, self._learning
        if learning.begun_s is None:
            return None
        since_s = max(learning.begun_s, self._changed_s or learning.begun_s)
        passed_s = min(learning.learnt_s - since_s, RATE_INTERVALS * settings.interval_s)
        if passed_s < settings.interval_s:
            return None
        self._changed_s = learning.learnt_s
        most = settings.rate_arcsec_per_hour * passed_s / 3600.0
        step = np.clip(learning.change_arcsec - self._proposed, -most, most)
        worth = min(settings.smallest_arcsec, LEAST_SHARE * most)
        if float(np.max(np.abs(step), initial=0.0)) < worth or not len(step):
            return None
        return self._propose(self._proposed + step)

    def _propose(self, change: FloatArray) -> Proposal | None:
        model = self._model_at(change)
        try:
            Inverse(model)
        except InputError as error:
            self._tell("refused", reason=str(error))
            return None
        changes = changes_between(self.committed, self._model_at(self._proposed), model)
        self._proposed = change
        apply = self.mode == "on"
        if apply:
            self._used, self._in_use = change, model
        self._tell("changed" if apply else "would change", changes=_plain(changes))
        return Proposal(model, changes, apply, self._now_s)

    def _model_at(self, change: FloatArray) -> TransmissionModel:
        """Returns the committed model with changed coefficients and their present intervals."""
        if not np.any(change):
            return self.committed
        regressors = self._learning.regressors
        model = regressors.changed(change)
        uncertainty = dict(model.uncertainty)
        for each in regressors.terms:
            effect = model.effects[each.place]
            own = self._learning.covariance[each.columns, each.columns]
            uncertainty[effect.name] = uncertainty_of(effect, own, uncertainty.get(effect.name, {}))
        provenance = {**model.provenance, "reason": "the committed model, adapted by the load encoder"}
        return replace(model, uncertainty=uncertainty, provenance=provenance)

    def _tell(self, event: str, **facts: Any) -> None:
        self._log({"event": event, "axis_time_s": self._now_s, **facts})


def _plain(changes: Iterable[Change]) -> dict[str, dict[str, float]]:
    return {
        each.parameter: {"committed": each.committed, "before": each.before, "after": each.after}
        for each in changes
    }
