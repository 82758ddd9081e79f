"""The partial residual of a finding: the residual without it, over the coordinate that its cause depends on.

Everything else that was found stays in the model, so what is seen is this finding alone, with the noise.
A cause that scales what the model has (ripple that grows with torque, a loop that grows with speed) is seen
as a scale over that coordinate, by least squares in each bin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.analysis.findings import Diagnosis, Finding, Traces
from hdbridge.analysis.views import coordinates
from hdbridge.effects import CATALOGUE, BoolArray, Effect, FloatArray, Part
from hdbridge.effects.coordinate import Coordinate, time
from hdbridge.model import TransmissionModel

LEAST_POINTS: Final = 200
"""Points at which a finding shows by itself that it is looked at on; with fewer, all points."""
SEEN_BINS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class Strength:
    """How strongly a part of the model has to be scaled, bin by bin; arrays of one length."""

    of: str
    """What is scaled, in words."""
    place: FloatArray
    measured_percent: FloatArray
    spread_percent: FloatArray
    """Standard deviation of the measured, noise taken for white."""
    finding_percent: FloatArray
    """The same by the finding."""


@dataclass(frozen=True, slots=True, eq=False)
class PartialResidual:
    """A finding over its coordinate; arrays of shape (m,), like those of `Traces`."""

    coordinate: Coordinate
    residual_arcsec: FloatArray
    """Measurement less the model with everything but this finding."""
    own_arcsec: FloatArray | None
    """What the finding does; None where it has no law."""
    rows: BoolArray
    """The points that show it."""
    forward: BoolArray
    """Direction, held at rest."""
    strength: Strength | None = None


def partial_residual(finding: Finding, diagnosis: Diagnosis) -> PartialResidual:
    """Draw one finding of a diagnosis."""
    traces = diagnosis.traces
    effect = _in_model(finding, diagnosis.model)
    own = None if effect is None else _does(effect, traces)
    left = traces.measured_arcsec - traces.extended_arcsec
    home = _home(finding, traces, diagnosis.model.ratio)
    rows = np.ones(len(left), dtype=np.bool_)
    stretch = None if effect is None else effect.shows(traces.motion)
    if stretch is not None and np.count_nonzero(stretch.rows[traces.rows]) >= LEAST_POINTS:
        rows = stretch.rows[traces.rows]
    residual = left if own is None else left + own
    forward = traces.direction > 0.0
    strength = _strength(effect, traces, home, residual, own)
    return PartialResidual(home, residual, own, rows, forward, strength)


def _in_model(finding: Finding, model: TransmissionModel) -> Effect | None:
    """The finding's effect as the extended model has it, so that picture and model are of one fit."""
    effect = finding.effect
    if effect is None or (finding.within and effect.changes is not Part.LOOP):
        return effect
    return effect.found_in(model.effects)


def _does(effect: Effect, traces: Traces) -> FloatArray:
    """What an effect does at the points of the traces, arcsec, shape (m,)."""
    does = traces.told(effect)
    if effect.replaces in CATALOGUE:  # it stands in the place of another one
        does = does - traces.told(CATALOGUE[effect.replaces].model_validate(effect.parameters()))
    return does


def _home(finding: Finding, traces: Traces, ratio: float) -> Coordinate:
    """The coordinate that a finding is shown over: its effect's, or what it was seen to depend on."""
    if finding.effect is not None:
        own = finding.effect.coordinate(traces.motion, ratio).at(traces.rows)
        return own if own.varies() else time(traces.motion).at(traces.rows)
    known = coordinates(traces.motion, traces.rows, ratio)
    name = finding.lives_in.removesuffix(" and direction")
    if name in known:
        apart = known[name].both_ways and ("direction" in finding.lives_in or "reversal" in name)
        return replace(known[name], both_ways=apart)
    return known["time"]


def _strength(
    effect: Effect | None, traces: Traces, home: Coordinate, residual: FloatArray, own: FloatArray | None
) -> Strength | None:
    scaled = None if effect is None else effect.scales()
    if scaled is None or own is None:
        return None
    part = traces.told(scaled[1])
    coarse = replace(home, bins=SEEN_BINS)
    number = coarse.numbers()
    square = np.bincount(number, part**2)
    size = float(np.sqrt(np.mean(part**2)))
    kept = square > 50.0 * (0.1 * size) ** 2  # bins in which the part is there at all
    noise = float(np.std(residual - own))

    def percent(y: FloatArray) -> FloatArray:
        return np.asarray(100.0 * np.bincount(number, y * part, len(square))[kept] / square[kept])

    place = np.bincount(number, coarse.values, len(square))[kept] / np.bincount(number)[kept]
    return Strength(
        scaled[0].value, place, percent(residual), 100.0 * noise / np.sqrt(square[kept]), percent(own)
    )
