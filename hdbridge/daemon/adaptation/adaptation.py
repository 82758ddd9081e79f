"""One axis's adaptation: from samples to proposals of another model. Pure: time comes with the samples.

Observations are gathered into windows. A window counts once the axis has moved enough (`Excitation`), and is
refused as a whole where it cannot be wear or temperature (`plausibility`). What it teaches goes into the
estimate; the model in use follows the estimate within its bounds and no faster than its rate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdbridge.control.compensation import Inverse
from hdbridge.daemon.adaptation.measuring import Measuring, Observation, turns
from hdbridge.daemon.adaptation.plausibility import Doubt, Plausibility
from hdbridge.daemon.adaptation.prior import ZERO_ARCSEC, bounds_arcsec, estimator_of, uncertainty_of
from hdbridge.daemon.adaptation.proposal import Log, Proposal, changes_between
from hdbridge.daemon.adaptation.regressors import Regressors
from hdbridge.daemon.adaptation.settings import AdaptationSettings, Mode, Standing
from hdbridge.daemon.memory import NO_FAULT, SampleFlag
from hdbridge.effects import Channel, FloatArray
from hdbridge.errors import InputError
from hdbridge.model import TransmissionModel

ENABLED = 3
"""`AxisState.ENABLED`."""
ZERO_LOST = (0, 5, 7)
"""`AxisState` in which the drive's zero may become another: UNVERIFIED, LENT (homing), LATCHED."""
NEEDED = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
PATIENCE = 4.0
"""Times the turns of `Excitation` after which a window without reversals is used for what needs none."""
CLEAR_WINDOWS = 3
"""Plausible windows in a row that end a doubt that does not last."""
UNLEARNT = 3
"""Windows before a fault was noticed that are forgotten."""
RATE_INTERVALS = 2.0
"""A pause earns no more change than so many intervals."""


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
    """How far the zero has moved since it was first seen; None before that."""
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
        """``memory`` is what an earlier one of the same committed model had (`memory`).

        InputError where ``settings`` name a parameter that the model does not have.
        """
        self.settings = settings
        self.mode: Mode = settings.mode
        self._log = log
        self._reading = reading
        self._regressors = Regressors(model, settings.parameters)
        self._bounds = bounds_arcsec(self._regressors, settings)[:-1]
        self._others = self._regressors.remembers.copy()
        self._others[self._regressors.zero :] = True
        """The columns of the loop, the zero and the load encoder's disc."""
        self._measuring = Measuring(self._regressors, settings.slow_deg_s, reading.channels)
        self._plausibility = Plausibility(settings.zero_rate_arcsec_per_hour, reading.load_count_arcsec)
        self._estimator = estimator_of(self._regressors, settings)
        self._applied = np.zeros(self._regressors.followed)
        """Changes in the model proposed last, also in one that was only reported."""
        self._used = self._applied
        """Changes in the model in use."""
        self._in_use = model
        self._windows = 0
        self._now_s = 0.0
        self._window: list[Observation] = []
        self._zero_arcsec: float | None = None
        """Where it was first seen."""
        self._doubted: Doubt | None = None
        self._cleared = 0
        self._earlier: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=UNLEARNT)
        """Estimates and covariances before the last windows."""
        self._last_s: float | None = None
        """End of the last window."""
        self._changed_s: float | None = None
        """When the model was last changed, or a change was last considered."""
        if memory is not None:
            self._remember(memory)

    def take(self, times_s: FloatArray, axis: NDArray[Any], disbelieved: str = "") -> Proposal | None:
        """Samples of `AXIS_SAMPLE`, shape (n,), in order; another model where it is time for one.

        ``disbelieved`` says why the load encoder is not to be believed just now; empty where it is.
        """
        if self.mode == "off" or not len(times_s):
            return None
        self._now_s = float(times_s[-1])
        others = np.flatnonzero(axis["state"] != ENABLED)
        if len(others):
            self.lost_path()
            if np.any(np.isin(axis["state"][others], ZERO_LOST)):
                self.lost_zero()
            times_s, axis = times_s[others[-1] + 1 :], axis[others[-1] + 1 :]
        faulty = axis["fault"] != NO_FAULT
        if np.any(faulty):
            self._doubt(Doubt("the supervision has stopped the axis", lasting=False))
        elif disbelieved:
            self._doubt(Doubt(disbelieved, lasting=False))
        usable = ((axis["flags"] & NEEDED) == NEEDED) & ~faulty & (not disbelieved)
        for each in self._measuring.take(times_s, axis, usable):
            self._window.append(each)
            if self._complete():
                self._close()
        return self._proposal()

    def lost_path(self) -> None:
        """Samples are missing or the axis had no power: the state of the gear is not known any more."""
        self._measuring.restart()
        self._window.clear()

    def lost_zero(self) -> None:
        """The drive's zero may be another one: homed, or switched off. Ends a doubt about the zero."""
        if self._zero_arcsec is None and self._doubted is None:
            return
        self._free_zero()
        if self._doubted is not None and self._doubted.lasting:
            self._believe("the zero was taken again")

    def resume(self) -> None:
        """Believe the load encoder again after a doubt, whatever it reads; learn anew from here on."""
        scale = self._estimator.scale
        self._estimator.covariance = self._estimator.covariance + np.diag(scale**2)
        self._free_zero()
        self._believe("by command")

    def adapt(self, mode: Mode) -> None:
        """Another mode from here on; ``on`` after a doubt is `resume`."""
        if mode == "on" and self._doubted is not None:
            self.resume()
        if mode != self.mode:
            self._applied, self._changed_s = self._used, None
            self._tell("mode", mode=mode)
            self.mode = mode

    def back(self) -> Proposal:
        """Back to the committed model, and only observe from here on, until `adapt`."""
        committed = self._regressors.model
        changes = changes_between(committed, self._in_use, committed)
        self._estimator = estimator_of(self._regressors, self.settings)
        self._applied = self._used = np.zeros(self._regressors.followed)
        self._in_use = committed
        self._start()
        self.mode = "observe"
        self._tell("back", changes=_plain(changes))
        return Proposal(committed, changes, True, self._now_s)

    @property
    def committed(self) -> TransmissionModel:
        """The model that it began with, and goes back to."""
        return self._regressors.model

    def report(self) -> Report:
        """What it is doing."""
        standing, reason = Standing.FOLLOWING, ""
        if self.mode == "off":
            standing = Standing.OFF
        elif self._doubted is not None:
            standing, reason = Standing.FROZEN, self._doubted.reason
        elif not self._measuring.known:
            standing, reason = Standing.WAITING, "the axis has not yet turned past its loop"
        elif not self._windows:
            standing, reason = Standing.WAITING, "not enough motion yet"
        zero = None if self._zero_arcsec is None else self._zero_now() - self._zero_arcsec
        return Report(self.mode, standing, reason, self._model_at(self._wanted()), zero, self._windows)

    def memory(self) -> Memory:
        """What is to be kept over a restart."""
        estimator = self._estimator
        return Memory(
            tuple(estimator.estimate.tolist()),
            tuple(tuple(row) for row in estimator.covariance.tolist()),
            tuple(self._used.tolist()),
            self._windows,
        )

    @property
    def estimate_arcsec(self) -> FloatArray:
        """Estimated changes of the followed coefficients, (f,)."""
        return self._estimator.estimate[: self._regressors.followed].copy()

    @property
    def used_arcsec(self) -> FloatArray:
        """Changes of the followed coefficients in the model in use, (f,)."""
        return self._used.copy()

    @property
    def model(self) -> TransmissionModel:
        """The model that is to be in use: what was proposed last to be applied, or kept over a restart."""
        return self._in_use

    @property
    def covariance(self) -> FloatArray:
        """Of the followed coefficients, (f, f)."""
        return self._estimator.covariance[: self._regressors.followed, : self._regressors.followed].copy()

    # ------------------------------------------------------------------ windows

    def _start(self) -> None:
        self._window = []
        self._zero_arcsec = self._doubted = self._last_s = self._changed_s = None
        self._cleared = 0
        self._earlier.clear()
        self._plausibility.restart()

    def _complete(self) -> bool:
        asked, window = self.settings.excitation, self._window
        turned = turns(window)
        if len(window) < asked.samples or turned < asked.turns:
            return False
        reversals = sum(each.reversals for each in window)
        return reversals >= asked.reversals or turned >= PATIENCE * asked.turns

    def _close(self) -> None:
        """A window is complete: judge it, and learn from it."""
        window, self._window = self._window, []
        regressors, estimator = self._regressors, self._estimator
        rows = np.array([each.row for each in window])
        observed = np.array([each.error_arcsec for each in window])
        sigma = self._reading.sigma_arcsec
        if self._zero_arcsec is None:
            self._take_zero(rows, observed)
        residual = observed - rows @ estimator.estimate
        may = np.sqrt(estimator.variance_of(rows) + sigma**2) + self._earned(window, rows)
        doubt = self._plausibility.judge(window, residual, may, rows[:, self._others])
        self._last_s = window[-1].time_s
        if doubt is not None:
            self._doubt(doubt)
            return
        if self._doubted is not None:
            self._cleared += not self._doubted.lasting
            if self._cleared < CLEAR_WINDOWS:
                return
            self._believe("the load encoder agrees with the model again")
        self._earlier.append((estimator.estimate, estimator.covariance))
        asked = self.settings.excitation
        short = sum(each.reversals for each in window) < asked.reversals
        keep = 0.5 ** (turns(window) / self.settings.half_life_turns)
        estimator.update(rows, observed, sigma, keep=keep, held=regressors.remembers if short else None)
        followed = regressors.followed
        estimator.estimate[:followed] = np.clip(estimator.estimate[:followed], -self._bounds, self._bounds)
        self._windows += 1
        if self._changed_s is None:
            self._changed_s = window[0].time_s
        own_zero = self._zero_now() + float(np.mean(observed - rows @ estimator.estimate))
        doubt = self._plausibility.follow(window, own_zero)
        if doubt is not None:
            self._doubt(doubt)

    def _earned(self, window: list[Observation], rows: FloatArray) -> FloatArray:
        """What may have changed, within the rates, in the time in which nothing was seen, arcsec (n,)."""
        if self._last_s is None:
            return np.zeros(len(window))
        gap_h = max(window[0].time_s - self._last_s, 0.0) / 3600.0
        followed = np.abs(rows[:, : self._regressors.followed]).sum(axis=1)
        settings = self.settings
        per_hour = settings.rate_arcsec_per_hour * followed + settings.zero_rate_arcsec_per_hour
        return np.asarray(per_hour * gap_h)

    # ------------------------------------------------------------------ the zero

    def _zero_now(self) -> float:
        return float(self._estimator.estimate[self._regressors.zero])

    def _free_zero(self) -> None:
        """Nothing is known of the zero."""
        estimator, at = self._estimator, self._regressors.zero
        covariance = estimator.covariance.copy()
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = ZERO_ARCSEC**2
        estimator.covariance = covariance
        self._zero_arcsec = None
        self._window = []
        self._earlier.clear()
        self._plausibility.restart()

    def _take_zero(self, rows: FloatArray, observed: FloatArray) -> None:
        """Begin from the median of a window: what scatters about it is judged, not the zero itself."""
        estimator, at = self._estimator, self._regressors.zero
        others = estimator.estimate.copy()
        others[at] = 0.0
        others[at] = float(np.median(observed - rows @ others))
        estimator.estimate = others
        covariance = estimator.covariance.copy()
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = self._reading.sigma_arcsec**2
        estimator.covariance = covariance
        self._zero_arcsec = float(others[at])

    # ------------------------------------------------------------------ doubts

    def _doubt(self, doubt: Doubt) -> None:
        """Freeze: forget what the last windows taught, and change nothing until it is over."""
        self._window.clear()
        self._cleared = 0
        before = self._doubted
        if before is None:
            if self._earlier:
                self._estimator.estimate, self._estimator.covariance = self._earlier[0]
                self._earlier.clear()
            self._tell("frozen", reason=doubt.reason, lasting=doubt.lasting)
        if before is None or (doubt.lasting and not before.lasting):
            self._doubted = doubt

    def _believe(self, why: str) -> None:
        if self._doubted is not None:
            self._tell("thawed", reason=why)
        self._doubted = None
        self._cleared = 0
        self._changed_s = self._last_s = None

    # ------------------------------------------------------------------ proposals

    def _wanted(self) -> FloatArray:
        return np.clip(self.estimate_arcsec, -self._bounds, self._bounds)

    def _proposal(self) -> Proposal | None:
        settings, since = self.settings, self._changed_s
        if since is None or self._doubted is not None or self._last_s is None:
            return None
        if self._last_s - since < settings.interval_s:
            return None
        passed_s = min(self._last_s - since, RATE_INTERVALS * settings.interval_s)
        most = settings.rate_arcsec_per_hour * passed_s / 3600.0
        step = np.clip(self._wanted() - self._applied, -most, most)
        self._changed_s = self._last_s
        if not len(step) or float(np.max(np.abs(step))) < min(settings.smallest_arcsec, 0.99 * most):
            return None
        model = self._model_at(self._applied + step)
        try:
            Inverse(model)
        except InputError as error:
            self._tell("refused", reason=str(error))
            return None
        changes = changes_between(self._regressors.model, self._model_at(self._applied), model)
        self._applied = self._applied + step
        if self.mode == "on":
            self._used, self._in_use = self._applied, model
        self._tell("changed" if self.mode == "on" else "would change", changes=_plain(changes))
        return Proposal(model, changes, self.mode == "on", self._now_s)

    def _model_at(self, change: FloatArray) -> TransmissionModel:
        regressors = self._regressors
        model = regressors.changed(change)
        if not np.any(change):
            return regressors.model
        uncertainty = dict(model.uncertainty)
        for each in regressors.terms:
            effect = model.effects[each.place]
            own = self._estimator.covariance[each.columns, each.columns]
            uncertainty[effect.name] = uncertainty_of(effect, own, uncertainty.get(effect.name, {}))
        provenance = {**model.provenance, "reason": "the committed model, adapted by the load encoder"}
        return replace(model, uncertainty=uncertainty, provenance=provenance)

    # ------------------------------------------------------------------ memory

    def _remember(self, memory: Memory) -> None:
        estimator = self._estimator
        if len(memory.estimate) != len(estimator.estimate) or len(memory.applied) != len(self._applied):
            return
        estimator.estimate = np.array(memory.estimate)
        estimator.covariance = np.array(memory.covariance)
        if self.mode == "on":
            self._applied = self._used = np.clip(np.array(memory.applied), -self._bounds, self._bounds)
            self._in_use = self._model_at(self._used)
        self._windows = memory.windows
        self._free_zero()

    def _tell(self, event: str, **facts: Any) -> None:
        self._log({"event": event, "axis_time_s": self._now_s, **facts})


def _plain(changes: Any) -> dict[str, dict[str, float]]:
    return {
        each.parameter: {"committed": each.committed, "before": each.before, "after": each.after}
        for each in changes
    }
