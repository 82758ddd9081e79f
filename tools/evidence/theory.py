"""A theory of a record: a model's effects, causes beside them, what has changed, what is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.effects import CATALOGUE, Effect, FloatArray, Start, in_place, refreshed
from hdbridge.estimation.calibration import CalibratedPart
from hdbridge.estimation.shapes import free_shapes, on_scale
from hdbridge.estimation.terms import FOUND

IN_TIME = "time"
"""The coordinate of something unknown that follows nothing but time: a wander."""


@dataclass(frozen=True, slots=True)
class Theory:
    """What is there, with its parameters; two with the same `key` differ in parameters only."""

    effects: tuple[Effect, ...]
    """The model's first."""
    base: int
    """How many are the model's."""
    start: Start
    places: tuple[float, ...] = ()
    """Of each cause: at how many places it might have been found."""
    changed: frozenset[int] = frozenset()
    """Numbers of the model's parts that have changed."""
    replaced: str = ""
    """Name of the law that stands in place of the model's."""
    lawless: bool = False
    """Whether the loop obeys neither law."""
    unknown: str = ""
    """Coordinate of what is unknown."""

    @property
    def causes(self) -> tuple[Effect, ...]:
        """The effects that are no part of the model."""
        return self.effects[self.base :]

    @property
    def key(self) -> object:
        """What distinguishes theories."""
        names = tuple(sorted(each.name for each in self.causes))
        return names, self.changed, self.replaced, self.lawless, self.unknown

    def names(self, parts: Sequence[CalibratedPart]) -> frozenset[str]:
        """What it finds, by the names that effects give to changes; `unexplained` of what is unknown."""
        found = {each.name for each in self.causes}
        for number in self.changed:
            found.add(change_name(self.effects[parts[number].place], parts[number]))
        if self.replaced:
            found.add(self.replaced)
        elif self.lawless:
            found |= {change_name(each) for each in self.effects[: self.base] if each.part and each.shape}
        return frozenset(found | ({"unexplained"} if self.unknown else set()))

    def plus(self, effect: Effect, places: float) -> Theory:
        """With one more cause, of no size yet; part of one that is there where the two are of one."""
        for at in range(self.base, len(self.effects)):
            both = self.effects[at].joined(effect.fitted(np.zeros(len(effect.coefficients()))))
            if both is not None:
                where = at - self.base
                counted = (*self.places[:where], self.places[where] * places, *self.places[where + 1 :])
                effects = (*self.effects[:at], both, *self.effects[at + 1 :])
                return replace(self, effects=effects, places=counted)
        none = effect.fitted(np.zeros(len(effect.coefficients())))
        return replace(self, effects=(*self.effects, none), places=(*self.places, places))

    def without(self, cause: int) -> Theory:
        """Without one of its causes."""
        at = self.base + cause
        return replace(
            self,
            effects=self.effects[:at] + self.effects[at + 1 :],
            places=self.places[:cause] + self.places[cause + 1 :],
        )

    def other_laws(self) -> list[Theory]:
        """With another law in the place of one of the model's."""
        return [
            replace(self, effects=refreshed((*self.effects[:at], law, *self.effects[at + 1 :])),
                    replaced="" if self.replaced else law.name)
            for at, effect in enumerate(self.effects[: self.base])
            for law in in_place(effect, CATALOGUE.values())
        ]  # fmt: skip


def change_name(effect: Effect, part: CalibratedPart | None = None) -> str:
    """What the catalogue calls a change of an effect, or of a part of it."""
    before = effect
    if part is not None and len(effect.pieces()) > 1:
        numbers = {int(each) for each in part.parameters if each.isdigit()}
        for piece, named in zip(effect.pieces(), effect.named_coefficients(), strict=True):
            if set(named.columns) & numbers:
                before = piece
    now = before.fitted(1.1 * before.coefficients())
    found = [each for kind in CATALOGUE.values() if (each := kind.of_change(before, now)) is not None]
    return sorted(found, key=lambda each: each.changes is None)[0].name if found else effect.name


@dataclass(frozen=True, slots=True)
class Parameter:
    """A coefficient or shape of one effect, with its prior."""

    effect: int
    name: str
    shape: bool
    value: float
    mean: float
    deviation: float
    lower: float
    upper: float


def parameters(
    theory: Theory,
    at: int,
    parts: Sequence[CalibratedPart],
    peaks: FloatArray,
    size_arcsec: float,
    share: float,
) -> list[Parameter]:
    """Of one effect, coefficients first; ``peaks`` (p,) of its columns, ``share`` of what has changed."""
    effect = theory.effects[at]
    known: dict[str, tuple[float, float]] = {}
    for number, part in enumerate(parts):
        if part.place == at:
            wide = share / part.scales.calibrated if number in theory.changed else 1.0
            known |= {name: (mean, wide * deviation) for name, (mean, deviation) in part.parameters.items()}
    result = []
    lower, upper = bounds(effect)
    for i, value in enumerate(effect.coefficients().tolist()):
        free = size_arcsec / peaks[i] if peaks[i] > 0.0 else 0.0
        mean, deviation = known.get(str(i), (0.0, free))
        result.append(Parameter(at, str(i), False, value, mean, deviation, lower[i], upper[i]))
    for shape in free_shapes(effect, FOUND):
        low, high = np.log((shape.lower, shape.upper)) if shape.logarithmic else (shape.lower, shape.upper)
        mean, deviation = known.get(shape.name, (0.5 * (low + high), (high - low) / np.sqrt(12.0)))
        result.append(
            Parameter(at, shape.name, True, on_scale(effect, shape), mean, deviation, float(low), float(high))
        )
    return result


def bounds(effect: Effect) -> tuple[list[float], list[float]]:
    """Physical ranges of the coefficients, as the fields of the effect give them."""
    count = len(effect.coefficients())
    lower, upper = [-np.inf] * count, [np.inf] * count
    for each in effect.named_coefficients():
        if len(each.columns) == 1 and len(each.path) == 1:
            place = each.columns[0]
            for limit in type(effect).model_fields[str(each.path[0])].metadata:
                lower[place] = max(lower[place], getattr(limit, "ge", -np.inf))
                upper[place] = min(upper[place], getattr(limit, "le", np.inf))
    if effect.nonnegative:
        lower = [max(each, 0.0) for each in lower]
    return lower, upper
