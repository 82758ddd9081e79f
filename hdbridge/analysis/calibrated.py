"""What a model knows of an axis, as a prior of a fit: each part of it is as calibrated, or has changed.

A part is what changes together: a loop, one order, a spring. As calibrated, its parameters are normally
distributed about those of the model file, as wide as the 95 % intervals there, or where it has none by
`Scales.calibrated`. A part that the data pull further away than a change costs has changed and is free. So
what the data cannot distinguish from a new cause stays with the model, and a loop that is another one is
still found.
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
from hdbridge.effects import Effect, FloatArray

EXACT: Final = 1e-3
"""Share of such a deviation that no record distinguishes from none."""


@dataclass(frozen=True, slots=True)
class CalibratedPart:
    """Parameters of one effect that change together, as calibrated."""

    place: int
    """Of the effect among the model's."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and standard deviation, by number of the coefficient or name of the shape; of the logarithm of a
    logarithmic shape.
    """
    scales: Scales
    fixed: bool = False
    """Whether it cannot have changed."""

    @property
    def change_cost(self) -> float:
        """Chi square that the part's change costs."""
        if self.fixed:
            return math.inf
        return self.scales.enter + self.scales.penalty * len(self.parameters)

    def as_given(self) -> CalibratedPart:
        """The part where it is taken for exactly what the model file says."""
        exact = {name: (mean, EXACT * deviation) for name, (mean, deviation) in self.parameters.items()}
        return replace(self, parameters=exact, fixed=True)

    def strain(self, effects: Sequence[Effect], spread: FloatArray | None = None) -> float:
        """Chi square by which the part is away from its calibration; ``spread`` (p, p) is the covariance of
        the ``effects``' own parameters, where they are known no better.
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
        """The part where so much of it is seen."""
        seen = {name: (share * mean, deviation) for name, (mean, deviation) in self.parameters.items()}
        return replace(self, parameters=seen)


def calibrated(
    effects: Sequence[Effect],
    half_widths: Mapping[str, Mapping[str, Any]],
    columns: Callable[[Effect], FloatArray],
    scales: Scales,
) -> tuple[CalibratedPart, ...]:
    """The parts of a model with its 95 % half widths; ``columns``: an effect's in the record, (m, p)."""
    return tuple(
        CalibratedPart(place, parameters, scales)
        for place, effect in enumerate(effects)
        for parameters in _parts(effect, half_widths.get(effect.name, {}), columns(effect), scales)
    )


def variances(parts: Sequence[CalibratedPart], place: int, columns: Iterable[int]) -> FloatArray:
    """Of some coefficients of an effect of the model, as calibrated, shape (n,); 0 where nothing is known."""
    own = {name: each for part in parts if part.place == place for name, each in part.parameters.items()}
    return np.array([own.get(str(each), (0.0, 0.0))[1] ** 2 for each in columns])


def priors(parts: Sequence[CalibratedPart]) -> dict[tuple[int, str], Prior]:
    """What is known of the parameters of some parts."""
    return {
        (part.place, name): Prior(mean, deviation**-2)
        for part in parts
        for name, (mean, deviation) in part.parameters.items()
    }


def _parts(
    effect: Effect, halves: Mapping[str, Any], columns: FloatArray, scales: Scales
) -> Iterator[dict[str, tuple[float, float]]]:
    peaks = np.max(np.abs(columns), axis=0, initial=0.0)
    # What the record does not see stays as it is.
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
    """Of cosine and sine alike, from the half widths of amplitude and phase."""
    if halves is None:
        return share * amplitude_arcsec
    turn = math.radians(float(halves.get("phase_deg", 0.0))) * amplitude_arcsec
    return math.hypot(float(halves.get("amplitude_arcsec", 0.0)), turn) / math.sqrt(2.0) / NORMAL_95
