"""Priors of a fit from the calibration of a model: each part is either as calibrated or has changed.

A part is a group of parameters that change together: a loop, one order, a spring. As calibrated, its
parameters are normally distributed about those of the model file, with the 95 % intervals given there or,
without any, by `Scales.calibrated`. A part becomes free if the data strain it by more than the cost of a
change. The model thus keeps its calibration if the data cannot separate a changed part from a new cause, and
a changed loop is still found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.linear import Prior
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.separable import on_scale, shape_value
from hdbridge.axis.effects import Effect, FloatArray

EXACT: Final = 1e-3
"""Share of the calibrated standard deviation that is practically zero."""


@dataclass(frozen=True, slots=True)
class CalibratedPart:
    """Parameters of one effect that change together, with their calibrated values."""

    place: int
    """Place of the effect in the model."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and standard deviation, by index of the coefficient or name of the shape (of its logarithm if
    logarithmic)."""
    scales: Scales
    fixed: bool = False
    """True if the part cannot have changed."""

    @property
    def change_cost(self) -> float:
        """Penalty in chi square for a change of the part."""
        if self.fixed:
            return math.inf
        return self.scales.enter + self.scales.penalty * len(self.parameters)

    def as_given(self) -> CalibratedPart:
        """Returns the part fixed exactly at the values of the model file."""
        exact = {name: (mean, EXACT * deviation) for name, (mean, deviation) in self.parameters.items()}
        return replace(self, parameters=exact, fixed=True)

    def strain(self, effects: Sequence[Effect], spread: FloatArray | None = None) -> float:
        """Returns the chi square of the part's deviation from its calibration.

        ``spread`` (p, p) is the covariance of the parameters of ``effects``; None treats them as exact.
        """
        effect = effects[self.place]
        coefficients = effect.coefficients()
        shapes = {each.name: each for each in effect.shape}
        off, variance = np.empty(len(self.parameters)), np.empty(len(self.parameters))
        for at, (name, (mean, deviation)) in enumerate(self.parameters.items()):
            shape = shapes.get(name)
            value = on_scale(effect, shape) if shape else float(coefficients[int(name)])
            off[at], variance[at] = value - mean, deviation**2
        if spread is None:
            return float(np.sum(off**2 / variance))
        return float(off @ np.linalg.solve(np.diag(variance) + spread, off))

    def times(self, share: float) -> CalibratedPart:
        """Returns the part with its visibility reduced to ``share``."""
        seen = {name: (share * mean, deviation) for name, (mean, deviation) in self.parameters.items()}
        return replace(self, parameters=seen)


def calibrated(
    effects: Sequence[Effect],
    half_widths: Mapping[str, Mapping[str, Any]],
    columns: Callable[[Effect], FloatArray],
    scales: Scales,
) -> tuple[CalibratedPart, ...]:
    """Returns the parts of a model with its 95 % half widths.

    ``columns`` returns the columns of an effect in the record, (m, p).
    """
    return tuple(
        CalibratedPart(place, parameters, scales)
        for place, effect in enumerate(effects)
        for parameters in _parts(effect, half_widths.get(effect.name, {}), columns(effect), scales)
    )


def variances(parts: Sequence[CalibratedPart], place: int, columns: Iterable[int]) -> FloatArray:
    """Returns the calibrated variances of some coefficients, shape (n,); 0 without a calibration."""
    own = {name: each for part in parts if part.place == place for name, each in part.parameters.items()}
    return np.array([own.get(str(each), (0.0, 0.0))[1] ** 2 for each in columns])


def priors(parts: Sequence[CalibratedPart]) -> dict[tuple[int, str], Prior]:
    """Returns the priors of the parameters of some parts."""
    return {
        (part.place, name): Prior(mean, deviation**-2)
        for part in parts
        for name, (mean, deviation) in part.parameters.items()
    }


def _parts(
    effect: Effect, halves: Mapping[str, Any], columns: FloatArray, scales: Scales
) -> Iterator[dict[str, tuple[float, float]]]:
    peaks = np.max(np.abs(columns), axis=0, initial=0.0)
    # Parameters that the record does not show stay unchanged.
    least = np.where(peaks > 0.0, scales.calibrated_arcsec / np.maximum(peaks, 1e-12), 0.0)
    values = effect.coefficients()
    named = effect.named_coefficients()
    waves = [each for each in named if len(each.columns) > 1]
    known = {each["order"]: each for each in halves.get("orders", ())}
    given = effect.parameters()
    for wave in waves:
        number = given["orders"][wave.path[1]]["order"] if known else 0
        size = float(np.linalg.norm(values[list(wave.columns)]))
        wide = _of_order(size, known.get(number), scales.calibrated)
        yield {str(i): (float(values[i]), math.hypot(wide, float(least[i]))) for i in wave.columns}
    if waves:
        return
    names = [each.name for each in named]
    result: dict[str, tuple[float, float]] = {}
    for at, (name, value) in enumerate(zip(names, values.tolist(), strict=True)):
        wide = _width(halves.get(name), scales.calibrated * abs(value))
        result[str(at)] = value, max(math.hypot(wide, float(least[at])), 1e-9)
    for shape in effect.shape:
        value = shape_value(effect, shape.name)
        size = value - 1.0 if shape.name == "exponent" else value
        wide = max(
            _width(halves.get(shape.name), scales.calibrated_shape * abs(size)), 1e-3 * abs(size), 1e-9
        )
        result[shape.name] = (math.log(value), wide / value) if shape.logarithmic else (value, wide)
    if result:
        yield result


def _width(half: object, otherwise: float) -> float:
    return float(half) / NORMAL_95 if isinstance(half, int | float) else otherwise


def _of_order(amplitude_arcsec: float, halves: Mapping[str, Any] | None, share: float) -> float:
    """Returns the standard deviation of cosine and sine from the half widths of amplitude and phase."""
    if halves is None:
        return share * amplitude_arcsec
    turn = math.radians(float(halves.get("phase_deg", 0.0))) * amplitude_arcsec
    return math.hypot(float(halves.get("amplitude_arcsec", 0.0)), turn) / math.sqrt(2.0) / NORMAL_95
