"""Derives the priors of a fit from the calibration of a model. Each part is unchanged or has changed.

A part is a group of parameters that change together: a loop, one order, a spring. The parameters of an
unchanged part are normally distributed about the values of the model file. Their 95 % intervals are those of
the file or, if it has none, follow from `Scales.calibrated`. A part becomes free if its deviation from the
calibration (`CalibratedPart.strain`) exceeds the cost of a change. The model thus keeps its calibration if
the data cannot separate a changed part from a new cause, but a changed loop is still found.
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
"""Factor that reduces the calibrated standard deviation to practically zero."""


@dataclass(frozen=True, slots=True)
class CalibratedPart:
    """Parameters of one effect that change together, with their calibrated values."""

    place: int
    """Index of the effect in the model."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and standard deviation of each parameter. The key is the index of a coefficient or the name of a
    shape parameter. A logarithmic shape parameter is given by its logarithm."""
    scales: Scales
    fixed: bool = False
    """True if a change of the part is ruled out."""

    @property
    def change_cost(self) -> float:
        """Chi-square penalty for a change of the part."""
        if self.fixed:
            return math.inf
        return self.scales.enter + self.scales.penalty * len(self.parameters)

    def as_given(self) -> CalibratedPart:
        """Returns the part fixed at the values of the model file."""
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
        """Returns the part with its mean values multiplied by ``share``, the visible fraction."""
        seen = {name: (share * mean, deviation) for name, (mean, deviation) in self.parameters.items()}
        return replace(self, parameters=seen)


def calibrated(
    effects: Sequence[Effect],
    half_widths: Mapping[str, Mapping[str, Any]],
    columns: Callable[[Effect], FloatArray],
    scales: Scales,
) -> tuple[CalibratedPart, ...]:
    """Returns the calibrated parts of a model, given the 95 % half widths of its parameters.

    ``columns`` returns an effect's columns in the record, shape (m, p).
    """
    return tuple(
        CalibratedPart(place, parameters, scales)
        for place, effect in enumerate(effects)
        for parameters in _parts(effect, half_widths.get(effect.name, {}), columns(effect), scales)
    )


def variances(parts: Sequence[CalibratedPart], place: int, columns: Iterable[int]) -> FloatArray:
    """Returns the calibrated variance of each coefficient in ``columns``, shape (n,); 0 if uncalibrated."""
    own = {name: each for part in parts if part.place == place for name, each in part.parameters.items()}
    return np.array([own.get(str(each), (0.0, 0.0))[1] ** 2 for each in columns])


def priors(parts: Sequence[CalibratedPart]) -> dict[tuple[int, str], Prior]:
    """Returns the priors of all parameters of the parts, by index of the effect and name of the parameter."""
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
    """Returns the standard deviation of an order's cosine and sine from its amplitude and phase intervals.

    Without half widths, the deviation is the fraction ``share`` of the amplitude.
    """
    if halves is None:
        return share * amplitude_arcsec
    turn = math.radians(float(halves.get("phase_deg", 0.0))) * amplitude_arcsec
    return math.hypot(float(halves.get("amplitude_arcsec", 0.0)), turn) / math.sqrt(2.0) / NORMAL_95
