"""Following in the service: passes samples to a thread per axis, and uses the verdicts and adapted models.

The committed model and its version stay in use. The control process compensates with the adapted parameters,
whatever the scheme. Watch and adaptation restart when another model is committed.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from hdbridge.axis.model import TransmissionModel
from hdbridge.client import messages
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.judging import WINDOW_S, RaisedVerdict, Verdict
from hdbridge.daemon.following.statefile import AdaptationFiles
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.recorder.autodiagnosis import AutoDiagnosis
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.enums import AdaptationMode
from hdbridge.errors import HdbridgeError

MAX_BATCHES: Final = 500
"""Maximum number of batches waiting for the thread (ten seconds). Later batches are dropped."""
DIAGNOSED: Final = frozenset({Verdict.RECALIBRATE, Verdict.SOMETHING_CHANGED})
"""Verdicts that start a diagnosis."""
_log = logging.getLogger(__name__)


class Following:
    """Follows one axis: a sink of `Core` that never blocks."""

    def __init__(
        self,
        axis: ServiceAxis,
        settings: AdaptationSettings,
        folder: Path,
        worker: Executor,
        diagnosis: AutoDiagnosis | None = None,
    ) -> None:
        """``folder`` contains the files of the adaptation.

        ``worker`` has one thread. The verdicts in `DIAGNOSED` start ``diagnosis``.
        """
        self.state = messages.AdaptationState(mode=settings.mode)
        """State of the adaptation."""
        self._axis = axis
        self._settings, self._folder = settings, folder
        self._worker, self._diagnosis = worker, diagnosis
        self._model = self._used = axis.models.chosen.model
        """Committed model that is followed, and the model that the control process uses, adapted or not."""
        self._sent = self._taken = 0
        # From here on, these belong to the worker's thread.
        self._problem = ""
        self._follow(self._model)
        self._do(self._adapt)

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples from the service's core. Lost samples appear as a gap in the cycle numbers."""
        models = self._axis.models
        if models.chosen.model is not self._model:
            self._model = self._used = models.chosen.model
            self._do(self._begin, self._model)
        self._choose()
        used = models.in_use.adapted or models.in_use.model
        if used is not self._used and models.in_use.model is self._model:
            self._used = used
            self._do(self._use, used)
        if len(samples) and self._sent - self._taken < MAX_BATCHES:
            self._sent += 1
            self._do(self._process, samples)

    async def set_mode(self, mode: AdaptationMode) -> None:
        """Changes the mode of the adaptation."""
        self._settings = self._settings.model_copy(update={"mode": mode})
        await asyncio.wrap_future(self._do(self._adapt))

    async def revert(self) -> None:
        """Restores the committed model and switches the adaptation to observation only."""
        await asyncio.wrap_future(self._do(self._revert))
        self._choose()
        with suppress(HdbridgeError):  # repeated by the axis
            await self._axis.settle()

    def _choose(self) -> None:
        """Chooses the adapted model, which the axis then sends to the control process."""
        models, follower = self._axis.models, self._follower
        chosen = models.chosen
        if follower.adaptation is None or chosen.model is not follower.model:
            return
        model = follower.adaptation.model
        used = chosen.adapted or chosen.model
        if (model.effects, model.response) != (used.effects, used.response):
            models.chosen = replace(chosen, adapted=model)

    def close(self) -> None:
        """Stores the adaptation's state, after processing the waiting samples."""
        self._do(self._save).result()

    def _do(self, function: Callable[..., None], *args: object) -> Future[None]:
        done = self._worker.submit(function, *args)
        done.add_done_callback(_log_failure)
        return done

    # ------------------------------------------------------------------ in the worker's thread

    def _begin(self, model: TransmissionModel) -> None:
        """Starts to follow another committed model."""
        self._follower.save()
        self._follow(model)
        self._adapt()

    def _follow(self, model: TransmissionModel) -> None:
        self._follower = Follower(self._axis.axis.config, model, self._axis.link.index, self._settings)
        self.advice = self._unwatched()
        """Current verdict of the watch unless the model is valid; the reason if the axis is not watched."""

    def _adapt(self) -> None:
        """Starts the adaptation, or changes its mode, according to the settings."""
        follower, settings = self._follower, self._settings
        self._problem = ""
        if follower.adaptation is None and settings.mode == "off":
            pass
        elif not follower.model.effects:
            self._problem = "there is no model to follow: calibrate first"
        else:
            try:
                files = None
                if follower.adaptation is None:
                    files = AdaptationFiles(
                        self._folder, self._axis.name, follower.model, settings.parameters
                    )
                follower.adapt(settings.mode, files)
            except HdbridgeError as problem:
                self._problem = str(problem)
                _log.warning("no adaptation", {"axis": self._axis.name, "why": str(problem)})
        self._publish()

    def _process(self, samples: SampleArray) -> None:
        try:
            follower = self._follower
            if (raised := follower.take(samples)) is not None:
                self._report(raised, follower.model)
                self._publish()
        finally:
            self._taken += 1

    def _revert(self) -> None:
        self._follower.revert()
        self._publish()

    def _use(self, model: TransmissionModel) -> None:
        self._follower.use_model(model)

    def _save(self) -> None:
        self._follower.save()

    def _publish(self) -> None:
        follower = self._follower
        if follower.adaptation is not None:
            self.state = follower.state()
        else:
            self.state = messages.AdaptationState(mode=self._settings.mode, frozen=self._problem or None)

    def _report(self, raised: Sequence[RaisedVerdict], model: TransmissionModel) -> None:
        """Notes, logs and diagnoses verdicts."""
        for each in raised:
            verdict = [] if each.verdict is Verdict.HOLDS else [each.text]
            self.advice = verdict + self._unwatched()
            self._note("WATCH", each.text)
            if self._diagnosis is not None and each.verdict in DIAGNOSED:
                report = partial(self._note, "DIAGNOSIS")
                self._diagnosis.start(self._axis.name, model.dump(), WINDOW_S / 60.0, each.text, report)

    def _unwatched(self) -> list[str]:
        return [self._follower.unwatched] if self._follower.unwatched else []

    def _note(self, kind: str, text: str) -> None:
        self._axis.core.log.note(text, self._axis.link.index, kind)
        _log.warning("watch", {"axis": self._axis.name, "text": text})


def _log_failure(done: Future[Any]) -> None:
    if not done.cancelled() and (problem := done.exception()) is not None:
        _log.error("following failed; it continues", exc_info=problem)
