"""The joint fit: separable non-linear least squares over any effects (variable projection).

An effect is linear in its coefficients and not in its shape. For given shapes the coefficients are one linear
solution; only the shapes are searched: first on a grid, then by Gauss-Newton steps with everything that is
linear refitted at each step (Golub and Pereyra 1973). Nothing here knows which effects there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from hdbridge.effects import Effect, FloatArray
from hdbridge.estimation.design import Design, moved, tangents
from hdbridge.estimation.linear import solve_symmetric
from hdbridge.estimation.noise import Precision
from hdbridge.estimation.nuisances import Nuisances
from hdbridge.estimation.samples import BoolArray

GRID_LOGARITHMIC = 12
GRID_LINEAR = 7
ITERATIONS = 25
BEGINS = 3
"""Minima of the grid from which a descent begins."""
CONVERGED = 1e-4
"""A step that promises less than this in chi square is the last."""


class Column(NamedTuple):
    """What a column of the joint fit stands for."""

    effect: int
    """Index of the effect, or -1 for a column that is no effect's."""
    name: str
    """Number of the coefficient, name of the shape parameter, or of the other column."""
    shape: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is to be fitted: observations, effects, and further columns (zeros, nuisances)."""

    design: Design
    effects: tuple[Effect, ...]
    nuisances: Nuisances

    @property
    def observed(self) -> FloatArray:
        """Observations, arcsec, shape (b,)."""
        return self.design.blocks.error_arcsec


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The minimum, and what intervals and tests need of it."""

    effects: tuple[Effect, ...]
    nuisances: FloatArray
    """Coefficients of the columns that are no effect's, shape (q,)."""
    chi_square: float
    columns: tuple[Column, ...]
    jacobian: FloatArray
    """Shape (b, p): coefficients of the effects, further columns, then shapes."""
    information: FloatArray
    """Jacobian' K^-1 Jacobian and what was known beforehand, shape (p, p)."""
    residual: FloatArray
    """Shape (b,)."""
    at_bound: tuple[tuple[int, str], ...]
    """Shape parameters that ended on the edge of their range: effect, name."""


class _Linear(NamedTuple):
    coefficients: FloatArray
    chi_square: float
    dynamic: FloatArray
    """Columns of the effects that have shapes."""
    information: FloatArray
    """Of all linear columns: the straight effects', the further ones, those with shapes."""


class JointFit:
    """One problem under one noise model; whatever does not depend on shapes is prepared once."""

    def __init__(self, problem: Problem, precision: Precision, exact: bool = True) -> None:
        """``exact`` averages every sample into its block; without it the blocks' middles stand for them."""
        self.problem = problem
        self._precision = precision
        self._exact = exact
        self._shaped = [index for index, each in enumerate(problem.effects) if each.shape]
        self._straight = [index for index, each in enumerate(problem.effects) if not each.shape]
        parts = [problem.design.columns(problem.effects[index], True) for index in self._straight]
        self._static = np.concatenate([*parts, problem.nuisances.columns], axis=1)
        self._weighted_static = precision.apply(self._static)
        self._prior = np.concatenate(
            [np.zeros(self._static.shape[1] - problem.nuisances.columns.shape[1]), problem.nuisances.prior]
        )
        self._gram = self._static.T @ self._weighted_static + np.diag(self._prior)
        self._weighted_observed = precision.apply(problem.observed)
        self._static_right = self._static.T @ self._weighted_observed
        self._total = float(problem.observed @ self._weighted_observed)

    def grid(self, index: int, others: Sequence[Effect]) -> list[tuple[float, Effect]]:
        """Local minima of chi square over a grid of one effect's shapes, best first; others as they are."""
        effect = others[index]
        axes = [
            np.geomspace(each.lower, each.upper, GRID_LOGARITHMIC)
            if each.logarithmic
            else np.linspace(each.lower, each.upper, GRID_LINEAR)
            for each in effect.shape
        ]
        sizes = tuple(len(each) for each in axes)
        costs = np.full(sizes, np.inf)
        tried: dict[tuple[int, ...], Effect] = {}
        for place in product(*(range(size) for size in sizes)):
            shape = {
                each.name: float(axis[at]) for each, axis, at in zip(effect.shape, axes, place, strict=True)
            }
            candidate = effect.fitted(effect.coefficients(), shape)
            effects = [*others[:index], candidate, *others[index + 1 :]]
            linear = self._linear(effects)
            fitted = self._spread(effects, linear.coefficients)[0]
            tried[place] = fitted[index]
            if is_valid(fitted[index]):
                costs[place] = linear.chi_square
        minima = []
        for place, candidate in tried.items():
            around = tuple(slice(max(at - 1, 0), at + 2) for at in place)
            if np.isfinite(costs[place]) and costs[place] <= np.min(costs[around]):
                minima.append((float(costs[place]), candidate))
        return sorted(minima, key=lambda each: each[0])

    def refine(self, effects: Sequence[Effect], iterations: int = ITERATIONS) -> Solution:
        """Gauss-Newton over all shapes from where the effects stand, damped, inside the ranges."""
        return self._solution(*self._minimum(effects, iterations))

    def descend(self, effects: Sequence[Effect]) -> tuple[float, list[Effect]]:
        """Like `refine`: chi square and the effects alone."""
        now, _, linear = self._minimum(effects, ITERATIONS)
        return linear.chi_square, now

    def _minimum(
        self, effects: Sequence[Effect], iterations: int
    ) -> tuple[list[Effect], FloatArray, _Linear]:
        now = list(effects)
        linear = self._linear(now)
        now, rest = self._spread(now, linear.coefficients)
        damping = 1e-4
        for _ in range(iterations):
            where, columns = self._tangents(now)
            free = np.ones(len(where), dtype=bool)
            if not where:
                break
            step = np.zeros(len(where))
            for _ in range(len(where) + 1):
                step, promised = self._step(linear, columns, free, damping)
                blocked = np.array(
                    [self._leaves(now, at, move) for at, move in zip(where, step, strict=True)]
                )
                if not np.any(blocked & free):
                    break
                free &= ~blocked
            if not np.any(free) or promised < CONVERGED:
                break
            better = False
            for _ in range(8):
                trial = self._moved(now, where, step)
                attempt = self._linear(trial)
                if attempt.chi_square < linear.chi_square:
                    better = True
                    break
                damping = max(damping, 1e-4) * 10.0
                step, _ = self._step(linear, columns, free, damping)
            if not better:
                break
            damping /= 5.0
            gained = linear.chi_square - attempt.chi_square
            linear = attempt
            now, rest = self._spread(trial, linear.coefficients)
            if gained < CONVERGED:
                break
        return now, rest, linear

    def _linear(self, effects: Sequence[Effect]) -> _Linear:
        """Coefficients for given shapes."""
        design = self.problem.design
        parts = [design.columns(effects[index], self._exact) for index in self._shaped]
        dynamic = np.concatenate(parts, axis=1) if parts else np.empty((len(design.blocks), 0))
        weighted = self._precision.apply(dynamic) if parts else dynamic
        cross = self._static.T @ weighted
        gram = np.block([[self._gram, cross], [cross.T, dynamic.T @ weighted]])
        right = np.concatenate([self._static_right, dynamic.T @ self._weighted_observed])
        coefficients = solve_symmetric(gram, right)
        return _Linear(coefficients, self._total - float(right @ coefficients), dynamic, gram)

    def _residual(self, linear: _Linear) -> FloatArray:
        split = self._static.shape[1]
        fitted = self._static @ linear.coefficients[:split] + linear.dynamic @ linear.coefficients[split:]
        return np.asarray(self.problem.observed - fitted)

    def _spread(self, effects: Sequence[Effect], coefficients: FloatArray) -> tuple[list[Effect], FloatArray]:
        """Hand the coefficients to their effects; what is left belongs to the further columns."""
        result = list(effects)
        at = 0
        for index in self._straight:
            size = len(effects[index].coefficients())
            result[index] = effects[index].fitted(coefficients[at : at + size])
            at += size
        rest = coefficients[at : at + self.problem.nuisances.columns.shape[1]]
        at += len(rest)
        for index in self._shaped:
            size = len(effects[index].coefficients())
            result[index] = effects[index].fitted(coefficients[at : at + size])
            at += size
        return result, rest

    def _tangents(self, effects: Sequence[Effect]) -> tuple[list[tuple[int, str]], FloatArray]:
        where: list[tuple[int, str]] = []
        parts = [np.empty((len(self.problem.design.blocks), 0))]
        for index in self._shaped:
            effect = effects[index]
            names, columns = tangents(self.problem.design, effect, effect.coefficients(), self._exact)
            where += [(index, name) for name in names]
            parts.append(columns)
        return where, np.concatenate(parts, axis=1)

    def _step(
        self, linear: _Linear, columns: FloatArray, free: BoolArray, damping: float
    ) -> tuple[FloatArray, float]:
        """Step of the shapes with everything linear refitted, and the fall in chi square that it promises."""
        weighted = self._precision.apply(columns)
        cross = np.concatenate([self._static.T @ weighted, linear.dynamic.T @ weighted])
        inner = columns.T @ weighted - cross.T @ solve_symmetric(linear.information, cross)
        # At the linear minimum the residual is orthogonal to all linear columns, prior included.
        slope = weighted.T @ self._residual(linear)
        step = np.zeros(len(free))
        chosen = np.flatnonzero(free)
        inner = inner[np.ix_(chosen, chosen)]
        damped = inner + damping * np.diag(np.diag(inner)) + 1e-12 * np.eye(len(chosen))
        step[chosen] = solve_symmetric(damped, slope[chosen])
        return step, float(slope[chosen] @ step[chosen])

    def _moved(self, effects: list[Effect], where: list[tuple[int, str]], step: FloatArray) -> list[Effect]:
        result = list(effects)
        for index in self._shaped:
            steps = {
                name: float(move) for (owner, name), move in zip(where, step, strict=True) if owner == index
            }
            result[index] = moved(effects[index], effects[index].coefficients(), steps)
        return result

    def _leaves(self, effects: list[Effect], at: tuple[int, str], move: float) -> bool:
        """Whether a parameter stands on the edge of its range and the step points outwards."""
        effect = effects[at[0]]
        shape = next(each for each in effect.shape if each.name == at[1])
        here = float(getattr(effect, at[1]))
        return bool((here <= shape.lower and move < 0) or (here >= shape.upper and move > 0))

    def _solution(self, effects: list[Effect], rest: FloatArray, linear: _Linear) -> Solution:
        """Put the columns in the order: effects, further columns, shapes."""
        where, shapes = self._tangents(effects)
        straight = sum(len(effects[index].coefficients()) for index in self._straight)
        extra = self.problem.nuisances.columns.shape[1]
        offsets: dict[int, int] = {}
        at = 0
        for index in [*self._straight, -1, *self._shaped]:
            offsets[index] = at
            at += extra if index < 0 else len(effects[index].coefficients())
        order: list[int] = []
        columns: list[Column] = []
        for index, effect in enumerate(effects):
            for number in range(len(effect.coefficients())):
                order.append(offsets[index] + number)
                columns.append(Column(index, str(number)))
        order += range(straight, straight + extra)
        columns += [Column(-1, name) for name in self.problem.nuisances.names]
        columns += [Column(index, name, shape=True) for index, name in where]
        linear_columns = np.concatenate([self._static, linear.dynamic], axis=1)[:, order]
        jacobian = np.concatenate([linear_columns, shapes], axis=1)
        weighted = self._precision.apply(shapes)
        cross = jacobian.T @ weighted
        information = np.empty((jacobian.shape[1],) * 2)
        information[: len(order), : len(order)] = linear.information[np.ix_(order, order)]
        information[:, len(order) :] = cross
        information[len(order) :, :] = cross.T
        residual = self._residual(linear)
        edge = [
            (index, shape.name)
            for index in self._shaped
            for shape in effects[index].shape
            if getattr(effects[index], shape.name) in {shape.lower, shape.upper}
        ]
        return Solution(
            tuple(effects),
            rest,
            linear.chi_square,
            tuple(columns),
            jacobian,
            information,
            residual,
            tuple(edge),
        )


def joint_fit(
    problem: Problem, precision: Precision, iterations: int = ITERATIONS, exact: bool = True
) -> Solution:
    """The minimum near where the effects stand."""
    return JointFit(problem, precision, exact).refine(problem.effects, iterations)


def search(problem: Problem, precision: Precision) -> tuple[float, tuple[Effect, ...]]:
    """Chi square and effects at the best minimum that a grid over all shapes leads to; by blocks' middles."""
    fit = JointFit(problem, precision, exact=False)
    begins = [list(problem.effects)]
    for index, effect in enumerate(problem.effects):
        if effect.shape:
            minima = fit.grid(index, begins[0])[:BEGINS]
            if minima:
                begins = [[*begins[0][:index], found, *begins[0][index + 1 :]] for _, found in minima]
    chi_square, effects = min((fit.descend(each) for each in begins), key=lambda each: each[0])
    return chi_square, tuple(effects)


def is_valid(effect: Effect) -> bool:
    """Whether the fitted parameters are ones that the effect can have."""
    try:
        type(effect).model_validate(effect.parameters())
    except ValidationError:
        return False
    return True
