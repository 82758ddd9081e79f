"""What a fit is given: observations, columns, their weighting, what is known beforehand, its effort."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import NamedTuple, Protocol

import numpy as np

from hdbridge.effects import BoolArray, Effect, FloatArray
from hdbridge.effects.described import Moves
from hdbridge.estimation.linear import side_by_side

LOCAL = frozenset({Moves.ANYWHERE})
"""Shapes that a local step improves from anywhere."""
FOUND = LOCAL | {Moves.NEARBY}
"""... and those that a search has brought next to their best value."""

Columns = Callable[[Effect], FloatArray]


class Weighting(Protocol):
    """The inverse covariance of the noise, K^-1."""

    def apply(self, columns: FloatArray) -> FloatArray:
        """K^-1 times columns of shape (m,) or (m, p)."""
        ...


class Prior(NamedTuple):
    """What is known of a coefficient or shape beforehand (of a logarithmic shape: of its logarithm)."""

    mean: float
    information: float
    """One over the variance; less than nothing takes back what columns that are noisy themselves claim."""


FREE = Prior(0.0, 0.0)
"""Nothing is known."""


class Column(NamedTuple):
    """What a column of the fit stands for."""

    effect: int
    """Place of the effect, or -1 for a column that is no effect's."""
    name: str
    """Number of the coefficient, name of the shape parameter, or of the other column."""
    shape: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Effort:
    """How far a fit goes."""

    steps: int = 25
    converged: float = 1e-4
    """A step that promises, or gains, less than this in chi square is the last."""
    roughly: float = 0.0
    """... or less than this share of chi square: where much is left, exactness is of no use."""

    def enough(self, chi_square: float) -> float:
        """Gain in chi square below which the fit stands."""
        return max(self.converged, self.roughly * chi_square)


@dataclass(frozen=True, slots=True, eq=False)
class Nuisances:
    """Columns that are no effect's."""

    columns: FloatArray
    """Shape (b, q)."""
    names: tuple[str, ...]
    prior: tuple[Prior, ...]
    """What is known of each coefficient beforehand."""

    def and_also(self, other: Nuisances) -> Nuisances:
        """With further columns."""
        return Nuisances(
            side_by_side([self.columns, other.columns], len(self.columns)),
            (*self.names, *other.names),
            self.prior + other.prior,
        )

    def without(self, left_out: Callable[[str], bool]) -> Nuisances:
        """Without the columns whose names answer."""
        keep = np.array([not left_out(each) for each in self.names])
        return Nuisances(
            self.columns[:, keep], tuple(compress(self.names, keep)), tuple(compress(self.prior, keep))
        )


def unknown(columns: FloatArray | BoolArray, names: Sequence[str]) -> Nuisances:
    """Columns of which nothing is known."""
    return Nuisances(np.asarray(columns, dtype=np.float64), tuple(names), (FREE,) * len(names))


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """What is fitted to what; arrays of m rows."""

    observed: FloatArray
    """Arcsec, shape (m,)."""
    columns: Columns
    """Of an effect, (m, p): whatever its coefficients are."""
    weighting: Weighting
    nuisances: Nuisances
    prior: Mapping[tuple[int, str], Prior] = field(default_factory=dict)
    """By place of the effect, and number of the coefficient or name of the shape."""
    sign: Callable[[Effect], float] = lambda _: 0.0
    """The sign that an effect's coefficients have; 0 where they may have either."""
    moves: frozenset[Moves] = LOCAL
    """Shapes that are moved; the others stay as they are."""

    def known(self, columns: Sequence[Column]) -> FloatArray:
        """Mean and information beforehand of columns that begin with the nuisances', shape (p, 2)."""
        others = columns[len(self.nuisances.prior) :]
        own = [self.prior.get((each.effect, each.name), FREE) for each in others]
        return np.array([*self.nuisances.prior, *own], dtype=np.float64).reshape(-1, 2)
