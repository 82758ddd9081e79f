"""Adaptations of a machine: a sink of the observer that makes proposals and stores their state."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hdbridge.analysis.intervals import difference, leaves
from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.client import messages
from hdbridge.daemon.adaptation.adaptation import Adaptation
from hdbridge.daemon.adaptation.keeping import Keeping, fingerprint_of
from hdbridge.daemon.adaptation.learning import Reading
from hdbridge.daemon.adaptation.proposal import Entry, Proposal
from hdbridge.daemon.adaptation.settings import AdaptationSettings, Mode, Standing
from hdbridge.daemon.watch.encoder_health import Judgement
from hdbridge.errors import OutputError
from hdbridge.model import TransmissionModel

if TYPE_CHECKING:
    from hdbridge.daemon.memory import Event, SampleArray

_log = logging.getLogger(__name__)
SAVE_S = 300.0
"""Maximum interval in axis time between stores of a changing state."""
BELIEVED = Judgement(True, "")


@dataclass(slots=True)
class Followed:
    """One axis under adaptation."""

    name: str
    adaptation: Adaptation
    keeping: Keeping
    fingerprint: str
    judgement: Callable[[], Judgement]
    """Returns the judgement of `EncoderHealth` after the same samples."""
    updated: datetime | None = None
    saved_windows: int = 0
    saved_s: float = 0.0
    entries: list[Entry] = field(default_factory=list)
    """Lines of the history that are not written yet."""


def followed(
    axis: AxisConfig,
    model: TransmissionModel,
    settings: AdaptationSettings,
    folder: Path,
    now: Callable[[], datetime],
    judgement: Callable[[], Judgement] = lambda: BELIEVED,
) -> Followed:
    """Returns an axis that continues from the state of its model in ``folder``.

    ``model`` is the whole committed model, whatever the scheme. Raises InputError if the settings name a
    parameter that it does not have, OutputError if the folder cannot be written.
    """
    keeping = Keeping(folder, axis.name, now)
    fingerprint = fingerprint_of(model, settings.parameters)
    entries: list[Entry] = []
    adaptation = Adaptation(model, settings, reading_of(axis), entries.append, keeping.load(fingerprint))
    return Followed(axis.name, adaptation, keeping, fingerprint, judgement, entries=entries)


def reading_of(axis: AxisConfig) -> Reading:
    """Returns the measuring resolution and the channels of an axis."""
    return Reading(
        axis.motor_encoder.resolution_arcsec / axis.gear.ratio,
        axis.load_encoder.resolution_arcsec,
        tuple(BY_KEY[key] for key in axis.channels),
    )


class AdaptationSink:
    """A sink of the observer. Call all methods from one thread."""

    def __init__(
        self,
        axes: Sequence[Followed],
        propose: Callable[[int, Proposal], None],
        writer: Executor | None = None,
        first: int = 0,
    ) -> None:
        """``propose`` is called with an axis's index and a proposal; it must not block.

        ``first`` is the place of the first axis in a sample; the others follow it. Without `Proposal.apply`
        a proposal is only reported. The single thread of ``writer`` writes files in order; without it they
        are written at once.
        """
        self.axes = tuple(axes)
        self.problem = ""
        """Last error of writing state or history; empty after success."""
        self._propose = propose
        self._writer = writer
        self._first = first
        self._time_s = 0.0

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples of `sample_dtype`, in order; ``lost`` samples are missing before them."""
        if lost:
            for each in self.axes:
                each.adaptation.lost_path()
        if not len(samples):
            return
        times_s = 1e-9 * samples["time_ns"].astype(np.float64)
        self._time_s = float(times_s[-1])
        for place, each in enumerate(self.axes):
            judgement = each.judgement()
            disbelieved = "" if judgement.believed else judgement.why
            proposal = each.adaptation.take(times_s, samples["axes"][:, self._first + place], disbelieved)
            if proposal is not None:
                self._tell(place, proposal)
            self._keep(each, self._time_s - each.saved_s >= SAVE_S)

    def back(self, place: int) -> Proposal:
        """Restores the committed model and only observes; also passes the proposal on."""
        proposal = self.axes[place].adaptation.back()
        self._tell(place, proposal)
        return proposal

    def adapt(self, place: int, mode: Mode) -> None:
        """Changes the mode. ``on`` ends a doubt about the load encoder."""
        each = self.axes[place]
        each.adaptation.adapt(mode)
        self._keep(each, True)

    def state(self, place: int) -> messages.AdaptationState:
        """Returns the state of the adaptation for clients."""
        each = self.axes[place]
        report = each.adaptation.report()
        return messages.AdaptationState(
            mode=messages.AdaptationMode(report.mode),
            frozen=None if report.standing in {Standing.FOLLOWING, Standing.OFF} else report.reason,
            updated=each.updated,
            parameters=_changes(each.adaptation.committed, report.estimated),
        )

    def close(self) -> None:
        """Stores the state of all axes."""
        for each in self.axes:
            self._keep(each, True)

    def _tell(self, place: int, proposal: Proposal) -> None:
        each = self.axes[place]
        if proposal.apply:
            each.updated = each.keeping.now()
        self._propose(place, proposal)
        self._keep(each, True)

    def _keep(self, each: Followed, state: bool) -> None:
        """Hand what has to be written to the writer."""
        entries, each.entries[:] = list(each.entries), []
        memory = each.adaptation.memory()
        state = state and memory.windows != each.saved_windows
        if not (entries or state):
            return
        each.saved_s, each.saved_windows = self._time_s, memory.windows

        def write() -> None:
            try:
                for entry in entries:
                    each.keeping.log(entry)
                each.keeping.save(each.fingerprint, memory)
                self.problem = ""
            except OutputError as problem:
                if not self.problem:
                    _log.warning("adaptation not kept", {"axis": each.name, "why": str(problem)})
                self.problem = str(problem)

        if self._writer is None:
            write()
        else:
            self._writer.submit(write)


def _changes(committed: TransmissionModel, estimated: TransmissionModel) -> dict[str, float]:
    names = {each.name for each in committed.effects}
    before, after = (
        {
            f"{each.name}.{path}": value
            for each in model.effects
            if each.name in names
            for path, value in leaves(each.parameters())
        }
        for model in (committed, estimated)
    )
    return {
        name: difference(name, before[name], value) for name, value in after.items() if value != before[name]
    }
