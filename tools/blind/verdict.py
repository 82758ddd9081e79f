"""Compares a diagnosis with the hidden causes: one verdict for each case.

Only the published JSON of ``hdbridge diagnose`` and the model that it writes are read. A cause is *named* if
its probability is above 0.5. A finding *meets* a hidden cause if it names it, or gives it as an alias. A
cause that the secret lists in ``also`` is present too: to name it is neither right nor wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from blind.case import TWINS
from blind.parameters import true_parameters

Data = Mapping[str, Any]
UNEXPLAINED = "unexplained"
MEMORY = "hysteresis_memory"
NAMED_ABOVE = 0.5
ANGLES = ("phase_deg", "centre_deg")
"""Parameters that are angles, compared modulo a turn."""
SORTS = {
    "single": "fault", "fault": "fault", "pair": "several",
    "triple": "several", "none": "healthy", "healthy_bench": "healthy", "healthy_work": "healthy",
    "other_law": "law", "law": "law", "unknown": "unknown", "outside": "unknown",
}  # fmt: skip
"""Category of each kind of case; that of a flickering pair depends on the case."""
PARTS = {
    "hysteresis_parameters": "hysteresis", MEMORY: "hysteresis", "motor_order": "synchronous",
    "motor_encoder_eccentricity": "synchronous",
}  # fmt: skip
"""Causes that may be written as a change of a part of the model."""


@dataclass(frozen=True)
class Compared:
    """Parameter of a finding with its true value."""

    cause: str
    name: str
    found: float
    low: float
    high: float
    true: float

    @property
    def error(self) -> float:
        """Relative error; of an angle, radians."""
        if self.name.endswith(ANGLES):
            return math.radians(abs(self.found - self.true))
        return abs(self.found - self.true) / max(abs(self.true), 1e-12)

    @property
    def covered(self) -> bool:
        """True if the interval contains the truth."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Answer:
    """Result of the diagnosis of a case; None and empty for absent values."""

    diagnosis: Data | None = None
    extended: Data | None = None
    """Extended model, as written."""
    fresh_given: Data | None = None
    """Diagnoses of the fresh record with the given and the written model."""
    fresh_extended: Data | None = None
    refused: bool = False
    failed: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """Evaluation of one case."""

    case: str
    kind: str
    family: str
    sort: str
    pair: str
    flicker_counts: float
    samples: int
    effect_over_noise: float | None
    """Rms of the cause's effect in the record over the noise of a reading."""
    hidden: tuple[str, ...]
    first: str
    """Kind of the leading finding: ``right``, ``wrong``, ``unexplained`` or ``nothing``."""
    first_names_it: bool
    """True if the leading name is right without an alias."""
    named: tuple[str, ...]
    met: tuple[str, ...]
    """Hidden causes that were named or given as an alias."""
    wrong: tuple[str, ...]
    """Causes named but absent."""
    ordinary: bool
    """True if a cause is named that every axis has, such as wind-up."""
    detectable: bool | None
    """True if the diagnosis reports that it would name a cause of this size in this record."""
    probabilities: tuple[tuple[float, bool], ...]
    compared: tuple[Compared, ...]
    fresh_gain: float | None
    """Rms explained by the written model in a fresh record, relative to the claim of the only finding."""
    fresh_left: float | None
    """Residual rms of the written model in a fresh record, relative to the stated one."""
    unwritten: tuple[str, ...]
    """Causes named but missing in the written model."""
    refused: bool
    failed: str
    seconds: float


def judged(secret: Data, answer: Answer, model: Data | None = None) -> Verdict:
    """Evaluates a case; ``model`` is the model given to the diagnosis."""
    causes = tuple(each["cause"] for each in secret["hidden"])
    known = tuple(each for each in causes if each != UNEXPLAINED)
    kind = secret["kind"]
    sort = SORTS.get(kind) or ("fault" if known else "healthy")
    expected = (MEMORY,) if sort == "law" else known
    also = set(secret["also"])
    findings = list((answer.diagnosis or {}).get("findings", ()))
    relevant = [each for each in findings if _meets(each, expected) or each["cause"] not in also]
    leading = [each for each in relevant if each["probability"] > NAMED_ABOVE]
    met: list[str] = []
    rights: list[tuple[Data, bool]] = []
    for each in relevant:
        if each["cause"] == UNEXPLAINED:
            continue
        new = [cause for cause in _names(each) if cause in expected and cause not in met]
        if each["probability"] > NAMED_ABOVE:
            met += new[:1]
        rights.append((each, bool(new)))
    named = [(each, right) for each, right in rights if each["probability"] > NAMED_ABOVE]
    first = leading[0] if leading else None
    effect = secret.get("effect") or {}
    fresh_gain, fresh_left = _fresh(answer, [each for each, _ in named])
    return Verdict(
        case=secret["case"],
        kind=kind,
        family=secret["family"],
        sort=sort,
        pair=secret.get("pair", ""),
        flicker_counts=secret.get("flicker_counts", 0.0),
        samples=secret["samples"],
        effect_over_noise=effect["rms_arcsec"] / secret["noise_arcsec"] if effect and causes else None,
        hidden=causes,
        first=_first(first, expected),
        first_names_it=first is not None and first["cause"] in expected,
        named=tuple(each["cause"] for each, _ in named),
        met=tuple(met),
        wrong=tuple(each["cause"] for each, right in named if not right),
        ordinary=any(
            each["cause"] in also and each not in relevant and each["probability"] > NAMED_ABOVE
            for each in findings
        ),
        detectable=_detectable(answer.diagnosis, known, secret),
        probabilities=tuple((float(each["probability"]), right) for each, right in rights),
        compared=tuple(_compared(secret, findings, model or {})),
        fresh_gain=fresh_gain,
        fresh_left=fresh_left,
        unwritten=_unwritten([each["cause"] for each, _ in named], answer.extended, model or {}),
        refused=answer.refused,
        failed=answer.failed,
        seconds=answer.seconds,
    )


def _names(finding: Data) -> list[str]:
    return [finding["cause"], *finding.get("aliases", ())]


def _meets(finding: Data, causes: Iterable[str]) -> bool:
    return any(cause in _names(finding) for cause in causes)


def _first(first: Data | None, expected: tuple[str, ...]) -> str:
    if first is None:
        return "nothing"
    if first["cause"] == UNEXPLAINED:
        return "unexplained"
    return "right" if _meets(first, expected) else "wrong"


def _detectable(diagnosis: Data | None, known: tuple[str, ...], secret: Data) -> bool | None:
    """True if the identifiability report of the cause, or of its structural twin, covers its size in this
    record.
    """
    if diagnosis is None or len(known) != 1 or not secret.get("effect"):
        return None
    # Side effects do not count as more of the cause here: a mass, for example, also winds up the spring.
    peak_arcsec = min(secret["effect"]["peak_arcsec"], secret["hidden"][0]["size_arcsec"])
    names = {known[0], *(each for twins in TWINS if known[0] in twins for each in twins)}
    reports = [diagnosis.get("identifiability", {}).get(each) for each in names]
    return any(
        each["detectable"] and (each["detection_limit_arcsec"] or 0.0) <= peak_arcsec
        for each in reports
        if each
    )


def _fresh(answer: Answer, named: list[Data]) -> tuple[float | None, float | None]:
    """Returns gain and residual of the written model on a fresh record, relative to the claimed values."""
    before, after = ((each or {}).get("baseline", {}).get("rms_arcsec") for each in (
        answer.fresh_given, answer.fresh_extended
    ))  # fmt: skip
    if answer.diagnosis is None or before is None or after is None:
        return None, None
    stated = (answer.diagnosis.get("extended") or {}).get("rms_arcsec")
    left = after / stated if stated else None
    gain = named[0].get("gain") if len(named) == 1 else None
    if not gain:
        return None, left
    claimed = _explained(gain["held_out_rms_before_arcsec"], gain["held_out_rms_after_arcsec"])
    return (_explained(before, after) / claimed if claimed else math.inf), left


def _explained(before: float, after: float) -> float:
    """Returns the rms of the explained part; noise common to both cancels."""
    return math.copysign(math.sqrt(abs(before**2 - after**2)), before - after)


def _unwritten(named: Iterable[str], extended: Data | None, model: Data) -> tuple[str, ...]:
    if extended is None:
        return ()
    given, written = ({each["effect"]: each["parameters"] for each in data.get("effects", ())} for data in (
        model, extended
    ))  # fmt: skip

    def there(cause: str) -> bool:
        part = PARTS.get(cause)
        return cause in written or (part is not None and written.get(part) != given.get(part))

    return tuple(each for each in named if not there(each))


def _compared(secret: Data, findings: list[Data], model: Data) -> Iterable[Compared]:
    """Returns the parameters with known truth in the first finding of each cause; angles modulo a turn."""
    first = {each["cause"]: each.get("parameters") or {} for each in reversed(findings)}
    for cause, parameters in first.items():
        values = {name: float(there["value"]) for name, there in parameters.items()}
        true = true_parameters(cause, values, secret, secret.get("truth", {}), model)
        for name, there in parameters.items():
            if name not in true:
                continue
            low, high = (float(each) for each in there.get("ci95") or (math.nan, math.nan))
            found, known = float(there["value"]), true[name]
            if name.endswith(ANGLES):
                known = found + math.remainder(known - found, 360.0)
            yield Compared(cause, name, found, low, high, known)
