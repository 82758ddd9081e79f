"""Compares what a diagnosis says with what was hidden: one verdict by case, then the figures of a suite.

Only the published JSON of ``hdbridge diagnose`` is read. A finding *meets* a hidden cause when it names it,
or gives it as an alias. What hidden.yaml calls ``also`` is really there too: to name it is neither right nor
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from blindtruth import true_parameters

Data = Mapping[str, Any]
UNEXPLAINED = "unexplained"
ANGLES = ("phase_deg", "centre_deg")
"""Parameters that are angles, full turns apart the same."""


@dataclass(frozen=True)
class Compared:
    """A parameter that is in both: the finding's and the truth's."""

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
        """Whether the interval has the truth in it."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Verdict:
    """One case judged."""

    case: str
    kind: str
    over_noise: float | None
    hidden: tuple[str, ...]
    named: tuple[str, ...]
    """Causes named, most important first; not those that are there anyway."""
    met: tuple[str, ...]
    """Hidden causes that were named or given as an alias."""
    first_is_right: bool
    first_names_it: bool
    """Right without the help of an alias."""
    wrong: tuple[str, ...]
    """Named, but not there."""
    unexplained: bool
    unexplained_leads: bool
    seconds: float
    samples: int
    probabilities: tuple[tuple[float, bool], ...] = ()
    compared: tuple[Compared, ...] = ()
    recovered: float | None = None
    rms_over_noise: float | None = None
    """What the extended model leaves, over the noise floor that the diagnosis states."""
    failed: str = ""
    law: str = ""


def judged(
    hidden: Data,
    diagnosis: Data | None,
    seconds: float,
    failed: str = "",
    truth: Data | None = None,
    model: Data | None = None,
) -> Verdict:
    """The verdict on a case; ``diagnosis`` is None where the command failed.

    ``truth`` and ``model`` are truth.yaml and model.yaml; without them fewer parameters are compared.
    """
    causes = tuple(each["cause"] for each in hidden["hidden"])
    known = tuple(each for each in causes if each != UNEXPLAINED)
    also = set(hidden["also"])
    findings = list((diagnosis or {}).get("findings", ()))
    relevant = [each for each in findings if _meets(each, known) or each["cause"] not in also]
    named = [each for each in relevant if each["cause"] != UNEXPLAINED]
    met: list[str] = []
    wrong: list[str] = []
    right: list[bool] = []
    for each in named:
        new = [cause for cause in _names(each) if cause in known and cause not in met]
        met += new[:1]
        right.append(bool(new))
        if not new:
            wrong.append(each["cause"])
    first = named[0] if named and relevant[0] is named[0] else None
    return Verdict(
        case=hidden["case"],
        kind=hidden["kind"],
        over_noise=hidden.get("over_noise"),
        hidden=causes,
        named=tuple(each["cause"] for each in named),
        met=tuple(met),
        first_is_right=first is not None and _meets(first, known),
        first_names_it=first is not None and first["cause"] in known,
        wrong=tuple(wrong),
        unexplained=any(each["cause"] == UNEXPLAINED for each in findings),
        unexplained_leads=bool(relevant) and relevant[0]["cause"] == UNEXPLAINED,
        seconds=seconds,
        samples=int(hidden["samples"]),
        probabilities=tuple(
            (float(each["probability"]), hit) for each, hit in zip(named, right, strict=True)
        ),
        compared=tuple(_compared(hidden, findings, truth or {}, model or {})),
        recovered=_recovered(hidden, named, known, _floor(hidden, diagnosis)),
        rms_over_noise=_left(diagnosis, _floor(hidden, diagnosis)),
        failed=failed,
        law=str(hidden.get("law", "")),
    )


def _names(finding: Data) -> list[str]:
    return [finding["cause"], *finding.get("aliases", ())]


def _meets(finding: Data, causes: Iterable[str]) -> bool:
    return any(cause in _names(finding) for cause in causes)


def _floor(hidden: Data, diagnosis: Data | None) -> float:
    """The noise floor as the diagnosis has it (it may work on means of samples), else that of a reading."""
    return float((diagnosis or {}).get("noise_floor_arcsec") or hidden["noise_arcsec"])


def _recovered(hidden: Data, named: list[Data], known: tuple[str, ...], floor_arcsec: float) -> float | None:
    """Share of the explainable variance on held-out data that a single right finding takes away."""
    if len(hidden["hidden"]) != 1 or not named or not _meets(named[0], known):
        return None
    gain = named[0].get("gain") or {}
    before = gain.get("held_out_rms_before_arcsec")
    after = gain.get("held_out_rms_after_arcsec")
    floor = min(floor_arcsec, float(after or 0.0))
    if before is None or after is None or before**2 - floor**2 <= 0.0:
        return None
    return float((before**2 - after**2) / (before**2 - floor**2))


def _left(diagnosis: Data | None, floor_arcsec: float) -> float | None:
    left = ((diagnosis or {}).get("extended") or {}).get("rms_arcsec")
    return None if left is None else float(left) / floor_arcsec


def _compared(hidden: Data, findings: list[Data], truth: Data, model: Data) -> Iterable[Compared]:
    """Every parameter of which the truth is known, in the first finding of each cause; angles to a turn."""
    first = {each["cause"]: each.get("parameters") or {} for each in reversed(findings)}
    for cause, parameters in first.items():
        values = {name: float(there["value"]) for name, there in parameters.items()}
        true = true_parameters(cause, values, hidden, truth, model)
        for name, there in parameters.items():
            if name not in true:
                continue
            low, high = (float(each) for each in there.get("ci95") or (math.nan, math.nan))
            found, known = float(there["value"]), true[name]
            if name.endswith(ANGLES):
                known = found + math.remainder(known - found, 360.0)
            yield Compared(cause, name, found, low, high, known)
