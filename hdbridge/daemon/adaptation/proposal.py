"""Output of the adaptation: proposals of a changed model, and lines of its history."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hdbridge.analysis.intervals import leaves
from hdbridge.model import TransmissionModel

Entry = Mapping[str, Any]
"""Line of the history: ``event``, ``axis_time_s`` and further data, all serialisable as JSON."""
Log = Callable[[Entry], None]


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one parameter."""

    parameter: str
    """Name, such as ``hysteresis.offset_arcsec`` or ``synchronous.orders[2].phase_deg``."""
    committed: float
    before: float
    after: float


@dataclass(frozen=True, slots=True)
class Proposal:
    """Proposed model for the compensation."""

    model: TransmissionModel
    changes: tuple[Change, ...]
    apply: bool
    """False if it is only reported (``observe``)."""
    time_s: float
    """Axis time."""


def changes_between(
    committed: TransmissionModel, before: TransmissionModel, after: TransmissionModel
) -> tuple[Change, ...]:
    """Returns the parameters that differ between ``before`` and ``after``."""
    first, old, new = (_flat(each) for each in (committed, before, after))
    return tuple(
        Change(name, first.get(name, 0.0), old.get(name, 0.0), value)
        for name, value in new.items()
        if value != old.get(name, 0.0)
    )


def _flat(model: TransmissionModel) -> dict[str, float]:
    return {
        f"{each.name}.{path}": value for each in model.effects for path, value in leaves(each.parameters())
    }
