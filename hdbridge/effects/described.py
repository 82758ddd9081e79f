"""What an effect says of itself in tables: its words, its shapes, the part of a model that it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from hdbridge.effects.motion import BoolArray


class Part(Enum):
    """A part of a model that other effects may scale, and so carry a copy of."""

    ORDERS = "ripple"
    """Orders of the motor angle."""
    LOOP = "elastic loop"
    GROWTH = "growth of the ripple with torque"


class Sought(Enum):
    """The form of an effect whose place is found among all places at once, by a matched filter."""

    STEP = "a step in time"
    BUMP = "a bump at one load angle"
    TONE = "one line of the spectrum over time"
    LINE = "one line of the spectrum over a turn of the load"

    @property
    def is_line(self) -> bool:
        """Whether it is one sharp line of a spectrum, which nothing smooth resembles."""
        return self in {Sought.TONE, Sought.LINE}


class Moves(Enum):
    """From where a local step improves a shape parameter."""

    ANYWHERE = "anywhere"
    NEARBY = "nearby"
    """Only from next to its best value, which has to be searched for."""
    NEVER = "never"
    """The error does not depend on it smoothly."""


class Experiment(NamedTuple):
    """A measurement that separates a cause from another one."""

    minutes: float
    words: str


@dataclass(frozen=True, slots=True)
class Shape:
    """A parameter that the effect is *not* linear in, with the range in which a fit may look for it."""

    name: str
    lower: float
    upper: float
    logarithmic: bool = False
    """True where the fit should step in the logarithm (widths, time constants)."""
    moves: Moves = Moves.ANYWHERE
    is_frequency: bool = False
    """Whether it counts periods in time: how finely it is known depends on how long the record is."""

    def grid(self, points: int) -> tuple[float, ...]:
        """So many values over its range, evenly spaced (in the logarithm where it is one)."""
        if points < 2:
            return (
                math.sqrt(self.lower * self.upper) if self.logarithmic else 0.5 * (self.lower + self.upper),
            )
        share = [(i + 0.5) / points for i in range(points)]
        if self.logarithmic:
            return tuple(self.lower * (self.upper / self.lower) ** each for each in share)
        return tuple(self.lower + (self.upper - self.lower) * each for each in share)


@dataclass(frozen=True, slots=True)
class Cause:
    """The effect in words, for reports and the generated page of the catalogue."""

    title: str
    """A short name in the field's own terms."""
    equation: str
    """The law in plain text."""
    signature: str
    """What one sees in a record."""
    consequence: str
    """What it does to the axis."""
    remedy: str
    """What a person can do about it."""
    experiment: str
    """The measurement that separates it from its look-alikes."""
    aliases: tuple[str, ...] = ()
    """Names of the causes it can be taken for."""
    source: str = ""
    """Where the equation comes from."""
    size: str = ""
    """How large it typically is."""
    apart: Mapping[str, Experiment] = field(default_factory=dict)
    """By the name of another cause: the measurement that separates the two. Either of them may say it."""


@dataclass(frozen=True, slots=True)
class Compensable:
    """Whether the compensation should make up for an effect, and why (not)."""

    possible: bool
    why: str


@dataclass(frozen=True, slots=True)
class Coefficient:
    """What one coefficient, or a cosine with its sine, is called."""

    name: str
    """The parameter's, with the unit; of a cosine and a sine what stands before amplitude and phase."""
    columns: tuple[int, ...]
    """Its place among the coefficients; of a cosine and a sine both."""
    path: tuple[str | int, ...]
    """Where the parameter stands in `Effect.parameters`; of a cosine and a sine where both do."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Samples at which an effect must show if it is there at all, whatever else acts elsewhere."""

    rows: BoolArray
    """Shape (n,)."""
    otherwise: str
    """In words, what it is when it does not."""
