"""Findings and diagnosis as plain values, and the next experiment in words.

Experiments are taken from the descriptions of the causes. Some need a person (move a mass, re-clock an
encoder). For automatic experiments see `hdbridge.commissioning.improvement.further`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Final, Self

from hdbridge.analysis.acceptance import Gate
from hdbridge.analysis.capability import Capability, Identifiability, certainty
from hdbridge.analysis.gain import Gain
from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.prepared import means
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.views import ResidualViews, coordinates
from hdbridge.axis.effects import CATALOGUE, Effect, FloatArray, IntArray, Motion, Start
from hdbridge.axis.effects.kinematics import direction_of
from hdbridge.axis.model import TransmissionModel
from hdbridge.units import figure, rounded

_UNEXPLAINED: Final = {
    "load angle": "two slow load turns both ways, then again with the load encoder re-clocked by 90 deg",
    "reversal": "nested reversals from 0.1 deg up, each beyond the last turning point, slowly",
    "motor angle": "a slow sweep over ten motor turns both ways, at two places of the load",
    "speed": "the same way at three speeds and two accelerations, with rests of a minute between",
    "torque": "the same sweep with the load's mass at two places",
    "time": "an hour of returns to one reference pose, with the temperature recorded",
}
"""Experiments for an unexplained residual, by the coordinate on which the residual depends."""


def next_experiment(cause: str, aliases: tuple[str, ...]) -> str:
    """Returns the shortest experiment that separates the cause from an alias, else one that confirms it."""
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
    """Returns the experiment for an unexplained residual that depends on the coordinate ``lives_in``."""
    return _UNEXPLAINED[depends_on(lives_in)]


def depends_on(lives_in: str) -> str:
    """Classifies a coordinate as load angle, motor angle, reversal, speed, torque or time."""
    if "load angle" in lives_in or "position" in lives_in:
        return "load angle"
    if "reversal" in lives_in or lives_in == "direction":
        return "reversal"
    if "motor angle" in lives_in or "wave generator" in lives_in:
        return "motor angle"
    if lives_in in {"speed", "acceleration"} or "stop" in lives_in:
        return "speed"
    return "torque" if "torque" in lives_in else "time"


# Diagnosis as plain values; `Diagnosis.as_dict` is the JSON document.


SCHEMA = "hdbridge.diagnosis/1"
UNEXPLAINED: Final = "unexplained"
UNWEIGHED = math.nan
"""Placeholder for a probability that has not been computed yet."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Size of the difference between measurement and model."""

    rms_arcsec: float
    three_sigma_arcsec: float

    def as_dict(self) -> dict[str, float]:
        """Returns the JSON object."""
        return {name: rounded(each) for name, each in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter with its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float
    is_size: bool = False
    """True if the parameter is a size, which is zero if the effect is absent."""

    def combined(self, middle: float, deviation: float) -> Self:
        """Combines the parameter with a normal prior, unless they differ by three standard deviations."""
        own = (self.high - self.low) / (2.0 * NORMAL_95)
        if not 0.0 < own < math.inf or abs(self.value - middle) > 3.0 * math.hypot(own, deviation):
            return self
        share = deviation**2 / (own**2 + deviation**2)
        value, half = middle + share * (self.value - middle), NORMAL_95 * own * math.sqrt(share)
        return replace(self, value=value, low=value - half, high=value + half)

    def as_dict(self) -> dict[str, Any]:
        """Returns the JSON object."""
        return {"value": self.value, "unit": self.unit, "ci95": [self.low, self.high]}


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """One cause of a difference between model and measurement."""

    cause: str
    """Name from the catalogue, or ``unexplained``."""
    probability: float
    """Probability that this cause, or one of its aliases, is present."""
    aliases: tuple[str, ...]
    """Other causes that are not separable from this cause with these data."""
    parameters: Mapping[str, Parameter]
    gain: Gain | None
    """Gain on held-out data; None without held-out data. During the search, all other parameters are refitted
    for it. In a result, it is the gain of the written model over the given model with the other findings."""
    experiment: str
    """Next measurement, in words."""
    peak_arcsec: float
    """Half the peak-to-peak contribution of the finding in this record."""
    robust: float = 0.0
    """Decrease in chi square due to the finding."""
    left_arcsec: float = 0.0
    """Rms of an unexplained residual beyond the noise."""
    left_alone: bool = False
    """True if the data do not separate a change of a model part from another cause; the part is then kept."""
    within: bool = False
    """True if the finding is a change of a part of the given model."""
    lives_in: str = ""
    """Coordinate on which an unexplained residual depends."""
    note: str = ""
    prior: str = ""
    """Description of the fleet's prior, if a fleet was given."""
    effect: Effect | None = field(default=None, repr=False)
    """Fitted effect of the finding; None for an unexplained residual."""
    gate: Gate | None = field(default=None, repr=False)
    """Acceptance tests; None for an unexplained residual."""
    terms: Mapping[str, float] = field(default_factory=dict, repr=False)
    """Values of the terms in the probability formula."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the JSON object."""
        gain = self.gain
        words = {"lives_in": self.lives_in, "note": self.note, "prior": self.prior}
        words["not_offered"] = self.refusal()
        return {
            "cause": self.cause,
            "probability": round(self.probability, 3),
            "aliases": list(self.aliases),
            "parameters": {name: each.as_dict() for name, each in self.parameters.items()},
            "gain": {
                "held_out_rms_before_arcsec": None if gain is None else rounded(gain.before_arcsec),
                "held_out_rms_after_arcsec": None if gain is None else rounded(gain.after_arcsec),
            },
            "experiment": self.experiment,
            "peak_arcsec": rounded(self.peak_arcsec),
        } | {name: each for name, each in words.items() if each}

    @property
    def gains(self) -> bool:
        """True if the written model predicts held-out data better than the given model."""
        return self.gain is not None and self.gain.predicts and not self.left_alone

    @property
    def explained_arcsec(self) -> float:
        """Rms of the held-out error that the finding accounts for; 0 without a gain."""
        return 0.0 if self.gain is None else self.gain.explained_arcsec

    @property
    def refuted(self) -> bool:
        """True if the cause does not predict held-out data."""
        return self.gain is not None and not (self.within or self.gain.predicts)

    @property
    def undetermined(self) -> bool:
        """True if the finding has a single size, whose 95 % interval includes zero, and no aliases."""
        sizes = [each for each in self.parameters.values() if each.is_size]
        return len(sizes) == 1 and not self.aliases and sizes[0].low <= 0.0 <= sizes[0].high

    def refusal(self) -> str:
        """Returns the reason why the finding is not offered as an improvement; empty if it is offered."""
        if self.cause == "unexplained":
            return "there is no law that could be held out or compensated"
        if self.left_alone:
            return "the record does not separate a change of it from " + ", ".join(self.aliases)
        if self.gain is None:
            return "nothing was held out: the record is too short to leave any of it out"
        if not self.gain.predicts:
            return (
                f"no gain on held-out data, {self.gain.before_arcsec:.3g} to {self.gain.after_arcsec:.3g} "
                "arcsec rms"
            )
        return "the 95 % interval of its size includes zero" if self.undetermined else ""


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Plot data of model and measurement on the same trajectory; arrays of equal length."""

    measured_arcsec: FloatArray
    """Measured transmission error, relative to the fitted zero offset."""
    model_arcsec: FloatArray
    """Transmission error predicted by the given model."""
    extended_arcsec: FloatArray
    motion: Motion
    """Motion of the whole record, along which the elastic state is tracked."""
    rows: IntArray
    """Indices of the points of ``motion`` to which the arrays belong."""
    start: Start
    """Elastic state at the first point of ``motion``, as fitted."""
    samples: Motion
    """Motion at each sample."""
    runs: IntArray
    """Index of the first sample of each point of ``motion``."""

    @property
    def time_s(self) -> FloatArray:
        """Record time of each point, seconds."""
        assert self.motion.time_s is not None
        return self.motion.time_s[self.rows]

    @property
    def direction(self) -> FloatArray:
        """Direction of the motor, -1 or 1; held at rest."""
        return direction_of(self.motion)[self.rows]

    def predict(self, effect: Effect) -> FloatArray:
        """Returns an effect's contribution at these points, arcsec, shape (m,)."""
        return means(effect.predict(self.samples, self.start), self.runs)[self.rows]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Difference between a model and a measurement, and the causes of the difference."""

    baseline: Figures
    """Difference between the measurement and the given model."""
    refitted: Figures
    """Difference for the given model with refitted parameters, without new causes."""
    extended: Figures
    noise_floor_arcsec: float
    findings: tuple[Finding, ...]
    visible: Callable[[], tuple[Mapping[str, Identifiability], Capability]] = field(repr=False)
    """Computes `identifiability` and `capability` on demand; this takes a third of a diagnosis's time."""
    by_kind: Mapping[str, tuple[Figures, Figures]]
    """Differences for the given and the extended model, by kind of motion and by direction."""
    remarks: tuple[str, ...]
    model: TransmissionModel = field(repr=False)
    """Extended model; the refitted one if nothing was found."""
    traces: Traces = field(repr=False)
    considered: tuple[str, ...] = ()
    """Causes that were considered but not reported, each with the reason."""
    scales: Scales = field(default_factory=Scales, repr=False)
    """Decision thresholds used in this diagnosis."""

    @cached_property
    def _visible(self) -> tuple[Mapping[str, Identifiability], Capability]:
        return self.visible()

    @property
    def identifiability(self) -> Mapping[str, Identifiability]:
        """Detection limit and aliases of each cause in this record."""
        return self._visible[0]

    @property
    def capability(self) -> Capability:
        """Summary of the causes that the record can show."""
        return self._visible[1]

    def as_dict(self) -> dict[str, Any]:
        """Returns the JSON document, schema hdbridge.diagnosis/1."""
        return {
            "schema": SCHEMA,
            "record": self.capability.as_dict(),
            "baseline": self.baseline.as_dict(),
            "refitted": self.refitted.as_dict(),
            "noise_floor_arcsec": rounded(self.noise_floor_arcsec),
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
        """Returns the residuals before and after extension, and the coordinates over which to view them."""
        traces = self.traces
        return ResidualViews(
            traces.measured_arcsec - traces.model_arcsec,
            traces.measured_arcsec - traces.extended_arcsec,
            traces.direction,
            traces.time_s,
            coordinates(traces.motion, traces.rows, self.model.ratio),
        )

    def verdict(self) -> str:
        """Returns two sentences: the causes that are detectable in the record, and the causes found."""
        return f"{self.capability.sentence()} {self._found()}"

    def _found(self) -> str:
        if not self.findings:
            return (
                f"Nothing found: the model is off by {self.baseline.rms_arcsec:.3g} arcsec rms, which noise, "
                "calibration and the unknown motion before the record can explain."
            )
        words = []
        for each in self.findings:
            others = f" (or {', '.join(each.aliases)})" if each.aliases else ""
            name = f"{certainty(each.probability)}{each.cause}{others}"
            if each.cause == UNEXPLAINED:
                name = f"{UNEXPLAINED} that depends on the {each.lives_in or 'time'}"
            words.append(f"{name}, {figure(each.peak_arcsec, 3)} arcsec")
        return (
            f"The model is off by {self.baseline.rms_arcsec:.3g} arcsec rms: {'; '.join(words)}; "
            f"extended it is off by {self.extended.rms_arcsec:.3g}."
        )
