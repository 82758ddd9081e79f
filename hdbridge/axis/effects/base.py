"""Base class of effects: one physical cause of transmission error, written once.

From one description an effect is predicted over a whole record (vectorised), tracked on line (sample by
sample, in plain floats), fitted (columns that are linear in its coefficients, for given shape parameters),
proposed for a record, and named as a cause. Batch and on-line results are equal; `tests/effects` verifies
this for every effect.

An effect is a frozen pydantic model: its fields are the parameters of the model file, with the unit in the
name, a physical range and a description. Nothing here does any I/O.

Speed, acceleration and direction are channels like any other. They are those of the *uncompensated* command
(`kinematics.py` defines them once), so an effect that depends on them does not depend on the angle that the
inverse is trying. Otherwise the correction of one cycle would be differenced into the next.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, ClassVar, Final, Self

import numpy as np
from pydantic import ValidationError

from hdbridge.axis.effects import coordinate as over
from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import (
    Cause,
    Coefficient,
    Compensable,
    Level,
    Memoryless,
    Moves,
    Observations,
    Part,
    Shape,
    Sought,
    Stretch,
    Tracker,
)
from hdbridge.axis.effects.motion import MEASURED, Channel, FloatArray, Moment, Motion, Start
from hdbridge.strictness import Strict

GRID: Final[Mapping[int, int]] = {1: 6, 2: 4, 3: 3}
"""Grid points per shape parameter in the default proposals, by the number of shape parameters."""


class Law(Strict, ABC):
    """Law of an effect, as every model needs it: its equation, on a record and on line, and its bounds."""

    name: ClassVar[str]
    """Canonical name, used in model files, findings and tests."""
    about: ClassVar[Cause]
    channels: ClassVar[frozenset[Channel]] = frozenset()
    """Channels usually needed in addition to the motor angle; `needs` gives those of an instance."""
    compensable: ClassVar[Compensable]
    """Decision to compensate it or not, with the reason; see `is_compensable`."""
    shape: ClassVar[tuple[Shape, ...]] = ()
    """Non-linear parameters; `columns` covers all others."""

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error at the load for each sample, arcsec, shape (n,)."""
        error: FloatArray = self.columns(motion, start) @ self.coefficients()
        return error

    @abstractmethod
    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """Returns a new on-line tracker of this effect, with the same results as `predict`."""

    @abstractmethod
    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the regressors for the present shape parameters, shape (n, p): predict = columns @
        coefficients.
        """

    @abstractmethod
    def coefficients(self) -> FloatArray:
        """Returns the linear coefficients in the order of `columns`, arcsec, shape (p,)."""

    @abstractmethod
    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns this effect with other coefficients and, if given, other shape parameters."""

    @abstractmethod
    def bound_arcsec(self) -> float:
        """Returns a bound on the absolute error, arcsec."""

    @abstractmethod
    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns a bound on how steeply the error can *fall* with the motor angle, arcsec per motor degree.

        The compensation can invert a sum of effects if this stays below the gear's own slope of 3600 / N.
        Hysteresis only rises along its path, so its bound is zero.
        """

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Returns a tracker for the inverse that falls no more steeply than this, or None without one.

        Backlash has one: the error on either side of the gap is known, and the path of the load across it,
        within a fraction of a motor degree, hardly matters.
        """
        return None

    def parameters(self) -> dict[str, Any]:
        """Returns the parameters as stored in the model file."""
        return self.model_dump(mode="json")

    def needs(self) -> frozenset[Channel]:
        """Returns the channels that this instance needs, given its parameters."""
        return self.channels

    def is_compensable(self) -> bool:
        """Returns True if the compensation should correct this instance."""
        return self.compensable.possible


class Effect(Law):
    """A cause of transmission error: its law, and hints for a diagnosis, each of which has a default."""

    part: ClassVar[Part | None] = None
    """Part of a model that it constitutes."""
    changes: ClassVar[Part | None] = None
    """Part of a model that it modifies, if it is not an addition."""
    replaces: ClassVar[str] = ""
    """Name of the effect that it replaces in a model, if it does not add to the others."""
    carries: ClassVar[Mapping[Part, str]] = {}
    """Parts that it carries a copy of, because it scales them, and the field that holds each."""
    typical: ClassVar[Mapping[str, Any]] = {}
    """Typical parameters, for `candidate`."""
    usual: ClassVar[int] = 1
    """Maximum number of similar instances on one axis; more point to a single cause outside the catalogue. At
    1 there is never a second.
    """
    nonnegative: ClassVar[bool] = False
    """True if no coefficient can be negative."""
    curved: ClassVar[bool] = False
    """True if its columns depend on its coefficients, so that a linear fit must be iterated."""
    sought: ClassVar[Sought | None] = None
    """Form for a matched-filter search over its first shape parameters, if no grid covers the possible
    locations.
    """
    ordinary_arcsec: ClassVar[float] = 0.0
    """Peak amplitude on a healthy axis, of this cause or an indistinguishable one."""
    incidental: ClassVar[frozenset[str]] = frozenset()
    """Names of coefficients that are no evidence for the cause, because they are also non-zero without it."""
    inexact: ClassVar[float] = 0.0
    """Share of its power that may appear as a smaller instance: a real effect deviates from its law."""
    drifting: ClassVar[tuple[str, ...]] = ()
    """Parameters that wear and temperature change over months and that no load encoder fault alone imitates.

    Either all parameters that `columns` covers, or none.
    """

    @classmethod
    def candidate(cls, ratio: float, base: Sequence[Effect] = ()) -> Self:
        """Returns an effect of typical size for a gear ratio, as the start of a fit or a plan.

        An effect that carries orders or a loop (because it modulates them) takes them from the effects in
        ``base``, or typical ones if there are none.
        """
        values = {**cls.typical, **cls._carried(base)}
        if "ratio" in cls.model_fields:
            values["ratio"] = ratio
        return cls(**values).tidied(ratio)

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        """Returns the parameters that are copies of parts of a model."""
        return {}

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields effects of this kind to screen a record for, given the model ``base``, over their shape
        parameters.

        Their coefficients are arbitrary. The default is a grid over the ranges of `shape`, around
        `candidate`; nothing if the model lacks a part that the effect would scale.
        """
        if not set(cls.carries) <= {each.part for each in base} | {Part.GROWTH}:
            return
        typical = cls.candidate(observations.ratio, base)
        moved = [each for each in cls.shape if each.moves is not Moves.NEVER and cls.sought is None]
        points = GRID.get(len(moved), 2)
        for values in product(*(each.grid(points) for each in moved)):
            shape = {each.name: value for each, value in zip(moved, values, strict=True)}
            yield typical.fitted(typical.coefficients(), shape)

    @classmethod
    def at_lines(cls, periods_per_turn: int) -> Iterator[Self]:
        """Yields the effects that can appear as a spectral line at this many periods per load turn, for
        `Sought.LINE`.
        """
        return iter(())

    def implausible(self, observations: Observations) -> str:
        """Returns the reason why this instance is physically impossible, whatever a fit says; else empty."""
        return ""

    def unidentifiable(self, observations: Observations) -> str:
        """Returns the reason why such a record cannot separate this instance from another cause; else empty.

        It is then not named, but it may be listed as an alias of the named cause.
        """
        return ""

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the quantity that the effect depends on, for plots; by default its first channel."""
        needs = self.needs()
        for channel in MEASURED:
            if channel in needs:
                return over.measured(motion, channel)
        for channel, values in (
            (Channel.SPEED, over.speed),
            (Channel.ACCELERATION, over.acceleration),
            (Channel.TIME, over.time),
        ):
            if channel in needs:
                return values(motion)
        if Channel.LOAD_ANGLE in needs:
            return over.load_angle(motion, ratio)
        return over.since_reversal(motion) if self.tracker().memory_deg else over.motor_angle(motion)

    def shows(self, motion: Motion) -> Stretch | None:
        """Returns the samples at which it must be visible on its own; None for all."""
        return None

    def changing(self, motion: Motion) -> FloatArray | None:
        """Returns the change of the prediction if the coefficient changed by one along the record or next to
        it.

        One column per location of a change, shape (n, k), for an effect with one piece; None if such a change
        does not contradict the effect.
        """
        return None

    def scales(self) -> tuple[Part, Effect] | None:
        """Returns the part of a model that it scales, if a plot can show it as growth of that part."""
        return None

    def pieces(self) -> tuple[Self, ...]:
        """Returns its components, for example one order or one step each."""
        return (self,)

    def joined(self, other: Effect) -> Self | None:
        """Returns one effect that combines both; None if the two stay separate."""
        return None

    def largest_piece_arcsec(self) -> float:
        """Returns the amplitude of the largest component over its full range, observed or not; 0 if all is
        observed.
        """
        return 0.0

    def left_in_mean(self, order: int) -> float:
        """Returns the share of a motor order that remains in the mean over both directions."""
        return 1.0

    def waves(self) -> tuple[tuple[float, float, float], ...]:
        """Returns its waves of the motor angle: periods per turn, amplitude (arcsec), phase (degrees)."""
        return ()

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        """Returns the names of its coefficients for reports and files."""
        return tuple(
            Coefficient(f"coefficient_{i + 1}_arcsec", (i,), ()) for i in range(len(self.coefficients()))
        )

    @classmethod
    def of_change(cls, before: Effect, now: Effect) -> Self | None:
        """Returns this cause if it can explain a change of ``before`` into ``now``, else None;
        see `changes`.
        """
        return None

    @classmethod
    def unmeasured(cls, ratio: float) -> Effect | None:
        """Returns its appearance if its channel was not measured; None if there is no characteristic one."""
        return None

    def retold(
        self,
        now: Sequence[Effect],
        given: Sequence[Effect],
        observations: Observations,
    ) -> tuple[Effect, ...] | None:
        """Returns ``now``, which contains this effect, reparametrised so that its parts are nearest to
        ``given``.

        None if there is no alternative parametrisation.
        """
        return None

    def found_in(self, effects: Sequence[Effect]) -> Effect:
        """Returns the model's instance of this effect, or itself if the model has none."""
        return next((each for each in effects if type(each) is type(self)), self)

    def tidied(self, ratio: float) -> Self:
        """Returns the effect as it is stored in a model of this ratio."""
        return self

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns possible deviations of a real effect from this law, arcsec, one column per standard
        deviation, (n, k).
        """
        return np.empty((len(motion), 0))

    def violations(self) -> list[str]:
        """Describes the parameters outside their physical ranges, which `fitted` does not refuse."""
        try:
            type(self).model_validate(self.parameters())
        except ValidationError as error:
            return [
                f"{'.'.join(map(str, each['loc']))} = {each['input']:.3g}"
                if isinstance(each["input"], float)
                else f"{'.'.join(map(str, each['loc'])) or self.name}: {each['msg']}"
                for each in error.errors()
            ]
        return []


class Linear(Effect):
    """Base class of effects whose coefficients are some of their parameters, listed in `linear`.

    A subclass only has to define `columns`, in the units of these parameters.
    """

    linear: ClassVar[tuple[str, ...]]
    """Parameters that the error is linear in, in the order of the columns."""

    def coefficients(self) -> FloatArray:
        """Returns the linear parameters in their units."""
        return np.array([getattr(self, each) for each in self.linear], dtype=np.float64)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(each, (i,), (each,)) for i, each in enumerate(self.linear))

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the effect with other linear parameters and, if given, other shape parameters."""
        values = dict(zip(self.linear, map(float, coefficients), strict=True))
        return self.model_copy(update={**values, **dict(shape or {})})


class Momentary(Effect):
    """Base class of effects without state: angle and moment alone decide."""

    @abstractmethod
    def at(self, motor_deg: float, moment: Moment) -> float:
        """Returns the error at the load at one moment, arcsec, in plain floats for the control loop."""

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Memoryless(self.at)


class Angleless(Momentary):
    """Base class of effects that depend on the moment alone, not on the motor angle."""

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Level(self.at)

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0


def unmet(effects: Iterable[Effect], available: frozenset[Channel]) -> dict[str, frozenset[Channel]]:
    """Returns the missing channels of each effect; empty if all are available.

    ``available`` is `Motion.available()` for a record, or the channels that a control loop can supply. Check
    before the axis moves: on line a missing channel raises no error, because a `Moment` has defaults.
    """
    lacking = {each.name: each.needs() - available for each in effects}
    return {name: channels for name, channels in lacking.items() if channels}
