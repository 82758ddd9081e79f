"""Where to begin: the best minima over a grid of all shapes."""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np

from hdbridge.effects import Effect
from hdbridge.estimation.separable import Separable
from hdbridge.estimation.terms import Effort

GRID_LOGARITHMIC: Final = 12
GRID_LINEAR: Final = 7
BEGINS: Final = 3
"""Minima of the grid from which a descent begins."""
LINEAR_ONLY: Final = Effort(steps=1)

_Effects = tuple[Effect, ...]


def searched(fit: Separable, effects: _Effects) -> tuple[float, _Effects]:
    """Chi square and effects at the best minimum that a grid over all shapes leads to."""
    begins = [effects]
    for index, effect in enumerate(effects):
        if effect.shape:
            begins = _minima(fit, index, begins[0]) or begins
    found = min((fit.fit(each) for each in begins), key=lambda each: each.chi_square)
    return found.chi_square, found.effects


def _minima(fit: Separable, index: int, effects: _Effects) -> list[_Effects]:
    """With one effect at its local minima over a grid of its shapes, best first; others as they are."""
    effect = effects[index]
    axes = [each.grid(GRID_LOGARITHMIC if each.logarithmic else GRID_LINEAR) for each in effect.shape]
    costs = np.full(tuple(len(each) for each in axes), np.inf)
    tried: dict[tuple[int, ...], Effect] = {}
    for place in product(*(range(size) for size in costs.shape)):
        shape = {each.name: axis[at] for each, axis, at in zip(effect.shape, axes, place, strict=True)}
        candidate = effect.fitted(effect.coefficients(), shape)
        found = fit.fit((*effects[:index], candidate, *effects[index + 1 :]), LINEAR_ONLY)
        tried[place] = found.effects[index]
        if not tried[place].violations():
            costs[place] = found.chi_square
    around = {place: costs[tuple(slice(max(at - 1, 0), at + 2) for at in place)] for place in tried}
    minima = [each for each in tried if np.isfinite(costs[each]) and costs[each] <= np.min(around[each])]
    best = sorted(minima, key=lambda each: float(costs[each]))[:BEGINS]
    return [(*effects[:index], tried[each], *effects[index + 1 :]) for each in best]
