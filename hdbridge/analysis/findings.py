"""The next experiment in words: what would separate what the data leave open.

As the causes have it, also what only a person can do (move a mass, re-clock an encoder). What the axis can do
by itself: `hdbridge.improvement.experiments`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from hdbridge.analysis.acceptance import Gate
from hdbridge.analysis.gain import Gain
from hdbridge.analysis.prepared import means
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.views import ResidualViews, coordinates
from hdbridge.effects import CATALOGUE, Effect, FloatArray, IntArray, Motion, Start
from hdbridge.effects.kinematics import direction_of
from hdbridge.model import TransmissionModel

_UNEXPLAINED: Final = {
    "load angle": "two slow load turns both ways, then again with the load encoder re-clocked by 90 deg",
    "reversal": "nested reversals from 0.1 deg up, each beyond where the last one turned, slowly",
    "motor angle": "a slow sweep over ten motor turns both ways, at two places of the load",
    "speed": "the same way at three speeds and two accelerations, with rests of a minute between",
    "torque": "the same sweep with the load's mass at two places",
    "time": "an hour of returns to one reference pose, with the temperature recorded",
}
"""By what it depends on."""


def next_experiment(cause: str, aliases: tuple[str, ...]) -> str:
    """The shortest experiment that distinguishes the cause from its aliases; without aliases, the one that
    confirms it.
    """
    either = [pair for each in aliases for pair in ((cause, each), (each, cause))]
    known = [
        CATALOGUE[one].about.apart[other]
        for one, other in either
        if one in CATALOGUE and other in CATALOGUE[one].about.apart
    ]
    if known:
        return min(known).words
    return CATALOGUE[cause].about.experiment if cause in CATALOGUE else ""


def for_unexplained(lives_in: str) -> str:
    """How to look closer at something unexplained."""
    return _UNEXPLAINED[depends_on(lives_in)]


def depends_on(lives_in: str) -> str:
    """Which of load angle, motor angle, reversal, speed, torque and time a coordinate is one of."""
    if "load angle" in lives_in or "position" in lives_in:
        return "load angle"
    if "reversal" in lives_in or lives_in == "direction":
        return "reversal"
    if "motor angle" in lives_in or "wave generator" in lives_in:
        return "motor angle"
    if lives_in in {"speed", "acceleration"} or "stop" in lives_in:
        return "speed"
    return "torque" if "torque" in lives_in else "time"


# What a diagnosis says, as plain values; `Diagnosis.as_dict` is the document for machines.


SCHEMA = "hdbridge.diagnosis/1"
UNWEIGHED = math.nan
"""The probability of a finding that is not weighed against the others yet."""


@dataclass(frozen=True, slots=True)
class Figures:
    """How far measurement and model are apart."""

    rms_arcsec: float
    three_sigma_arcsec: float

    def as_dict(self) -> dict[str, float]:
        """For machines."""
        return {name: _round(each) for name, each in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter with its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float
    is_size: bool = False
    """Whether it says how large something is: at zero nothing would be there."""

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return {"value": self.value, "unit": self.unit, "ci95": [self.low, self.high]}


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """One thing that the model gets wrong."""

    cause: str
    """A name of the catalogue, or ``unexplained``."""
    probability: float
    """That this cause, or one of its aliases, is there."""
    aliases: tuple[str, ...]
    """Other causes that these data cannot distinguish from it."""
    parameters: Mapping[str, Parameter]
    gain: Gain | None
    """On held-out data, everything else refitted; None where nothing was held out."""
    experiment: str
    """What to measure next, in words."""
    peak_arcsec: float
    """Half the span of what it does in this record."""
    robust: float = 0.0
    """Chi square that it takes away; of a change within the model that of the change itself."""
    left_arcsec: float = 0.0
    """Of something unexplained: root mean square that is left beyond the noise."""
    taken_arcsec: float = 0.0
    """Of a changed loop: root mean square that it takes away in the fit itself, near the reversals."""
    left_alone: bool = False
    """Whether it may be a change of a part of the model or another cause: the model keeps its own."""
    lives_in: str = ""
    """Of something unexplained: the coordinate over which it shows."""
    note: str = ""
    effect: Effect | None = field(default=None, repr=False)
    """As it goes into the model."""
    gate: Gate | None = field(default=None, repr=False)
    """What speaks for it; of a change within the model none."""
    terms: Mapping[str, float] = field(default_factory=dict, repr=False)
    """The terms of the formula of its probability."""

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        gain = self.gain
        words = {"lives_in": self.lives_in, "note": self.note, "not_offered": self.refusal()}
        return {
            "cause": self.cause,
            "probability": round(self.probability, 3),
            "aliases": list(self.aliases),
            "parameters": {name: each.as_dict() for name, each in self.parameters.items()},
            "gain": {
                "held_out_rms_before_arcsec": None if gain is None else _round(gain.before_arcsec),
                "held_out_rms_after_arcsec": None if gain is None else _round(gain.after_arcsec),
            },
            "experiment": self.experiment,
            "peak_arcsec": _round(self.peak_arcsec),
        } | {name: each for name, each in words.items() if each}

    @property
    def within(self) -> bool:
        """Whether it is a change of a part that the model has already."""
        return self.gate is None and self.cause != "unexplained"

    def refusal(self) -> str:
        """Why it is not offered as an improvement of the model, in words; empty where nothing is against."""
        if self.cause == "unexplained":
            return "there is no law that could be held out or compensated"
        if self.left_alone:
            return "the record does not distinguish a change of it from " + ", ".join(self.aliases)
        if self.gain is None:
            return "nothing was held out: the record is too short to leave any of it out"
        if self.gain.recovered <= 0.0:
            return (
                f"no gain on held-out data, {self.gain.before_arcsec:.3g} to {self.gain.after_arcsec:.3g} "
                "arcsec rms"
            )
        sizes = [each for each in self.parameters.values() if each.is_size]
        if sizes and not self.aliases and all(each.low <= 0.0 <= each.high for each in sizes):
            return "zero is in the 95 % interval of everything that says how large it is"
        return ""


@dataclass(frozen=True, slots=True)
class Identifiability:
    """What this record could say about a cause."""

    detectable: bool
    detection_limit_arcsec: float | None
    """Smallest peak that would be named; None where nothing of it can be seen."""
    aliases: tuple[str, ...]
    """Causes that it could not be distinguished from in this record."""
    share_left: float
    """Share of its square that the baseline does not take over."""
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        limit = self.detection_limit_arcsec
        data: dict[str, Any] = {
            **asdict(self),
            "detection_limit_arcsec": None if limit is None else _round(limit),
            "aliases": list(self.aliases),
            "share_left": float(f"{self.share_left:.3g}"),
        }
        return {name: each for name, each in data.items() if name != "reason" or each}


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Arrays for pictures, one length: model next to measurement on the same trajectory."""

    measured_arcsec: FloatArray
    """About the zero of the fit."""
    model_arcsec: FloatArray
    """The model as it was given."""
    extended_arcsec: FloatArray
    motion: Motion
    """What drove the whole record; an elastic state passes through all of it."""
    rows: IntArray
    """Which points of ``motion`` these arrays are of."""
    start: Start
    """Elastic state at the first point of ``motion``, as fitted."""
    samples: Motion
    """The same at every sample."""
    runs: IntArray
    """First sample of each point of ``motion``."""

    @property
    def time_s(self) -> FloatArray:
        """Of the record's clock."""
        assert self.motion.time_s is not None
        return self.motion.time_s[self.rows]

    @property
    def direction(self) -> FloatArray:
        """Of the motor, -1 or 1, held at rest."""
        return direction_of(self.motion)[self.rows]

    def told(self, effect: Effect) -> FloatArray:
        """What an effect does at these points, arcsec, shape (m,)."""
        return means(effect.predict(self.samples, self.start), self.runs)[self.rows]


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """How a model differs from a measurement, and why."""

    baseline: Figures
    """Of the model as it was given."""
    refitted: Figures
    """Of the model with its own parameters fitted anew, but no new cause."""
    extended: Figures
    noise_floor_arcsec: float
    findings: tuple[Finding, ...]
    identifiability: Mapping[str, Identifiability]
    by_kind: Mapping[str, tuple[Figures, Figures]]
    """Per kind of motion and per direction: as given, and extended."""
    remarks: tuple[str, ...]
    model: TransmissionModel = field(repr=False)
    """The extended model; the refitted one where nothing was found."""
    traces: Traces = field(repr=False)
    considered: tuple[str, ...] = ()
    """What was taken into account and not named, with the reason."""
    scales: Scales = field(default_factory=Scales, repr=False)
    """The numbers that decided."""

    def as_dict(self) -> dict[str, Any]:
        """The document for machines, schema hdbridge.diagnosis/1."""
        return {
            "schema": SCHEMA,
            "baseline": self.baseline.as_dict(),
            "refitted": self.refitted.as_dict(),
            "noise_floor_arcsec": _round(self.noise_floor_arcsec),
            "findings": [each.as_dict() for each in self.findings],
            "identifiability": {name: each.as_dict() for name, each in self.identifiability.items()},
            "extended": self.extended.as_dict(),
            "by_kind": {
                name: {"baseline": one.as_dict(), "extended": other.as_dict()}
                for name, (one, other) in self.by_kind.items()
            },
            "remarks": list(self.remarks),
            "considered": list(self.considered),
            "scales": self.scales.described(),
            "seen_over": {
                name: {"share_of_baseline": round(before, 4), "share_of_extended": round(after, 4)}
                for name, (before, after) in self.views().shares().items()
            },
        }

    def views(self) -> ResidualViews:
        """Its residuals, and what they can be looked at over."""
        traces = self.traces
        return ResidualViews(
            traces.measured_arcsec - traces.model_arcsec,
            traces.measured_arcsec - traces.extended_arcsec,
            traces.direction,
            traces.time_s,
            coordinates(traces.motion, traces.rows, self.model.ratio),
        )

    def verdict(self) -> str:
        """One sentence."""
        if not self.findings:
            return (
                "Nothing found: the model differs from the measurement by no more than noise and calibration."
            )
        words = []
        for each in self.findings:
            others = f" (or {', '.join(each.aliases)})" if each.aliases else ""
            where = f" that depends on the {each.lives_in or 'time'}" if each.cause == "unexplained" else ""
            words.append(f"{each.cause}{others}{where}, {each.peak_arcsec:.2g} arcsec")
        return (
            f"The model is off by {self.baseline.rms_arcsec:.3g} arcsec rms: {'; '.join(words)}; "
            f"extended it is off by {self.extended.rms_arcsec:.3g}."
        )


def _round(value: float) -> float:
    return float(f"{value:.5g}")
