"""What of a diagnosis goes into the model that is proposed, and what it is distinguished from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.analysis.findings import Diagnosis, Finding
from hdbridge.analysis.gain import Gain
from hdbridge.effects import CATALOGUE, Channel, Effect, Wear
from hdbridge.model import TransmissionModel
from hdbridge.units import DEG_PER_TURN


@dataclass(frozen=True, slots=True, eq=False)
class Extension:
    """The extended model, and which findings the compensation makes up for."""

    model: TransmissionModel
    carried: tuple[Finding, ...]
    """Findings that the compensation makes up for."""
    left: tuple[str, ...]
    """What is found and not compensated, with the reason."""

    refused: tuple[str, ...] = ()
    """Changes within the model that must not be offered, with the reason; they cannot be left out of it."""

    @property
    def improves(self) -> bool:
        """Whether all that the model is changed by gains on data that the fit has not seen."""
        return bool(self.carried) and not self.refused

    def gains(self) -> list[tuple[str, Gain]]:
        """Of what is carried: cause, and what it gains on held-out data."""
        return [(each.cause, each.gain) for each in self.carried if each.gain is not None]


def extension_of(
    diagnosis: Diagnosis, active: TransmissionModel, rivals: Mapping[str, Sequence[str]] | None = None
) -> Extension:
    """The diagnosis's extended model without what is tied to the time of its record.

    A lost count or the phase of a vibration says nothing of tomorrow. What is not compensated but repeats
    (orders of the load of unknown origin) stays in the model, where a person can state its origin. Wear goes
    on from the turns that the motor has run by the end of the record.
    What does not gain on held-out data, or may be nothing (`Finding.refusal`), is left out.
    ``rivals`` are the causes that each has not been distinguished from (`further.untold`): where one of
    them must not be compensated, what was found is left out too, for it may well be that one.
    """
    known = {each.name for each in active.effects}
    reasons = {id(each): _why_not(each, (rivals or {}).get(each.cause, ())) for each in diagnosis.findings}
    carried = tuple(each for each in diagnosis.findings if not reasons[id(each)])
    names = {each.cause for each in carried}
    refused = tuple(
        f"{each.cause}: {each.refusal()}" for each in diagnosis.findings if each.within and each.refusal()
    )
    doubtful = {
        each.cause
        for each in diagnosis.findings
        if each.effect is not None and (each.effect.is_compensable() or each.refusal())
    } - names
    turns = _turns_run(diagnosis)
    kept = tuple(
        each.after(turns) if isinstance(each, Wear) else each
        for each in diagnosis.model.effects
        if each.name in known or not (_of_its_time(each) or each.name in doubtful)
    )
    uncertainty = {
        name: widths
        for name, widths in diagnosis.model.uncertainty.items()
        if name in {each.name for each in kept}
    }
    left = tuple(dict.fromkeys(each for each in reasons.values() if each))
    model = replace(diagnosis.model, effects=kept, uncertainty=uncertainty)
    return Extension(model, carried, left, refused)


def named(findings: Sequence[Finding]) -> str:
    """Causes with their look-alikes and probabilities, in words."""
    return ", ".join(f"{alternatives(each)} {each.probability:.2f}" for each in findings)


def alternatives(finding: Finding) -> str:
    """A cause and what it could also be, in words."""
    return " or ".join((finding.cause, *finding.aliases))


def _turns_run(diagnosis: Diagnosis) -> float:
    """Motor turns of the record."""
    return float(np.sum(np.abs(np.diff(diagnosis.traces.motion.motor_deg)))) / DEG_PER_TURN


def _of_its_time(effect: Effect) -> bool:
    return Channel.TIME in effect.needs() and not effect.is_compensable()


def _why_not(finding: Finding, rivals: Sequence[str]) -> str:
    """Why the compensation does not make up for a finding; empty where it does."""
    if finding.cause == "unexplained":
        return (
            f"unexplained, depends on the {finding.lives_in or 'time'}: no law of the catalogue to compensate"
        )
    if refused := finding.refusal():
        return f"{finding.cause} is not offered: {refused}"
    # A change of a part that the model has already needs no effect of its own.
    if finding.effect is not None and not finding.effect.is_compensable():
        return f"{finding.cause} is not compensated: {CATALOGUE[finding.cause].compensable.why}"
    for rival in rivals:
        if not CATALOGUE[rival].compensable.possible:
            return (
                f"{finding.cause} is not compensated: not yet distinguished from {rival}, which must not "
                f"be: {CATALOGUE[rival].compensable.why}"
            )
    return ""
