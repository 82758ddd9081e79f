"""Result of an improvement as plain values; `Improvement.as_dict` is the JSON document."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.result import Offer
from hdbridge.commissioning.improvement.extension import Extension
from hdbridge.commissioning.improvement.further import Choice
from hdbridge.commissioning.improvement.trial import Trial


@dataclass(frozen=True, slots=True)
class Round:
    """A further experiment that the axis has run."""

    experiment: str
    about: str
    recording: str
    separates: tuple[str, ...]
    """Alternatives that it was predicted to separate; empty if it existed already."""
    found: tuple[str, ...]
    """Findings after it, each with its alternatives."""


@dataclass(frozen=True, slots=True, eq=False)
class Improvement:
    """Result of diagnosis, extension and trial, with the decision about the offer."""

    axis: str
    recordings: tuple[str, ...]
    date: str | None
    """Date of the first recording, ISO 8601."""
    plan: str
    active: TransmissionModel
    diagnosis: Diagnosis
    extension: Extension
    unseparated: Mapping[str, tuple[str, ...]]
    """For each cause found, the other causes from which it has not been separated."""
    rounds: tuple[Round, ...]
    further: Choice | None
    """Experiment that the axis could run on its own to learn more."""
    advice: tuple[str, ...]
    """Advice to the user about open questions."""
    trial: Trial | None
    offer: Offer
    survived: tuple[str, ...] = ()
    """One line for each file that was measured despite tolerated faults."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``--json``: schema ``hdbridge.improvement/1``."""
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
            "not_told_from": {name: list(each) for name, each in self.unseparated.items()},
            "rounds": [asdict(each) for each in self.rounds],
            "further": self.further.as_dict() if self.further else None,
            "advice": list(self.advice),
            "survived": list(self.survived),
            **trial,
            "diagnosis": self.diagnosis.as_dict(),
        }
