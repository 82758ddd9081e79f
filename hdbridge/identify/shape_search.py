"""Where to begin: the best point of a grid over all shapes."""

from __future__ import annotations

import math
from itertools import product
from typing import Final

from hdbridge.effects import Effect
from hdbridge.estimation.separable import Separable, Solution
from hdbridge.estimation.terms import Effort

GRID_LOGARITHMIC: Final = 12
GRID_LINEAR: Final = 7
LINEAR_ONLY: Final = Effort(steps=1)


def searched(fit: Separable, effects: tuple[Effect, ...]) -> Solution:
    """The minimum that the best point of a grid over each effect's shapes leads to."""
    for index, effect in enumerate(effects):
        axes = [each.grid(GRID_LOGARITHMIC if each.logarithmic else GRID_LINEAR) for each in effect.shape]
        names = [each.name for each in effect.shape]
        best = math.inf
        for values in product(*axes):
            other = effect.fitted(effect.coefficients(), dict(zip(names, values, strict=True)))
            found = fit.fit((*effects[:index], other, *effects[index + 1 :]), LINEAR_ONLY)
            if found.chi_square < best and not found.effects[index].violations():
                best, effects = found.chi_square, found.effects
    return fit.fit(effects)
