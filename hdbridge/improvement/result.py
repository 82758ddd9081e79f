"""What an improvement says, as plain values; `Improvement.as_dict` is the document for machines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hdbridge.analysis.findings import Diagnosis
from hdbridge.calibration.result import Offer
from hdbridge.improvement.extension import Extension
from hdbridge.improvement.further import Choice
from hdbridge.improvement.trial import Trial
from hdbridge.model import TransmissionModel


@dataclass(frozen=True, slots=True)
class Round:
    """A further experiment that the axis has run."""

    experiment: str
    about: str
    recording: str
    tells: tuple[str, ...]
    """What it was predicted to tell; empty where it was there already."""
    found: tuple[str, ...]
    """The findings after it, each with what it could also be."""

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return {
            "experiment": self.experiment,
            "about": self.about,
            "recording": self.recording,
            "tells": list(self.tells),
            "found": list(self.found),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Improvement:
    """Diagnosed, extended, tried out; and whether the model is offered for commit."""

    axis: str
    recordings: tuple[str, ...]
    date: str | None
    """When the first was recorded, ISO 8601."""
    plan: str
    active: TransmissionModel
    diagnosis: Diagnosis
    extension: Extension
    untold: Mapping[str, tuple[str, ...]]
    """Per cause that was found, the other causes that it has not been distinguished from."""
    rounds: tuple[Round, ...]
    further: Choice | None
    """What the axis could do by itself to learn more."""
    advice: tuple[str, ...]
    """What a person can do about what is still open."""
    trial: Trial | None
    offer: Offer
    survived: tuple[str, ...] = ()
    """A line for each file that was measured in spite of something."""

    def as_dict(self) -> dict[str, Any]:
        """The contract of ``--json``: schema ``hdbridge.improvement/1``."""
        trial = (
            self.trial.as_dict() if self.trial else {"stepping": None, "small_steps": None, "improves": None}
        )
        return {
            "schema": "hdbridge.improvement/1",
            "axis": self.axis,
            "recordings": list(self.recordings),
            "date": self.date,
            "plan": self.plan,
            "offered": self.offer.made,
            "reason": self.offer.reason,
            "pending": str(self.offer.pending) if self.offer.pending else None,
            "compensated": [each.cause for each in self.extension.carried],
            "not_compensated": list(self.extension.left),
            "not_told_from": {name: list(each) for name, each in self.untold.items()},
            "rounds": [each.as_dict() for each in self.rounds],
            "further": self.further.as_dict() if self.further else None,
            "advice": list(self.advice),
            "survived": list(self.survived),
            **trial,
            "diagnosis": self.diagnosis.as_dict(),
        }
