"""95 % intervals of everything that was fitted, from the noise as it is, not as one would like it.

The covariance of a fit under the noise model is the inverse information. Where the noise model is wrong the
scores of longer stretches of the record vary more than it says: a sandwich over stretches (Liang and Zeger
1986) finds out, and wherever it is wider it is believed. What reading in counts leaves in a wave is the same
all along a sweep, and other in the next: for waves the stretches are whole legs as well, and since there are
few of these, all waves are taken together.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdbridge.effects import Effect, FloatArray, Part
from hdbridge.estimation.blocks import Blocks
from hdbridge.estimation.design import clusters
from hdbridge.estimation.linear import inverse_symmetric
from hdbridge.estimation.noise import Precision
from hdbridge.estimation.nuisances import is_turn
from hdbridge.estimation.separable import Solution
from hdbridge.estimation.shapes import shape_value
from hdbridge.estimation.terms import Column

NORMAL_95 = 1.959964
STRETCHES = 100
"""The record is cut into about so many stretches for the sandwich."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A fitted parameter and its 95 % interval."""

    effect: str
    parameter: str
    """As the model file nests it: ``offset_arcsec``, ``orders[2].amplitude_arcsec`` (2 is the order)."""
    value: float
    half_width: float
    identifiable: bool = True
    """False where the data cannot say: the interval is then the whole range of the parameter."""

    @property
    def low(self) -> float:
        """Lower end."""
        return self.value - self.half_width

    @property
    def high(self) -> float:
        """Upper end."""
        return self.value + self.half_width


def covariance(solution: Solution, precision: Precision, blocks: Blocks) -> FloatArray:
    """Covariance of the solution's columns, shape (p, p)."""
    model = inverse_symmetric(solution.information)
    gone = float(np.sum(np.clip(np.diff(blocks.time_s), 0.0, 1.0)))
    number = clusters(blocks, max(gone / STRETCHES, 1e-9))
    count = int(number[-1]) + 1
    # Turns are noise (each has one stretch to itself), not parameters: they have no scores of their own.
    main = [at for at, column in enumerate(solution.columns) if not is_turn(column.name)]
    if count < 2 * len(main):
        return model
    scores = solution.jacobian[:, main] * precision.apply(solution.residual)[:, np.newaxis]
    sums = np.zeros((count, len(main)))
    np.add.at(sums, number, scores)
    inner = model[np.ix_(main, main)]
    sandwich = inner @ (sums.T @ sums) @ inner * count / (count - 1.0)
    widen = np.ones(len(model))
    widen[main] = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(inner), 1e-300), 1.0))
    waves = np.array([at for at, each in enumerate(solution.columns) if _is_wave(solution, each)], dtype=int)
    if len(waves):
        between = math.sqrt(_between_legs(solution.jacobian[:, waves], precision, solution.residual, blocks))
        widen[waves] = np.maximum(widen[waves], between)
    return np.asarray(model * np.outer(widen, widen))


def _is_wave(solution: Solution, column: Column) -> bool:
    return column.effect >= 0 and solution.effects[column.effect].part is Part.ORDERS


def _between_legs(waves: FloatArray, precision: Precision, residual: FloatArray, blocks: Blocks) -> float:
    """By how much the variance of waves, taken from leg to leg, is more than the noise model's; at least 1.

    Waves (b, p) of one kind have nearly the same information and hardly share any, so that each tells of all.
    """
    scores = np.zeros((int(blocks.leg[-1]) + 1, waves.shape[1]))
    own = np.zeros_like(scores)
    np.add.at(scores, blocks.leg, waves * precision.apply(residual)[:, np.newaxis])
    np.add.at(own, blocks.leg, waves * precision.apply(waves))
    information = np.sum(own, axis=0)
    legs = information**2 / np.sum(own**2, axis=0)
    ratio = np.sum(scores**2, axis=0) / information * legs / np.maximum(legs - 1.0, 0.5)
    return max(float(np.mean(ratio)), 1.0)


def effect_intervals(solution: Solution, index: int, cov: FloatArray) -> list[Interval]:
    """Intervals of one effect's parameters, by the derivative of each with regard to what was fitted."""
    effect = solution.effects[index]
    mine = [at for at, column in enumerate(solution.columns) if column.effect == index]
    coefficients = effect.coefficients()
    base = dict(leaves(effect.parameters()))
    slopes = {name: np.zeros(len(mine)) for name in base}
    for number, at in enumerate(mine):
        column = solution.columns[at]
        step = 0.05 * float(np.sqrt(max(cov[at, at], 1e-24)))
        step = min(step, 1e-2) if column.shape else step
        either = []
        for sign in (-1.0, 1.0):
            if column.shape:
                other = _free_move(effect, column.name, sign * step)
            else:
                changed = coefficients.copy()
                changed[int(column.name)] += sign * step
                other = effect.fitted(changed)
            either.append(dict(leaves(other.parameters())))
        for name in base:
            slopes[name][number] = difference(name, either[0][name], either[1][name]) / (2.0 * step)
    own = cov[np.ix_(mine, mine)]
    shapes = {each.name: each for each in effect.shape}
    result = []
    for name, value in base.items():
        if not np.any(slopes[name]):
            continue
        half = NORMAL_95 * math.sqrt(max(float(slopes[name] @ own @ slopes[name]), 0.0))
        known = True
        if name in shapes:
            widest = max(float(shapes[name].upper) - value, value - float(shapes[name].lower))
            known = half < 0.5 * (
                value if shapes[name].logarithmic else shapes[name].upper - shapes[name].lower
            )
            half = half if known else widest
        result.append(Interval(effect.name, name, value, half, known))
    return result


def nested_half_widths(effect: Effect, intervals: list[Interval]) -> dict[str, Any]:
    """Half widths nested like the effect's parameters; whole numbers (orders) stand as they are."""
    half = {each.parameter: each.half_width for each in intervals if each.effect == effect.name}

    def nest(value: Any, path: str) -> Any:
        if isinstance(value, dict):
            return {key: nest(part, _joined(path, key)) for key, part in value.items()}
        if isinstance(value, list):
            return [nest(part, f"{path}[{_label(part, number)}]") for number, part in enumerate(value)]
        return half.get(path, value)

    nested = nest(effect.parameters(), "")
    return {key: value for key, value in nested.items() if key in half or isinstance(value, list | dict)}


def leaves(parameters: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every floating-point parameter with its path; list items are labelled by their ``order`` if any."""
    if isinstance(parameters, dict):
        for key, part in parameters.items():
            yield from leaves(part, _joined(path, key))
    elif isinstance(parameters, list | tuple):
        for number, part in enumerate(parameters):
            yield from leaves(part, f"{path}[{_label(part, number)}]")
    elif isinstance(parameters, float):
        yield path, parameters


def _label(part: Any, number: int) -> int:
    return int(part["order"]) if isinstance(part, dict) and "order" in part else number


def _joined(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def difference(name: str, low: float, high: float) -> float:
    """Of two values of a parameter with this path (`leaves`); phases the short way round."""
    if re.search(r"phase_deg$", name):
        return (high - low + 180.0) % 360.0 - 180.0
    return high - low


def _free_move(effect: Effect, name: str, step: float) -> Effect:
    """Move one shape parameter without regard to its range (only to differentiate)."""
    shape = next(each for each in effect.shape if each.name == name)
    here = shape_value(effect, name)
    there = here * float(np.exp(step)) if shape.logarithmic else here + step
    return effect.fitted(effect.coefficients(), {name: there})
