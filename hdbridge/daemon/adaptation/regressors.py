"""Linear problem of the adaptation: the adapted coefficients of a model and their columns.

``observed - committed prediction = columns @ change + nuisances``. The columns come from the effects
themselves: an effect without memory gives them for any angles; for one with memory, trackers of unit
coefficients follow the command, which by linearity is equivalent. Nuisance parameters are fitted as well and
never applied: the zero, and the once and twice per turn error of an eccentric or oval load encoder disc.
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
"""Orders per turn of the load: eccentricity and ovality of the encoder's disc."""
SAME_ARCSEC = 1e-6
"""The state is known once trackers from either previous direction agree within this."""


@dataclass(frozen=True, slots=True)
class Term:
    """An adapted effect."""

    place: int
    """Index in the model's effects."""
    effect: Effect
    """The committed effect."""
    columns: slice
    """Its coefficients among all adapted ones."""
    memory: bool
    """True if it has memory, so that only reversals show it."""


class Regressors:
    """Columns of one model: adapted coefficients, zero, load encoder disc."""

    def __init__(self, model: TransmissionModel, parameters: Sequence[str] | None = None) -> None:
        """``parameters`` as in `AdaptationSettings`; InputError for one that the model does not have."""
        self.model = model
        self.terms = _terms(model, parameters)
        self.followed = sum(len(each.effect.coefficients()) for each in self.terms)
        """Number of adapted coefficients."""
        self.zero = self.followed
        """Index of the zero's column."""
        self.count = self.followed + 1 + 2 * len(LOAD_ORDERS)
        """Total number of columns."""
        self.committed = np.concatenate([np.zeros(0), *(each.effect.coefficients() for each in self.terms)])
        """Committed coefficients, shape (followed,)."""
        self.remembers = np.zeros(self.count, dtype=bool)
        """Mask of the columns with memory."""
        for each in self.terms:
            self.remembers[each.columns] = each.memory
        self._timeless = not any(each.needs() for each in model.effects)
        self.restart()

    @property
    def timeless(self) -> bool:
        """True if no effect needs more than the motor angle, so that any `Moment` will do."""
        return self._timeless

    def restart(self) -> None:
        """Restarts the path with an unknown hysteresis state."""
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
        """Advances all trackers to this commanded angle."""
        for each in (*self._fixed, *self._units.values()):
            each.advance(motor_deg, moment)

    def known(self) -> bool:
        """Returns True if the trackers no longer depend on the state before `restart`."""
        return all(each.same for each in (*self._fixed, *self._units.values()))

    def state(self) -> tuple[float, ...]:
        """Returns the path-dependent values: the sum of effects not adapted, and columns with memory."""
        return (sum(each.value for each in self._fixed), *(each.value for each in self._units.values()))

    def rows(self, motor_deg: FloatArray, states: FloatArray) -> FloatArray:
        """Returns all columns at motor angles (n,), given `state` there, (n, s); shape (n, count)."""
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
        """Returns the committed model with its adapted coefficients changed, (followed,)."""
        effects = list(self.model.effects)
        for each in self.terms:
            effects[each.place] = each.effect.fitted(each.effect.coefficients() + change[each.columns])
        return replace(self.model, effects=refreshed(effects), path=None)


class _Both:
    """Two trackers of an effect, started in either direction, until both agree."""

    __slots__ = ("_other", "_tracker", "same", "value")

    def __init__(self, tracker: Tracker, other: Tracker | None) -> None:
        self._tracker = tracker
        self._other = other
        self.same = other is None
        self.value = 0.0

    @classmethod
    def of(cls, effect: Effect) -> _Both:
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
    """Returns the effect with one coefficient set to one and all others to zero."""
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
