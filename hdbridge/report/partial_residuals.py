"""Partial residual of a finding: the residual without it, over the coordinate that its cause depends on.

All other findings stay in the model, so that only this one is visible, with the noise. A cause that scales a
part of the model (ripple that grows with torque, a loop that grows with speed) is shown as a scale factor
over that coordinate, by least squares in each bin.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdbridge.analysis.findings import Diagnosis, Finding, Traces
from hdbridge.analysis.views import coordinates
from hdbridge.axis.effects import CATALOGUE, BoolArray, Effect, FloatArray, Part
from hdbridge.axis.effects.coordinate import Coordinate, time
from hdbridge.axis.model import TransmissionModel

LEAST_POINTS: Final = 200
"""Minimum number of points that show a finding alone; with fewer, all points are drawn."""
SEEN_BINS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class Strength:
    """Scale factor of a part of the model, bin by bin; arrays of one length."""

    of: str
    """Name of the scaled part."""
    place: FloatArray
    measured_percent: FloatArray
    spread_percent: FloatArray
    """Standard deviation of the measured value, for white noise."""
    finding_percent: FloatArray
    """Change of the scale factor according to the finding."""


@dataclass(frozen=True, slots=True, eq=False)
class PartialResidual:
    """A finding over its coordinate; arrays of shape (m,), like those of `Traces`."""

    coordinate: Coordinate
    residual_arcsec: FloatArray
    """Measurement minus the model with everything except this finding."""
    own_arcsec: FloatArray | None
    """Contribution of the finding; None if it has no law."""
    rows: BoolArray
    """Mask of the points that show it."""
    forward: BoolArray
    """True for forward motion, held at rest."""
    strength: Strength | None = None


def partial_residual(finding: Finding, diagnosis: Diagnosis) -> PartialResidual:
    """Computes the partial residual of one finding of a diagnosis."""
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
    """Returns the finding's effect as fitted in the extended model, so that chart and model agree."""
    effect = finding.effect
    if effect is None or (finding.within and effect.changes is not Part.LOOP):
        return effect
    return effect.found_in(model.effects)


def _does(effect: Effect, traces: Traces) -> FloatArray:
    """Returns the contribution of an effect at the points of the traces, arcsec, shape (m,)."""
    does = traces.predict(effect)
    if effect.replaces in CATALOGUE:  # it replaces another effect
        does = does - traces.predict(CATALOGUE[effect.replaces].model_validate(effect.parameters()))
    return does


def _home(finding: Finding, traces: Traces, ratio: float) -> Coordinate:
    """Returns the coordinate of a finding: its effect's, or the one that it was found to depend on."""
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
    part = traces.predict(scaled[1])
    coarse = replace(home, bins=SEEN_BINS)
    number = coarse.numbers()
    square = np.bincount(number, part**2)
    size = float(np.sqrt(np.mean(part**2)))
    kept = square > 50.0 * (0.1 * size) ** 2  # bins in which the part is present at all
    noise = float(np.std(residual - own))

    def percent(y: FloatArray) -> FloatArray:
        return np.asarray(100.0 * np.bincount(number, y * part, len(square))[kept] / square[kept])

    place = np.bincount(number, coarse.values, len(square))[kept] / np.bincount(number)[kept]
    return Strength(
        scaled[0].value, place, percent(residual), 100.0 * noise / np.sqrt(square[kept]), percent(own)
    )
