"""Adaptation of one axis: the parameters of the model in use follow the load encoder.

The committed model and its version stay in use. The control process compensates with the adapted parameters,
whatever the scheme. The adaptation restarts when another model is committed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import Executor
from datetime import UTC, datetime
from pathlib import Path

from hdbridge.client import messages
from hdbridge.daemon.adaptation.proposal import Proposal
from hdbridge.daemon.adaptation.settings import AdaptationSettings
from hdbridge.daemon.adaptation.sink import AdaptationSink, followed
from hdbridge.daemon.memory import Event, SampleArray
from hdbridge.daemon.service.activity import Kind
from hdbridge.daemon.service.ports import ServiceAxis
from hdbridge.daemon.watch.encoder_health import EncoderHealth
from hdbridge.errors import HdbridgeError
from hdbridge.model import TransmissionModel

_log = logging.getLogger(__name__)


class Adapting:
    """Runs the adaptation of one axis: a sink of the observer and the bridge's `Adaptation`."""

    def __init__(
        self, place: int, axis: ServiceAxis, settings: AdaptationSettings, folder: Path, writer: Executor
    ) -> None:
        """``place`` is the axis's index in a sample, ``folder`` contains its state and history."""
        self._place, self._axis = place, axis
        self._settings, self._folder, self._writer = settings, folder, writer
        self._of: TransmissionModel | None = None
        """Committed model that is being adapted."""
        self._sink: AdaptationSink | None = None
        self._health: EncoderHealth | None = None
        self._problem = ""

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the observer; restarts if another model was committed."""
        if self._axis.models.chosen.model is not self._of:
            self._begin(self._axis.models.chosen.model)
        if self._sink is None or self._health is None:
            return
        if len(samples):
            self._health.take(samples)
        self._sink.take(samples, events, lost)

    def state(self) -> messages.AdaptationState:
        """Returns the state of the adaptation for clients."""
        if self._sink is None:
            return messages.AdaptationState(
                mode=messages.AdaptationMode(self._settings.mode), frozen=self._problem or None
            )
        return self._sink.state(0)

    async def set_mode(self, mode: messages.AdaptationMode) -> None:
        """Changes the mode."""
        self._settings = self._settings.model_copy(update={"mode": mode.value})
        if self._sink is None:
            self._of = None  # begins with the next samples
        else:
            self._sink.adapt(0, mode.value)

    async def back(self) -> None:
        """Restores the committed model and switches the adaptation to observation only."""
        if self._sink is not None:
            self._sink.back(0)
            await self.follow()

    async def follow(self) -> None:
        """Has the control process compensate with the adapted model, if it does not yet.

        Waits for the end of a job, because a job measures with one model.
        """
        if self._sink is None or self._axis.models.chosen.model is not self._of:
            return
        model = self._sink.axes[0].adaptation.model
        chosen = self._axis.models.chosen
        if model.effects == (chosen.adapted or chosen.model).effects or self._axis.motion.busy(Kind.JOB):
            return
        try:
            await self._axis.follow(model)
        except HdbridgeError as problem:  # not in this state; it is tried again
            if str(problem) != self._problem:
                _log.warning("adaptation not applied", {"axis": self._axis.name, "why": str(problem)})
            self._problem = str(problem)
        else:
            self._problem = ""
            if self._health is not None:
                self._health.use(model)
            _log.info("adaptation applied", {"axis": self._axis.name})

    def close(self) -> None:
        """Stores the adaptation's state."""
        if self._sink is not None:
            self._sink.close()

    def _begin(self, model: TransmissionModel) -> None:
        """Starts to adapt another committed model."""
        self.close()
        self._of, self._sink, self._health, self._problem = model, None, None, ""
        if self._settings.mode == "off":
            return
        config = self._axis.axis.config
        if not model.effects:
            self._problem = "there is no model to follow: calibrate first"
            return
        health = EncoderHealth(config, model, self._place)
        try:
            one = followed(
                config,
                model,
                self._settings,
                self._folder,
                lambda: datetime.now(UTC),
                lambda: health.judgement,
            )
        except HdbridgeError as problem:
            self._problem = str(problem)
            _log.warning("no adaptation", {"axis": self._axis.name, "why": str(problem)})
            return
        self._health = health
        self._sink = AdaptationSink([one], self._proposed, self._writer, first=self._place)

    def _proposed(self, _place: int, proposal: Proposal) -> None:
        told = {each.parameter: round(each.after, 4) for each in proposal.changes}
        event = "adaptation" if proposal.apply else "adaptation would change"
        _log.info(event, {"axis": self._axis.name, **told})
