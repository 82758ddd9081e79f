"""One axis's adaptation: from samples to proposals of another model. Pure: time comes with the samples.

`Learning` says what the load encoder shows; the model in use follows it within its bounds and no faster than
its rate.
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
"""Afterwards the drive's zero may be another one."""
NEEDED = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
RATE_INTERVALS = 2.0
"""A pause earns no more change than so many intervals."""
LEAST_SHARE = 0.99
"""Of what the rate allows in an interval: so much is worth a change, however small."""


@dataclass(frozen=True, slots=True)
class Memory:
    """What survives a restart of the service."""

    estimate: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    applied: tuple[float, ...]
    windows: int


@dataclass(frozen=True, slots=True)
class Report:
    """What an axis's adaptation is doing, for people."""

    mode: Mode
    standing: Standing
    reason: str
    """Why it is frozen or waits; empty while it follows."""
    estimated: TransmissionModel
    """What the load encoder shows now, before rates."""
    zero_arcsec: float | None
    """How far the zero has moved since it was taken; None before that. It is told, never applied."""
    windows: int


class Adaptation:
    """One axis. `take` is to be called with its samples in order, from one thread."""

    def __init__(
        self,
        model: TransmissionModel,
        settings: AdaptationSettings,
        reading: Reading,
        log: Log = lambda _: None,
        memory: Memory | None = None,
    ) -> None:
        """``model`` is the committed one; ``memory`` what an earlier one of the same model had (`memory`).

        InputError where ``settings`` name a parameter that the model does not have.
        """
        self.settings = settings
        self.committed = model
        """What it began with, and goes back to."""
        self.mode: Mode = settings.mode
        self._log = log
        self._now_s = 0.0
        self._learning = Learning(model, settings, reading, self._tell)
        self._proposed = self._used = np.zeros(self._learning.regressors.followed)
        """Changes in the model proposed last, also where it was only reported; in the model in use."""
        self._in_use = model
        self._changed_s: float | None = None
        """When a change was last made or considered."""
        if memory is not None:
            self._go_on(memory)

    def take(self, times_s: FloatArray, axis: NDArray[Any], disbelieved: str = "") -> Proposal | None:
        """Samples of `AXIS_SAMPLE`, shape (n,), in order; another model where it is time for one.

        ``disbelieved`` says why the load encoder is not to be believed just now; empty where it is.
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
        """Samples are missing: the state of the gear is not known until the axis has turned past its loop."""
        self._learning.lose_path()

    def resume(self) -> None:
        """Believe the load encoder again after a doubt, whatever it reads; learn anew from here on."""
        self._learning.believe()

    def adapt(self, mode: Mode) -> None:
        """Another mode from here on; ``on`` after a doubt is `resume`."""
        if mode == "on" and self._learning.doubt is not None:
            self.resume()
        if mode != self.mode:
            # What was only observed is not applied at once: it begins from what is in use.
            self._proposed, self._changed_s = self._used, self._now_s
            if self.mode == "off":
                self.lost_path()
            self._tell("mode", mode=mode)
            self.mode = mode

    def back(self) -> Proposal:
        """Back to the committed model, and only observe from here on, until `adapt`."""
        changes = changes_between(self.committed, self._in_use, self.committed)
        self._learning.begin_anew()
        self._proposed = self._used = np.zeros(self._learning.regressors.followed)
        self._in_use = self.committed
        self.mode = "observe"
        self._tell("back", changes=_plain(changes))
        return Proposal(self.committed, changes, True, self._now_s)

    @property
    def model(self) -> TransmissionModel:
        """The model that is to be in use: what was proposed last to be applied, or kept over a restart."""
        return self._in_use

    @property
    def estimate_arcsec(self) -> FloatArray:
        """Estimated changes of the followed coefficients, (f,)."""
        return self._learning.change_arcsec

    @property
    def covariance(self) -> FloatArray:
        """Of the followed coefficients, (f, f)."""
        followed = self._learning.regressors.followed
        return self._learning.covariance[:followed, :followed].copy()

    @property
    def used_arcsec(self) -> FloatArray:
        """Changes of the followed coefficients in the model in use, (f,)."""
        return self._used.copy()

    def report(self) -> Report:
        """What it is doing."""
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
        """What is to be kept over a restart."""
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
        """The committed model changed by so much, with the intervals that are known now."""
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
