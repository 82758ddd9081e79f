"""Shapes, the parameters that an effect is not linear in: their values, their steps, their derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hdbridge.effects import Effect, FloatArray
from hdbridge.effects.base import Shape
from hdbridge.effects.described import Moves
from hdbridge.estimation.terms import Column, Columns

LOGARITHM = 0.7
RANGE = 0.15
"""A step goes no further than this: in the logarithm of a shape, or in shares of its range."""
DIFFERENCE = 1e-3
"""Step of a derivative: of the logarithm of a shape, or of its range."""
LINEAR = 0.3
"""A step that changes more than this share of what the effect does is too long to differentiate with."""


def unit(effect: Effect) -> Effect:
    """What the columns of an effect depend on: all but its coefficients, where it is linear in them."""
    return effect.fitted(np.ones(len(effect.coefficients()))) if not effect.curved else effect


def tangent(columns: Columns, effect: Effect, shape: Shape, central: bool = False) -> FloatArray:
    """Derivative of what an effect does by one of its shapes, shape (m,); one-sided at a bound."""
    coefficients = effect.coefficients()
    here = shape_value(effect, shape.name)
    told = _told(columns(effect), coefficients)
    size = float(told @ told)
    length = DIFFERENCE

    def change(sign: float) -> tuple[FloatArray, float]:
        there = (
            here * np.exp(sign * length)
            if shape.logarithmic
            else here + sign * length * (shape.upper - shape.lower)
        )
        there = float(np.clip(there, shape.lower, shape.upper))
        moved_by = np.log(there / here) if shape.logarithmic else there - here
        if not moved_by:
            return np.zeros(len(told)), 0.0
        there_told = _told(columns(effect.fitted(coefficients, {shape.name: there})), coefficients)
        there_told -= told
        return there_told, moved_by

    up, rise = change(1.0)
    while rise and float(up @ up) > LINEAR**2 * size and length > 1e-9:
        length *= 0.1
        up, rise = change(1.0)
    if rise and not central:
        up /= rise
        return up
    down, fall = change(-1.0)
    return np.asarray((up - down) / (rise - fall)) if rise != fall else np.zeros(len(told))


def _told(columns: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Their product; of one column by a product of numbers, ten times faster than one of matrices."""
    return columns[:, 0] * coefficients[0] if columns.shape[1] == 1 else columns @ coefficients


def moved(
    effects: Sequence[Effect], where: Sequence[tuple[int, Shape]], step: FloatArray
) -> tuple[Effect, ...]:
    """The effects with their shapes moved (in the logarithm where it is one), kept in their ranges."""
    result = list(effects)
    for (place, shape), move in zip(where, step.tolist(), strict=True):
        here = shape_value(result[place], shape.name)
        if shape.logarithmic:
            there = here * float(np.exp(np.clip(move, -LOGARITHM, LOGARITHM)))
        else:
            reach = RANGE * (shape.upper - shape.lower)
            there = here + min(max(move, -reach), reach)
        there = min(max(there, shape.lower), shape.upper)
        result[place] = result[place].fitted(result[place].coefficients(), {shape.name: there})
    return tuple(result)


def free_shapes(effect: Effect, moves: frozenset[Moves]) -> list[Shape]:
    """The shapes that may be moved; one that stands outside its range is of no account, and stays."""
    return [
        each
        for each in effect.shape
        if each.moves in moves and each.lower <= shape_value(effect, each.name) <= each.upper
    ]


def shape_value(effect: Effect, name: str) -> float:
    """A shape parameter; where it is not a field, that of the first of its parts."""
    if name in type(effect).model_fields:
        return float(getattr(effect, name))
    parts = next(each for each in effect.parameters().values() if isinstance(each, list) and name in each[0])
    return float(parts[0][name])


def on_scale(effect: Effect, shape: Shape | Column) -> float:
    """A shape parameter as it is stepped and known beforehand: its logarithm where it has one."""
    value = shape_value(effect, shape.name)
    return math.log(value) if shape.logarithmic else value


def leaves(effect: Effect, shape: Shape, move: float) -> bool:
    """Whether a shape stands on the edge of its range and the step points outwards."""
    here = shape_value(effect, shape.name)
    return bool((here <= shape.lower and move < 0) or (here >= shape.upper and move > 0))
