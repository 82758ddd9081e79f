"""Follower of one axis: one pass over its samples, from encoder health to verdict and adaptation.

    samples -> encoder health -> measuring -> zero -> watch (is the model still valid?)
                                                   -> adaptation (what has drifted, and by how much?)

Uses no thread and no clock: samples contain the time. Only the adaptation's files are written.
"""

import math
from datetime import datetime
from typing import Any, Final

import numpy as np

from hdbridge.analysis.response import change_between
from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import Response
from hdbridge.client import messages
from hdbridge.daemon.following.adaptation import Adaptation
from hdbridge.daemon.following.health import (
    DRIVEN,
    UNTESTED_ARCSEC,
    ZERO_UNKNOWN,
    EncoderHealth,
    EncoderStatus,
    in_states,
)
from hdbridge.daemon.following.judging import RaisedVerdict, Verdict, Watch
from hdbridge.daemon.following.measuring import DriftModel, Measuring
from hdbridge.daemon.following.servo import ServoWatch
from hdbridge.daemon.following.statefile import AdaptationFiles
from hdbridge.daemon.following.zero import Zero
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.memory import NO_FAULT, SampleArray, SampleFlag, joined_samples
from hdbridge.enums import AdaptationMode
from hdbridge.errors import InputError

MIN_BATCH_SAMPLES: Final = 25
"""Minimum number of samples evaluated together: ten evaluations per second at 250 Hz."""
NEEDED: Final = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
SAVE_S: Final = 300.0
"""Maximum interval in axis time between stores of a changing state."""
LEAST_CHANGE: Final = 0.01
"""Smallest relative change of the response in motion that is reported."""
UNIFORM: Final = 12.0**0.5
"""Range of a uniform distribution, relative to its standard deviation."""


NO_LOAD_ENCODER: Final = (
    "the axis has no encoder at its load: neither gear nor encoder are watched, and the model is not adapted"
)


class Follower:
    """Follows one axis and one committed model. All methods must be called from one thread."""

    def __init__(
        self,
        axis: AxisConfig,
        model: TransmissionModel,
        index: int = 0,
        settings: AdaptationSettings | None = None,
    ) -> None:
        """``index`` is the index of the axis in a sample; there is no adaptation before `adapt`."""
        self.model = model
        self.health = EncoderHealth(axis, model, index)
        self.adaptation: Adaptation | None = None
        self.updated: datetime | None = None
        """Time at which the model in use was last changed."""
        self.unwatched = NO_LOAD_ENCODER if axis.load_encoder.is_motor_encoder else ""
        """Reason for not watching gear and load encoder; empty if they are watched."""
        self._index = index
        self._settings = settings or AdaptationSettings()
        self._drift = DriftModel(model)
        motor_count = axis.motor_encoder.resolution_arcsec / axis.gear.ratio
        self._sigma_arcsec = math.hypot(motor_count, axis.load_encoder.resolution_arcsec) / UNIFORM
        """Standard deviation of an observation due to quantisation by the encoders' counts."""
        noise = max(model.held_out_arcsec or UNTESTED_ARCSEC, motor_count / UNIFORM)
        self.watch = Watch(self._drift, noise)
        self._zero = Zero(self._drift, self._sigma_arcsec)
        channels = tuple(BY_KEY[key] for key in axis.channels)
        self._servo = ServoWatch(axis, model)
        self._measuring = Measuring(self._drift, self._settings.slow_deg_s, channels)
        self._waiting: list[SampleArray] = []
        self._next_cycle: int | None = None
        self._files: AdaptationFiles | None = None
        self._saved_windows = 0
        self._saved_s = -math.inf
        self._now_s = 0.0
        self._refined_at: datetime | None = None

    def adapt(self, mode: AdaptationMode, files: AdaptationFiles | None = None) -> None:
        """Changes the mode of the adaptation, or starts it, from the state in ``files`` if any.

        Raises InputError if the settings name a parameter that the model lacks, or the axis has no encoder at
        its load, OutputError if the files cannot be written.
        """
        if self.unwatched:
            raise InputError(self.unwatched)
        if self.adaptation is None:
            settings = self._settings.model_copy(update={"mode": mode})
            learned = files.load() if files is not None else None
            self.adaptation = Adaptation(self._drift, settings, self._sigma_arcsec, learned)
            self._files = files
        else:
            self._zero.forget()
            self.adaptation.set_mode(mode)
            self.save()

    def revert(self) -> None:
        """Restores the committed model and only observes; does nothing without an adaptation."""
        if (adaptation := self.adaptation) is not None:
            self._zero.forget()
            used = adaptation.model
            adaptation.revert()
            self._changed(adaptation, used)

    def take(self, samples: SampleArray) -> list[RaisedVerdict] | None:
        """Takes the next samples of the loop, oldest first; evaluates several batches together.

        Returns the new verdicts; None if the samples are not evaluated yet.
        """
        if len(samples):
            self._waiting.append(samples)
        if sum(map(len, self._waiting)) < MIN_BATCH_SAMPLES:
            return None
        together, self._waiting = joined_samples(self._waiting), []
        status = EncoderStatus() if self.unwatched else self.health.take(together)
        return self.advance(together, status)

    def advance(self, samples: SampleArray, status: EncoderStatus) -> list[RaisedVerdict]:
        """Measures, judges and adapts with these samples; ``status`` is that of the load encoder."""
        axis: Any = samples["axes"][:, self._index]
        cycle, times_s = samples["cycle"], 1e-9 * samples["time_ns"].astype(np.float64)
        self._now_s = float(times_s[-1])
        contiguous = self._next_cycle in {None, int(cycle[0])} and int(cycle[-1] - cycle[0]) == len(cycle) - 1
        servo = self._servo.take(axis, contiguous=contiguous, encoder_trusted=status.fault is None)
        first = self._begin_of_path(axis, cycle)
        raised: list[RaisedVerdict] = []
        if servo is not None:
            verdict = Verdict.RETUNED if self._servo.retuned else self.watch.verdict
            raised.append(RaisedVerdict(verdict, servo))
        if self.unwatched:
            return raised
        axis, times_s = axis[first:], times_s[first:]
        stopped = axis["fault"] != NO_FAULT
        usable = ((axis["flags"] & NEEDED) == NEEDED) & (axis["state"] == AxisState.ENABLED) & ~stopped
        observations = self._measuring.take(times_s, axis, usable & (status.fault is None))
        if status.fault is not None:
            self._zero.forget()
        zero_fault = self._zero.take(observations)
        if zero_fault is not None:
            status = self.health.set_fault(*zero_fault)
        settled = [each for each in observations if each.settled]
        raised = [*self.watch.take(settled, status, self._zero.displacement, self._now_s), *raised]
        if self.adaptation is not None:
            fault = "the supervision has stopped the axis" if np.any(stopped) else status.reason
            adaptation, used = self.adaptation, self.adaptation.model
            adaptation.take(settled, self._now_s, fault, self._zero.rates)
            if adaptation.model is used:
                self._refine(adaptation)
            if adaptation.model is not used:
                self._changed(adaptation, used)
            elif adaptation.entries or self._now_s - self._saved_s >= SAVE_S:
                self.save()
        return raised

    def use_model(self, model: TransmissionModel) -> None:
        """Switches to another model, which the control process uses from now on."""
        self._servo.use(model.response)

    def _refine(self, adaptation: Adaptation) -> None:
        """Refines the response if due, or withdraws a refinement."""
        if adaptation.freeze_reason is not None:
            self._servo.forget_load()
        if not adaptation.may_refine:
            return
        refined = self._servo.refined(self._settings.bound_share)
        # The first refinement assumes the load of the calibration; the second knows the effect of the first.
        if self._servo.worse and (refined is None or self._servo.refinements > 1):
            adaptation.withdraw()
        elif refined is not None:
            adaptation.refine(refined)

    def state(self) -> messages.AdaptationState:
        """Returns the state of the adaptation, which has begun, for clients."""
        adaptation = self.adaptation
        assert adaptation is not None
        return messages.AdaptationState(
            mode=adaptation.mode,
            frozen=adaptation.waiting_reason(path_known=self._measuring.known),
            updated=self.updated,
            parameters=adaptation.estimated_changes(),
            response=self._refined(adaptation.model.response),
        )

    def _refined(self, used: Response | None) -> messages.RefinedResponse | None:
        """Returns the difference of the response in use from the committed one; None if less than 1 %."""
        committed = self.model.response
        if committed is None or used is None:
            return None
        hertz, change = np.array(committed.frequency_hz), change_between(committed, used)
        largest = int(np.argmax(change))
        changed = hertz[change >= LEAST_CHANGE]
        if not len(changed):
            return None
        return messages.RefinedResponse(
            date=self._refined_at, low_hz=changed[0], high_hz=changed[-1],
            percent=100.0 * change[largest], at_hz=hertz[largest],
        )  # fmt: skip

    def save(self) -> None:
        """Writes the history, and the state if it has changed."""
        adaptation = self.adaptation
        if adaptation is None or not (adaptation.entries or adaptation.windows != self._saved_windows):
            return
        entries, adaptation.entries = adaptation.entries, []
        self._saved_s, self._saved_windows = self._now_s, adaptation.windows
        if self._files is not None:
            self._files.write(entries, adaptation.learned())

    def _begin_of_path(self, axis: Any, cycle: Any) -> int:
        """Returns the first row after the last lost cycle or power loss, if any, which restarts the path."""
        driven = in_states(axis, DRIVEN)
        next_cycle = self._next_cycle if self._next_cycle is not None else int(cycle[0])
        gaps = np.diff(cycle, prepend=next_cycle - 1) != 1
        self._next_cycle = int(cycle[-1]) + 1
        interrupted = np.flatnonzero(gaps | ~driven)
        if in_states(axis, ZERO_UNKNOWN).any():
            self._zero.restart()
            if self.adaptation is not None:
                self.adaptation.invalidate_zero()
        if not len(interrupted):
            return 0
        self._measuring.restart()
        if self.adaptation is not None:
            self.adaptation.forget_window()
        last = int(interrupted[-1])
        return last if driven[last] else last + 1

    def _changed(self, adaptation: Adaptation, before: TransmissionModel) -> None:
        """Notes the time at which the model in use replaced ``before``."""
        self.updated = self._files.now() if self._files is not None else None
        if adaptation.model.response is not before.response:
            self._refined_at = self.updated
        self.save()
