"""Selects the findings that the proposed model compensates, and gives the reasons for leaving out others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.analysis.findings import Diagnosis, Finding
from hdbridge.analysis.gain import Gain
from hdbridge.axis.effects import CATALOGUE, Channel, Wear
from hdbridge.axis.model import TransmissionModel
from hdbridge.units import DEG_PER_TURN


@dataclass(frozen=True, slots=True, eq=False)
class Extension:
    """Extended model, and the findings that it compensates."""

    model: TransmissionModel
    carried: tuple[Finding, ...]
    """Findings that the extended model compensates."""
    left: tuple[str, ...]
    """Findings that are not compensated, each with the reason."""

    refused: tuple[str, ...] = ()
    """Changes of existing effects that must not be offered and cannot be removed, each with the reason."""

    @property
    def improves(self) -> bool:
        """True if every change of the model improves held-out predictions."""
        return bool(self.carried) and not self.refused

    def gains(self) -> list[tuple[str, Gain]]:
        """Returns the held-out gain of each compensated finding, by cause."""
        return [(each.cause, each.gain) for each in self.carried if each.gain is not None]


def extension_of(
    diagnosis: Diagnosis, active: TransmissionModel, rivals: Mapping[str, Sequence[str]] | None = None
) -> Extension:
    """Returns the diagnosis's extended model without effects that are bound to the time of its record.

    A lost count or the phase of a vibration has no predictive value. Repeatable effects that are not
    compensated (load orders of unknown origin) stay in the model, so that the user can state their origin.
    Wear continues from the motor turns at the end of the record. Findings without a gain on held-out
    data, or with some other reason for refusal (`Finding.refusal`), are left out.

    ``rivals`` lists, for each finding, the causes from which it is not separated (`further.unseparated`). If
    one of these must not be compensated, the finding is left out too.
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
    turns = float(np.sum(np.abs(np.diff(diagnosis.traces.motion.motor_deg)))) / DEG_PER_TURN
    kept = tuple(
        each.after(turns) if isinstance(each, Wear) else each
        for each in diagnosis.model.effects
        if each.name in known
        or not (each.name in doubtful or (Channel.TIME in each.needs() and not each.is_compensable()))
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
    """Returns the causes of findings with their aliases and probabilities, as text."""
    return ", ".join(f"{alternatives(each)} {each.probability:.2f}" for each in findings)


def alternatives(finding: Finding) -> str:
    """Returns the cause of a finding with its aliases, as text."""
    return " or ".join((finding.cause, *finding.aliases))


def _why_not(finding: Finding, rivals: Sequence[str]) -> str:
    """Returns the reason for not compensating a finding; empty if the finding is compensated."""
    if finding.cause == "unexplained":
        return (
            f"unexplained, depends on the {finding.lives_in or 'time'}: no law of the catalogue to compensate"
        )
    if refused := finding.refusal():
        return f"{finding.cause} is not offered: {refused}"
    # A change of an existing part of the model needs no effect of its own.
    if finding.effect is not None and not finding.effect.is_compensable():
        return f"{finding.cause} is not compensated: {CATALOGUE[finding.cause].compensable.why}"
    for rival in rivals:
        if not CATALOGUE[rival].compensable.possible:
            return (
                f"{finding.cause} is not compensated: not yet separated from {rival}, which must not "
                f"be: {CATALOGUE[rival].compensable.why}"
            )
    return ""
