"""What of a diagnosis goes into the model that is proposed, and what it is told apart from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hdbridge.diagnose import Diagnosis, Finding
from hdbridge.effects import CATALOGUE, Channel, Effect
from hdbridge.model import TransmissionModel


@dataclass(frozen=True, slots=True, eq=False)
class Extension:
    """The extended model, and which findings the compensation makes up for."""

    model: TransmissionModel
    carried: tuple[Finding, ...]
    """Findings that the compensation makes up for."""
    left: tuple[str, ...]
    """What is found and not compensated, with the reason."""

    @property
    def improves(self) -> bool:
        """Whether every carried finding gains on data that the fit has not seen."""
        return bool(self.carried) and all(each.after_arcsec < each.before_arcsec for each in self.carried)

    def held_out(self) -> str:
        """The gains in words."""
        return "; ".join(
            f"{each.cause} {each.before_arcsec:.3g} to {each.after_arcsec:.3g} arcsec rms"
            for each in self.carried
        )


def extension_of(diagnosis: Diagnosis, active: TransmissionModel) -> Extension:
    """The diagnosis's extended model without what is tied to the time of its record.

    A lost count or the phase of a vibration says nothing of tomorrow. What is not compensated but repeats
    (orders of the load of unknown origin) stays in the model, where a person can state its origin.
    """
    known = {each.name for each in active.effects}
    kept = tuple(each for each in diagnosis.model.effects if each.name in known or not _of_its_time(each))
    names = {each.name for each in kept}
    uncertainty = {name: widths for name, widths in diagnosis.model.uncertainty.items() if name in names}
    carried = tuple(each for each in diagnosis.findings if _is_carried(each))
    left = tuple(_why_not(each) for each in diagnosis.findings if not _is_carried(each))
    return Extension(replace(diagnosis.model, effects=kept, uncertainty=uncertainty), carried, left)


def named(findings: Sequence[Finding]) -> str:
    """Causes with their look-alikes and probabilities, in words."""
    return ", ".join(f"{alternatives(each)} {each.probability:.2f}" for each in findings)


def alternatives(finding: Finding) -> str:
    """A cause and what it could also be, in words."""
    return " or ".join((finding.cause, *finding.aliases))


def _is_carried(finding: Finding) -> bool:
    if finding.cause == "unexplained":
        return False
    # A change of a part that the model has already needs no effect of its own.
    return finding.effect is None or finding.effect.is_compensable()


def _of_its_time(effect: Effect) -> bool:
    return Channel.TIME in effect.needs() and not effect.is_compensable()


def _why_not(finding: Finding) -> str:
    if finding.cause == "unexplained":
        return (
            f"unexplained, lives in the {finding.lives_in or 'time'}: no law of the catalogue to compensate"
        )
    return f"{finding.cause} is not compensated: {CATALOGUE[finding.cause].compensable.why}"
