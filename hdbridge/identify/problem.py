"""One problem of an identification: a design, effects and nuisances, fitted under one noise model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from hdbridge.effects import Effect, FloatArray
from hdbridge.estimation.design import Design
from hdbridge.estimation.separable import Separable, Solution
from hdbridge.estimation.terms import Effort, Nuisances, Terms, Weighting

BEGINS: Final = 3
"""Minima of the grid from which a descent begins."""
LINEAR_ONLY: Final = Effort(steps=1)


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

    def under(self, weighting: Weighting, exact: bool = True) -> Separable:
        """Its fits; ``exact`` averages all samples into their blocks, else their middles stand for them."""
        columns = self.design.columns if exact else self.design.roughly
        return Separable(Terms(self.observed, columns, weighting, self.nuisances))

    def fitted(self, weighting: Weighting, effort: Effort | None = None, exact: bool = True) -> Solution:
        """The minimum near where the effects stand."""
        return self.under(weighting, exact).fit(self.effects, effort)

    def searched(self, weighting: Weighting) -> tuple[float, tuple[Effect, ...]]:
        """Chi square and effects at the best minimum that a grid over all shapes leads to."""
        fit = self.under(weighting, exact=False)
        begins = [self.effects]
        for index, effect in enumerate(self.effects):
            if effect.shape:
                minima = fit.grid(index, begins[0])[:BEGINS]
                if minima:
                    begins = [(*begins[0][:index], found, *begins[0][index + 1 :]) for _, found in minima]
        found = min((fit.fit(each) for each in begins), key=lambda each: each.chi_square)
        return found.chi_square, found.effects
