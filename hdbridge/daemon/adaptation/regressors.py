"""What is followed of a model, as a linear problem: the coefficients, and their columns on line.

``observed - committed prediction = columns @ change + nuisances``. The equations are the effects' own: an
effect without memory gives its columns for any angles; one with a memory is led along the command by trackers
of unit coefficients, which by the effects' laws is the same. What must not pass for a change of the gear is
fitted in addition, and never applied: the zero, and what an eccentric or oval disc of the load encoder adds,
once and twice per turn of the load.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.effects import Effect, FloatArray, Moment, Motion, Start, Tracker, refreshed
from hdbridge.effects.base import Memoryless
from hdbridge.effects.orders import cosines_and_sines
from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest
from hdbridge.model import TransmissionModel

LOAD_ORDERS = (1, 2)
"""Per turn of the load: eccentricity and ovality of an encoder's disc."""
SAME_ARCSEC = 1e-6
"""A state is known when it comes out alike whichever way the axis had moved before."""


@dataclass(frozen=True, slots=True)
class Term:
    """An effect that is followed."""

    place: int
    """In the model's effects."""
    effect: Effect
    """As committed."""
    columns: slice
    """Its coefficients among all that are followed."""
    memory: bool
    """Whether only reversals show it."""


class Regressors:
    """The columns of one model: first what is followed, then the zero, then the load encoder's disc."""

    def __init__(self, model: TransmissionModel, parameters: Sequence[str] | None = None) -> None:
        """``parameters`` as in `AdaptationSettings`. InputError for one that the model does not have."""
        self.model = model
        self.terms = _terms(model, parameters)
        self.followed = sum(len(each.effect.coefficients()) for each in self.terms)
        """How many coefficients are followed."""
        self.zero = self.followed
        """The column of the zero."""
        self.count = self.followed + 1 + 2 * len(LOAD_ORDERS)
        """How many columns there are."""
        self.committed = np.concatenate([np.zeros(0), *(each.effect.coefficients() for each in self.terms)])
        """The committed coefficients, shape (followed,)."""
        self.remembers = np.zeros(self.count, dtype=bool)
        """The columns that only reversals show."""
        for each in self.terms:
            self.remembers[each.columns] = each.memory
        self._timeless = not any(each.needs() for each in model.effects)
        self.restart()

    @property
    def timeless(self) -> bool:
        """True when no effect needs more than the motor angle: any `Moment` will do."""
        return self._timeless

    def restart(self) -> None:
        """Forget the path: nothing is known of the gear's past."""
        followed = {each.place for each in self.terms}
        self._fixed = [
            _Both.of(effect) for place, effect in enumerate(self.model.effects) if place not in followed
        ]
        self._units = {
            at: _Both.of(_unit(each.effect, number))
            for each in self.terms
            if each.memory
            for number, at in enumerate(range(each.columns.start, each.columns.stop))
        }

    def advance(self, motor_deg: float, moment: Moment) -> None:
        """The command has come to this angle."""
        for each in (*self._fixed, *self._units.values()):
            each.advance(motor_deg, moment)

    def known(self) -> bool:
        """Whether the memories no longer depend on what was before `restart`."""
        return all(each.same for each in (*self._fixed, *self._units.values()))

    def state(self) -> tuple[float, ...]:
        """What only this moment has: the sum of what is not followed, and the columns with a memory."""
        return (sum(each.value for each in self._fixed), *(each.value for each in self._units.values()))

    def rows(self, motor_deg: FloatArray, states: FloatArray) -> FloatArray:
        """All columns at motor angles (n,), given what `state` was there, (n, s); shape (n, count)."""
        rows = np.zeros((len(motor_deg), self.count))
        rows[:, list(self._units)] = states[:, 1:]
        motion = Motion(motor_deg)
        for each in self.terms:
            if not each.memory:
                rows[:, each.columns] = each.effect.columns(motion)
        rows[:, self.zero] = 1.0
        load = np.deg2rad(motor_deg / self.model.ratio)
        rows[:, self.zero + 1 :] = cosines_and_sines(load, LOAD_ORDERS)
        return rows

    def changed(self, change: FloatArray) -> TransmissionModel:
        """The committed model with its followed coefficients changed by so much, (followed,)."""
        effects = list(self.model.effects)
        for each in self.terms:
            effects[each.place] = each.effect.fitted(each.effect.coefficients() + change[each.columns])
        return replace(self.model, effects=refreshed(effects), path=None)


class _Both:
    """An effect on line, from either direction that the axis may have had before, until both agree."""

    __slots__ = ("_other", "_tracker", "same", "value")

    def __init__(self, tracker: Tracker, other: Tracker | None) -> None:
        self._tracker = tracker
        self._other = other
        self.same = other is None
        self.value = 0.0

    @classmethod
    def of(cls, effect: Effect) -> _Both:
        """A fresh one."""
        tracker = effect.tracker(Start.FORWARD)
        return cls(tracker, None if isinstance(tracker, Memoryless) else effect.tracker(Start.BACKWARD))

    def advance(self, motor_deg: float, moment: Moment) -> None:
        self.value = self._tracker.advance(motor_deg, moment)
        if self._other is not None:
            other = self._other.advance(motor_deg, moment)
            if abs(other - self.value) <= SAME_ARCSEC:
                self.same, self._other = True, None


def _terms(model: TransmissionModel, parameters: Sequence[str] | None) -> tuple[Term, ...]:
    offered = {
        f"{each.name}.{name}": place for place, each in enumerate(model.effects) for name in each.drifting
    }
    wanted = list(offered) if parameters is None else parameters
    for each in wanted:
        if each not in offered:
            raise _unknown(each, offered)
    terms: list[Term] = []
    end = 0
    for place in sorted({offered[each] for each in wanted}):
        effect = model.effects[place]
        begin, end = end, end + len(effect.coefficients())
        memory = not isinstance(effect.tracker(), Memoryless)
        terms.append(Term(place, effect, slice(begin, end), memory))
    return tuple(terms)


def _unit(effect: Effect, number: int) -> Effect:
    """The effect with one coefficient of one and no other."""
    unit = np.zeros_like(effect.coefficients())
    unit[number] = 1.0
    return effect.fitted(unit)


def _unknown(name: str, offered: Iterable[str]) -> InputError:
    known = list(offered)
    close = nearest(name, known)
    hint = f"did you mean '{close}'?" if close else f"expected {', '.join(known) or 'none'}"
    return InputError(
        f"adaptation.parameters: '{name}' is nothing that wear or temperature moves in this model; {hint}"
    )
