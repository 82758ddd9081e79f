"""Derives 95 % intervals of an effect's parameters from the covariance of a fit."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdbridge.analysis.linear import Column
from hdbridge.analysis.separable import shape_value
from hdbridge.axis.effects import Effect, FloatArray

NORMAL_95 = 1.959964


@dataclass(frozen=True, slots=True)
class Interval:
    """A fitted parameter and its 95 % interval."""

    effect: str
    parameter: str
    """Path in the model file: ``offset_arcsec``, or ``orders[2].amplitude_arcsec`` for order 2."""
    value: float
    half_width: float
    identifiable: bool = True
    """False if the data do not determine the parameter; its interval is then the whole permitted range."""

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width


def intervals_of(effect: Effect, columns: Sequence[Column], cov: FloatArray) -> list[Interval]:
    """Returns the intervals of one effect's parameters; ``cov`` (c, c) is the covariance of ``columns``."""
    shapes = {each.name: each for each in effect.shape}
    base = dict(leaves(effect.parameters()))
    result = []
    for name, half in half_widths(effect, columns, cov).items():
        value, widest, known = base[name], half, True
        if name in shapes:
            widest = max(float(shapes[name].upper) - value, value - float(shapes[name].lower))
            known = half < 0.5 * (
                value if shapes[name].logarithmic else shapes[name].upper - shapes[name].lower
            )
        result.append(Interval(effect.name, name, value, half if known else widest, known))
    return result


def half_widths(effect: Effect, columns: Sequence[Column], cov: FloatArray) -> dict[str, float]:
    """Returns the 95 % half width of each parameter, by error propagation from the columns."""
    steps = 0.05 * np.sqrt(np.maximum(np.diag(cov), 1e-24))
    return {
        name: NORMAL_95 * math.sqrt(max(float(slope @ cov @ slope), 0.0))
        for name, slope in slopes(effect, columns, steps).items()
    }


def slopes(effect: Effect, columns: Sequence[Column], steps: FloatArray) -> dict[str, FloatArray]:
    """Returns the derivatives (c,) of each effect parameter with respect to the columns of a fit.

    They are central differences with ``steps`` (c,). Parameters that depend on no column are omitted.
    """
    coefficients = effect.coefficients()
    result: dict[str, FloatArray] = {}
    for number, (column, given) in enumerate(zip(columns, steps.tolist(), strict=True)):
        step = min(given, 1e-2) if column.shape else given
        either = []
        for sign in (-1.0, 1.0):
            if column.shape:
                other = _free_move(effect, column.name, sign * step)
            else:
                changed = coefficients.copy()
                changed[int(column.name)] += sign * step
                other = effect.fitted(changed)
            either.append(dict(leaves(other.parameters())))
        for name, low in either[0].items():
            change = difference(name, low, either[1][name]) / (2.0 * step)
            if change:
                result.setdefault(name, np.zeros(len(columns)))[number] = change
    return {name: result[name] for name in dict(leaves(effect.parameters())) if name in result}


def nested_half_widths(effect: Effect, intervals: list[Interval]) -> dict[str, Any]:
    """Returns half widths, nested like the effect's parameters; integers (orders) are copied."""
    half = {each.parameter: each.half_width for each in intervals if each.effect == effect.name}

    def nest(value: Any, path: str) -> Any:
        if isinstance(value, dict):
            nested = {key: nest(part, joined(path, key)) for key, part in value.items()}
            return {key: part for key, part in nested.items() if part is not None}
        if isinstance(value, list):
            return [nest(part, f"{path}[{_label(part, number)}]") for number, part in enumerate(value)]
        return half.get(path, None if isinstance(value, float) else value)

    nested = nest(effect.parameters(), "")
    return {key: value for key, value in nested.items() if key in half or isinstance(value, list | dict)}


def leaves(parameters: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Yields each floating-point parameter with its path; list items are labelled by ``order`` or index."""
    if isinstance(parameters, dict):
        for key, part in parameters.items():
            yield from leaves(part, joined(path, key))
    elif isinstance(parameters, list | tuple):
        for number, part in enumerate(parameters):
            yield from leaves(part, f"{path}[{_label(part, number)}]")
    elif isinstance(parameters, float):
        yield path, parameters


def _label(part: Any, number: int) -> int:
    return int(part["order"]) if isinstance(part, dict) and "order" in part else number


def joined(path: str, key: str) -> str:
    """Returns ``path`` with ``key`` appended, in the notation of `leaves`."""
    return f"{path}.{key}" if path and key else path or key


def labelled(parameters: Any, path: Iterable[str | int]) -> str:
    """Returns the path, in the notation of `leaves`, for a sequence of keys and list indices."""
    said = ""
    for key in path:
        parameters = parameters[key]
        said = joined(said, key) if isinstance(key, str) else f"{said}[{_label(parameters, key)}]"
    return said


def difference(name: str, low: float, high: float) -> float:
    """Returns ``high`` minus ``low`` for the parameter at path ``name`` (see `leaves`); wraps phases."""
    if re.search(r"phase_deg$", name):
        return (high - low + 180.0) % 360.0 - 180.0
    return high - low


def _free_move(effect: Effect, name: str, step: float) -> Effect:
    """Changes one shape parameter regardless of its range (only for differentiation)."""
    shape = next(each for each in effect.shape if each.name == name)
    here = shape_value(effect, name)
    there = here * float(np.exp(step)) if shape.logarithmic else here + step
    return effect.fitted(effect.coefficients(), {name: there})
