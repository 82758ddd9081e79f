"""The numbers that the evidence depends on: each a prior with a unit and a source."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


def _scale(value: float, unit: str, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "source": source})


@dataclass(frozen=True, slots=True)
class Scales:
    """Priors of the model of a record, in addition to what the model file and the effects say."""

    odds: float = _scale(
        0.02, "", "share of records that have a given cause: some twenty causes, one in two records"
    )
    size_arcsec: float = _scale(
        4.0, "arcsec", "standard deviation of a cause's peak, and of something unknown: docs/causes.md"
    )
    changed: float = _scale(
        0.2, "share", "standard deviation of a part that has changed: 5-30 % of an offset"
    )
    ordinary: float = _scale(
        0.5, "share", "standard deviation, of `Effect.ordinary_arcsec`, of what every axis has"
    )
    loop_arcsec: float = _scale(
        0.05, "arcsec", "discrepancy of the loop's law, per function: a loop that obeys it"
    )
    loose_arcsec: float = _scale(0.25, "arcsec", "... and one that nearly does: 0.5 % of 40 arcsec")
    other_arcsec: float = _scale(1.0, "arcsec", "... and one that obeys another law: 2 % of 40 arcsec")
    lawless_arcsec: float = _scale(4.0, "arcsec", "... and one that has little in common with it: 10 %")
    law: float = _scale(0.05, "share", "discrepancy of a cause's law, per function of speed, time, travel")
    rough_law: float = _scale(0.2, "share", "... of one that is a rough picture of what there is")
    timing_arcsec: float = _scale(
        1.0, "arcsec", "what is not known of a sample between rest and full speed: a quarter of a cause"
    )
    wander_arcsec: float = _scale(0.15, "arcsec", "slow noise that every bench has, 2 or 20 s long")
    restless_arcsec: float = _scale(0.5, "arcsec", "... of a bench that is touched, 5 s long")
    drifting_arcsec: float = _scale(1.5, "arcsec", "... of one that warms up, 20 s long")
    tempering: float = _scale(
        0.05,
        "",
        "exponent of the evidence for a cause beside something unknown, where the likelihood is wrong",
    )

    def as_rows(self) -> list[dict[str, object]]:
        """Name, value, unit and source of each, for a result."""
        return [
            {"name": each.name, "value": getattr(self, each.name), **each.metadata} for each in fields(self)
        ]
