"""Separable non-linear least squares (variable projection), and the shape parameters of effects.

Shapes are the parameters in which an effect is non-linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np

from hdbridge.analysis.linear import FREE, Column, Columns, Effort, Terms, side_by_side, solve_symmetric
from hdbridge.axis.effects import BoolArray, Effect, FloatArray, refreshed
from hdbridge.axis.effects.described import Moves, Shape

LOGARITHM = 0.7
RANGE = 0.15
"""Maximum step of a shape: in its logarithm (`LOGARITHM`), else relative to its range (`RANGE`)."""
DIFFERENCE = 1e-3
"""Step of numerical differentiation, in the logarithm of a shape or relative to its range."""
LINEAR = 0.3
"""Maximum relative change of an effect within a differentiation step."""


def unit(effect: Effect) -> Effect:
    """Returns the cache key of an effect's columns: the effect with unit coefficients, unless curved."""
    return effect.fitted(np.ones(len(effect.coefficients()))) if not effect.curved else effect


def tangent(columns: Columns, effect: Effect, shape: Shape, central: bool = False) -> FloatArray:
    """Returns the derivative of an effect with respect to one shape, (m,); one-sided unless ``central``."""
    coefficients = effect.coefficients()
    here = shape_value(effect, shape.name)
    predicted = _predicted(columns(effect), coefficients)
    size = float(predicted @ predicted)
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
            return np.zeros(len(predicted)), 0.0
        there_predicted = _predicted(columns(effect.fitted(coefficients, {shape.name: there})), coefficients)
        there_predicted -= predicted
        return there_predicted, moved_by

    up, rise = change(1.0)
    while rise and float(up @ up) > LINEAR**2 * size and length > 1e-9:
        length *= 0.1
        up, rise = change(1.0)
    if rise and not central:
        up /= rise
        return up
    down, fall = change(-1.0)
    return np.asarray((up - down) / (rise - fall)) if rise != fall else np.zeros(len(predicted))


def _predicted(columns: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Returns columns times coefficients; for one column, a scalar product is ten times as fast."""
    return columns[:, 0] * coefficients[0] if columns.shape[1] == 1 else columns @ coefficients


def moved(
    effects: Sequence[Effect], where: Sequence[tuple[int, Shape]], step: FloatArray
) -> tuple[Effect, ...]:
    """Returns the effects after a step of their shapes, clipped to the permitted ranges.

    The step of a logarithmic shape is that of its logarithm.
    """
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
    """Returns the shapes to fit; a shape outside its range does not affect the fit and stays fixed."""
    return [
        each
        for each in effect.shape
        if each.moves in moves and each.lower <= shape_value(effect, each.name) <= each.upper
    ]


def shape_value(effect: Effect, name: str) -> float:
    """Returns the value of a shape: the effect's field or, without such a field, that of its first part."""
    if name in type(effect).model_fields:
        return float(getattr(effect, name))
    parts = next(each for each in effect.parameters().values() if isinstance(each, list) and name in each[0])
    return float(parts[0][name])


def on_scale(effect: Effect, shape: Shape | Column) -> float:
    """Returns the value of a shape on the scale of steps and priors, which may be logarithmic."""
    value = shape_value(effect, shape.name)
    return math.log(value) if shape.logarithmic else value


def leaves(effect: Effect, shape: Shape, move: float) -> bool:
    """Returns True if a shape is at its bound and the step points outwards."""
    here = shape_value(effect, shape.name)
    return bool((here <= shape.lower and move < 0) or (here >= shape.upper and move > 0))


# Separable non-linear least squares over any effects (variable projection), for calibration and diagnosis.


DAMPING = 1e-4
TRIES = 6
"""Maximum number of attempts at a step, each with stronger damping."""
EXCHANGES = 3
"""Maximum number of steps that raise chi square because the effects' copies of each other were updated."""


@dataclass(frozen=True, slots=True, eq=False)
class _Fixed:
    """Columns that do not depend on free shapes: of the nuisances, then of the effects at ``places``."""

    places: tuple[int, ...]
    units: tuple[Effect, ...]
    matrix: FloatArray
    weighted: FloatArray
    gram: FloatArray
    right: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """Fit of the coefficients for given shapes."""

    given: tuple[Effect, ...]
    """Effects from which the columns were computed."""
    effects: tuple[Effect, ...]
    """Same effects with fitted coefficients."""
    fixed: _Fixed
    moving: tuple[int, ...]
    """Indices of the effects whose columns form ``matrix``, in the same order."""
    matrix: FloatArray
    gram: FloatArray
    """Gram matrix of all linear columns (fixed ones first) plus the prior information."""
    coefficients: FloatArray
    inside: BoolArray
    """False for coefficients held at zero because of their sign constraint."""
    chi_square: float


@dataclass(frozen=True, eq=False)
class Solution:
    """Minimum of a fit, with the data for intervals and tests."""

    effects: tuple[Effect, ...]
    nuisances: FloatArray
    """Coefficients of the nuisance columns, shape (q,)."""
    chi_square: float
    """Chi square, including priors."""
    columns: tuple[Column, ...]
    """Parameter of each column: nuisances, then coefficients (fixed columns first), then shapes."""
    residual: FloatArray
    """Observation minus fit, shape (m,)."""
    at_bound: tuple[tuple[int, str], ...]
    """Shapes that ended at a bound, as index of the effect and name of the shape."""
    _fit: Separable
    _point: _Point

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivatives with respect to all parameters, shape (m, p)."""
        linear = side_by_side([self._point.fixed.matrix, self._point.matrix], len(self.residual))
        linear[:, ~self._point.inside] = 0.0
        if linear.shape[1] == len(self.columns):
            return linear
        return np.concatenate([linear, self._fit.tangents(self.effects, central=True)[1]], axis=1)

    @cached_property
    def information(self) -> FloatArray:
        """J' K^-1 J plus the prior information, with the Jacobian J, shape (p, p)."""
        kept = self._point.inside
        size = len(kept)
        cross = self.jacobian.T @ self._fit.terms.weighting.apply(self.jacobian[:, size:])
        linear = self._point.gram * np.outer(kept, kept)
        shapes = cross[size:] + np.diag(self.known[size:, 0])
        return np.block([[linear, cross[:size]], [cross[:size].T, shapes]])

    @cached_property
    def known(self) -> FloatArray:
        """Prior information of each column, and its product with (prior mean - value), shape (p, 2)."""
        mean, information = self._fit.terms.known(self.columns).T
        shapes = [on_scale(self.effects[each.effect], each) for each in self.columns if each.shape]
        value = np.concatenate([self._point.coefficients, shapes])
        return np.stack([information, information * (mean - value)], axis=1)

    def free(self) -> int:
        """Returns the number of parameters that affect the data."""
        linear = self._point.inside & (np.diag(self._point.gram) > 0.0)
        idle = {place for place, each in enumerate(self.effects) if not np.any(each.coefficients())}
        # A spring that is not loaded far enough determines neither its outer zone's stiffness nor its start.
        partly = {each.effect for each, seen in zip(self.columns, linear, strict=False) if not seen}
        shapes = [
            each.effect not in partly or bool(np.any(self.jacobian[:, at]))
            for at, each in enumerate(self.columns)
            if each.shape and each.effect not in idle
        ]
        return int(np.count_nonzero(linear)) + sum(shapes)


class Separable:
    """Fits effects to one data set; caches all results that do not depend on shapes."""

    def __init__(self, terms: Terms) -> None:
        self.terms = terms
        self._right = terms.weighting.apply(terms.observed)
        self._total = float(terms.observed @ self._right)
        self._fixed: _Fixed | None = None

    def fit(self, effects: Sequence[Effect], effort: Effort | None = None) -> Solution:
        """Fits effects, starting from their own parameters; the result is never worse than the start."""
        effort = effort or Effort()
        here = best = self._at(refreshed(effects))
        damping, exchanged = DAMPING, 0
        for _ in range(effort.steps - 1):
            enough = effort.enough(here.chi_square)
            where, tangents = self.tangents(here.effects)
            system = self._system(here, where, tangents)
            step, promised = self._step(here, where, system, damping)
            small = promised < enough
            if small and self._stands(here, refreshed(here.effects)):
                break
            for _ in range(TRIES):
                there = self._at(refreshed(moved(here.effects, where, step)))
                better = there.chi_square < here.chi_square
                if better or small or not np.any(step):
                    break
                damping = max(damping, 1e-3) * 10.0
                step, _ = self._step(here, where, system, damping)
            gained = here.chi_square - there.chi_square
            if not better:
                # Only the copies of other effects have changed; a second step with updated copies may help.
                exchanged += 1
                if not small or exchanged > EXCHANGES:
                    break
                here = there
                continue
            damping /= 5.0
            here = there
            if here.chi_square < best.chi_square:
                best = here
            if 0.0 <= gained < enough:
                break
        return self._solution(best)

    def tangents(
        self, effects: Sequence[Effect], central: bool = False
    ) -> tuple[list[tuple[int, Shape]], FloatArray]:
        """Returns the free shapes, each with its effect's index, and the derivatives by shape, (m, s)."""
        where = [
            (place, each)
            for place, effect in enumerate(effects)
            for each in free_shapes(effect, self.terms.moves)
        ]
        result = np.empty((len(where), len(self.terms.observed))).T
        for at, (place, shape) in enumerate(where):
            result[:, at] = tangent(self.terms.columns, effects[place], shape, central)
        return where, result

    def _at(self, effects: Sequence[Effect]) -> _Point:
        """Fits the coefficients, with the shapes fixed."""
        terms = self.terms
        fixed = self._fixed_of(effects)
        moving = tuple(place for place in range(len(effects)) if place not in fixed.places)
        matrix = side_by_side([terms.columns(effects[place]) for place in moving], len(terms.observed))
        split, size = len(fixed.gram), len(fixed.gram) + matrix.shape[1]
        gram, right = np.empty((size, size)), np.empty(size)
        gram[:split, :split], right[:split] = fixed.gram, fixed.right
        if matrix.shape[1]:
            gram[:split, split:] = fixed.weighted.T @ matrix
            gram[split:, :split] = gram[:split, split:].T
            gram[split:, split:] = matrix.T @ terms.weighting.apply(matrix)
            right[split:] = matrix.T @ self._right
        columns = self._linear(effects, fixed.places, moving)
        mean, information = terms.known(columns).T
        signs = {place: terms.sign(effect) for place, effect in enumerate(effects)}
        sign = np.array([signs.get(each.effect, 0.0) for each in columns])
        gram[np.arange(size), np.arange(size)] += information
        right = right + information * mean
        inside = np.ones(size, dtype=np.bool_)
        while True:
            coefficients = np.zeros(size)
            coefficients[inside] = solve_symmetric(gram[np.ix_(inside, inside)], right[inside])
            below = inside & (sign * coefficients < 0.0)
            if not np.any(below):
                break
            inside &= ~below
        # The full expression is used, because a ridge solution satisfies the normal equations only roughly.
        chi_square = self._total + float(information @ mean**2)
        chi_square += float(coefficients @ (gram @ coefficients) - 2.0 * (right @ coefficients))
        chi_square += self._of_shapes(effects)
        result = list(effects)
        at = len(terms.nuisances.names)
        for place in (*fixed.places, *moving):
            count = len(effects[place].coefficients())
            result[place] = effects[place].fitted(coefficients[at : at + count])
            at += count
        return _Point(
            tuple(effects), tuple(result), fixed, moving, matrix, gram, coefficients, inside, chi_square
        )

    def _fixed_of(self, effects: Sequence[Effect]) -> _Fixed:
        """Returns the columns of effects without free shapes, from the cache if they have not changed."""
        units = {
            place: unit(effect)
            for place, effect in enumerate(effects)
            if not free_shapes(effect, self.terms.moves)
        }
        old = self._fixed
        if old is not None:
            same = all(
                place in units and units[place] == each
                for place, each in zip(old.places, old.units, strict=True)
            )
            if same:
                return old
            # Effects whose columns have changed are excluded, because these will change again at the next
            # step.
            known = set(old.units)
            places = tuple(place for place, each in units.items() if each in known) or tuple(units)
        else:
            places = tuple(units)
        parts = [self.terms.nuisances.columns, *(self.terms.columns(effects[place]) for place in places)]
        matrix = side_by_side(parts, len(self.terms.observed))
        weighted = self.terms.weighting.apply(matrix)
        self._fixed = _Fixed(
            places,
            tuple(units[place] for place in places),
            matrix,
            weighted,
            matrix.T @ weighted,
            matrix.T @ self._right,
        )
        return self._fixed

    def _linear(self, effects: Sequence[Effect], *places: tuple[int, ...]) -> list[Column]:
        """Lists the parameters of the linear columns, nuisances first."""
        columns = [Column(-1, name) for name in self.terms.nuisances.names]
        for place in chain(*places):
            columns += [Column(place, str(number)) for number in range(len(effects[place].coefficients()))]
        return columns

    def _of_shapes(self, effects: Sequence[Effect]) -> float:
        """Returns the contribution of the shapes' priors to chi square."""
        total = 0.0
        for (place, name), known in self.terms.prior.items():
            shape = next((each for each in effects[place].shape if each.name == name), None)
            if shape is not None:
                total += known.information * (on_scale(effects[place], shape) - known.mean) ** 2
        return total

    def _system(
        self, here: _Point, where: list[tuple[int, Shape]], tangents: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the normal matrix and gradient of the shapes, with all linear parameters eliminated."""
        if not where:
            return np.empty((0, 0)), np.empty(0)
        weighted = self.terms.weighting.apply(tangents)
        cross = np.concatenate([here.fixed.matrix.T @ weighted, here.matrix.T @ weighted])[here.inside]
        inner = tangents.T @ weighted
        slope = tangents.T @ self._right - cross.T @ here.coefficients[here.inside]
        known = [self.terms.prior.get((place, each.name), FREE) for place, each in where]
        mean, information = np.array(known).T
        inner += np.diag(information)
        slope += information * (mean - [on_scale(here.effects[place], each) for place, each in where])
        gram = here.gram[np.ix_(here.inside, here.inside)]
        return inner - cross.T @ solve_symmetric(gram, cross), slope

    def _step(
        self,
        here: _Point,
        where: list[tuple[int, Shape]],
        system: tuple[FloatArray, FloatArray],
        damping: float,
    ) -> tuple[FloatArray, float]:
        """Returns the damped step of the shapes in their ranges, and its predicted chi-square decrease."""
        inner, slope = system
        free = np.ones(len(where), dtype=np.bool_)
        step = np.zeros(len(where))
        while np.any(free):
            step[:] = 0.0
            part = inner[np.ix_(free, free)]
            damped = part + damping * np.diag(np.diag(part)) + 1e-12 * np.eye(len(part))
            step[free] = solve_symmetric(damped, slope[free])
            blocked = np.array(
                [
                    leaves(here.effects[place], shape, move)
                    for (place, shape), move in zip(where, step.tolist(), strict=True)
                ]
            )
            if not np.any(blocked & free):
                break
            free &= ~blocked
        step[~free] = 0.0
        return step, float(slope @ step)

    def _stands(self, here: _Point, effects: Sequence[Effect]) -> bool:
        """Returns True if the copies of model parts that the effects contain agree with the fit."""
        return all(unit(one) == unit(other) for one, other in zip(here.given, effects, strict=True))

    def _solution(self, here: _Point) -> Solution:
        columns, edge = self._linear(here.effects, here.fixed.places, here.moving), []
        for place, effect in enumerate(here.effects):
            for each in free_shapes(effect, self.terms.moves):
                columns.append(Column(place, each.name, True, each.logarithmic))
                if shape_value(effect, each.name) in {each.lower, each.upper}:
                    edge.append((place, each.name))
        split = here.fixed.matrix.shape[1]
        predicted = here.fixed.matrix @ here.coefficients[:split] + here.matrix @ here.coefficients[split:]
        return Solution(
            here.effects,
            here.coefficients[: len(self.terms.nuisances.names)],
            here.chi_square,
            tuple(columns),
            np.asarray(self.terms.observed - predicted),
            tuple(edge),
            self,
            here,
        )
