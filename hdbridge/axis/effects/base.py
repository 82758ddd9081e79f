"""Base class of effects: one physical cause of transmission error, written once.

From one description an effect is predicted over a whole record (vectorised), tracked on line (sample by
sample, in plain floats), fitted (columns that are linear in its coefficients, for given shape parameters),
proposed for a record, and named as a cause. Batch and on-line results are equal, as `tests/effects` verifies
for every effect.

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
"""Grid points per shape parameter in the default proposals, by number of shape parameters."""


class Law(Strict, ABC):
    """Law of an effect, as required by every model: its equation, in batch and on line, and its bounds."""

    name: ClassVar[str]
    """Canonical name, used in model files, findings and tests."""
    about: ClassVar[Cause]
    channels: ClassVar[frozenset[Channel]] = frozenset()
    """Channels usually required in addition to the motor angle; `needs` returns those of an instance."""
    compensable: ClassVar[Compensable]
    """Decision whether to compensate the effect, with the reason; see `is_compensable`."""
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
        """Returns the regressors at the present shape parameters, shape (n, p); predict = columns @
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
        """Returns a bound on the steepest *fall* of the error with the motor angle, arcsec per motor degree.

        The compensation can invert a sum of effects if this bound stays below the gear's own slope of 3600 /
        N. A hysteresis only rises along its path, so its bound is zero.
        """

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Returns a tracker for the inverse that falls no more steeply than this; None without one.

        Backlash has one, because the error on either side of the gap is known, and the load's path across it,
        within a fraction of a motor degree, hardly matters.
        """
        return None

    def parameters(self) -> dict[str, Any]:
        """Returns the parameters as stored in the model file."""
        return self.model_dump(mode="json")

    def needs(self) -> frozenset[Channel]:
        """Returns the channels required by this instance with its parameters."""
        return self.channels

    def is_compensable(self) -> bool:
        """Returns True if the compensation should correct this instance."""
        return self.compensable.possible


class Effect(Law):
    """Cause of transmission error: its law, and hints for a diagnosis, all of which have defaults."""

    part: ClassVar[Part | None] = None
    """Part of a model that the effect constitutes."""
    changes: ClassVar[Part | None] = None
    """Part of a model that the effect modifies; None for an addition."""
    replaces: ClassVar[str] = ""
    """Name of the effect that it replaces in a model; empty for an addition."""
    carries: ClassVar[Mapping[Part, str]] = {}
    """Copies of the parts that it scales: each part, and the field that holds its copy."""
    typical: ClassVar[Mapping[str, Any]] = {}
    """Typical parameters, for `candidate`."""
    usual: ClassVar[int] = 1
    """Maximum number of similar instances on one axis. More point to a single cause outside the catalogue; 1
    permits no second instance."""
    nonnegative: ClassVar[bool] = False
    """True if coefficients cannot be negative."""
    curved: ClassVar[bool] = False
    """True if its columns depend on its coefficients, so that a linear fit must be iterated."""
    sought: ClassVar[Sought | None] = None
    """Form for a matched-filter search over the first shape parameters, if no grid covers the possible
    locations."""
    ordinary_arcsec: ClassVar[float] = 0.0
    """Peak amplitude on a healthy axis, of this cause or an indistinguishable one."""
    incidental: ClassVar[frozenset[str]] = frozenset()
    """Names of coefficients that are no evidence of the cause, because they are non-zero without it."""
    inexact: ClassVar[float] = 0.0
    """Share of the effect's power that may appear as a smaller instance, because a real effect deviates from
    its law."""
    drifting: ClassVar[tuple[str, ...]] = ()
    """Parameters that wear and temperature change over months and that no load encoder fault alone imitates:
    either all parameters covered by `columns`, or none."""

    @classmethod
    def candidate(cls, ratio: float, base: Sequence[Effect] = ()) -> Self:
        """Returns an effect of typical size for a gear ratio, as the start of a fit or a plan.

        An effect that carries orders or a loop (because it modulates them) copies them from the effects in
        ``base``; without them, it carries typical values.
        """
        values = {**cls.typical, **cls._carried(base)}
        if "ratio" in cls.model_fields:
            values["ratio"] = ratio
        return cls(**values).tidied(ratio)

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        """Returns the parameters that are copies of parts of the model ``base``."""
        return {}

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields candidates of this kind for a record and the model ``base``, over their shape parameters.

        Their coefficients are arbitrary. The default is a grid over the ranges of `shape`, around
        `candidate`; it is empty if the model lacks a part that the effect would scale.
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
        """Yields the effects that could cause a spectral line at this many periods per load turn
        (`Sought.LINE`).
        """
        return iter(())

    def implausible(self, observations: Observations) -> str:
        """Returns the reason why this instance is physically impossible, whatever the fit; else empty."""
        return ""

    def unidentifiable(self, observations: Observations) -> str:
        """Returns the reason why this instance is not separable from another cause in such a record; else
        empty.

        The cause is then not reported, but may be listed as an alias of the reported cause.
        """
        return ""

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the quantity on which the effect depends, for plots; by default its first channel."""
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
        """Returns the samples at which the effect must be visible on its own; None for all samples."""
        return None

    def changing(self, motion: Motion) -> FloatArray | None:
        """Returns the change of the prediction if the coefficient changed by one along the record or beside
        the effect.

        One column per location of the change, shape (n, k), for an effect with one piece; None if such a
        change does not contradict the effect.
        """
        return None

    def scales(self) -> tuple[Part, Effect] | None:
        """Returns the part of a model that the effect scales, if a plot can show its growth."""
        return None

    def pieces(self) -> tuple[Self, ...]:
        """Returns the components of the effect, for example one order or one step each."""
        return (self,)

    def joined(self, other: Effect) -> Self | None:
        """Returns one effect that combines both; None if the two remain separate."""
        return None

    def largest_piece_arcsec(self) -> float:
        """Returns the amplitude of the largest component over its full range, observed or not; 0 if observed
        in full.
        """
        return 0.0

    def left_in_mean(self, order: int) -> float:
        """Returns the share of a motor order that remains in the mean over both directions."""
        return 1.0

    def waves(self) -> tuple[tuple[float, float, float], ...]:
        """Returns the waves of the motor angle: periods per turn, amplitude (arcsec), phase (degrees)."""
        return ()

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        """Returns the names of the coefficients for reports and files."""
        return tuple(
            Coefficient(f"coefficient_{i + 1}_arcsec", (i,), ()) for i in range(len(self.coefficients()))
        )

    @classmethod
    def of_change(cls, before: Effect, now: Effect) -> Self | None:
        """Returns this cause if it can explain the change of ``before`` to ``now``, else None; see
        `changes`.
        """
        return None

    @classmethod
    def unmeasured(cls, ratio: float) -> Effect | None:
        """Returns its characteristic appearance if its channel was not measured; None if it has none."""
        return None

    def retold(
        self,
        now: Sequence[Effect],
        given: Sequence[Effect],
        observations: Observations,
    ) -> tuple[Effect, ...] | None:
        """Returns ``now``, which contains this effect, reparametrised so that its parts are closest to
        ``given``.

        None if there is no alternative parametrisation.
        """
        return None

    def found_in(self, effects: Sequence[Effect]) -> Effect:
        """Returns the model's instance of this effect; the effect itself if the model has no instance."""
        return next((each for each in effects if type(each) is type(self)), self)

    def tidied(self, ratio: float) -> Self:
        """Returns the effect in the form in which a model of this ratio stores it."""
        return self

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the possible deviations of a real effect from this law, arcsec, (n, k).

        One column per standard deviation.
        """
        return np.empty((len(motion), 0))

    def violations(self) -> list[str]:
        """Describes the parameters outside their physical ranges, which `fitted` does not reject."""
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

    A subclass only needs to define `columns`, in the units of these parameters.
    """

    linear: ClassVar[tuple[str, ...]]
    """Parameters in which the error is linear, in column order."""

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
    """Base class of effects without state, determined by angle and moment alone."""

    @abstractmethod
    def at(self, motor_deg: float, moment: Moment) -> float:
        """Returns the error at the load at one moment, arcsec, in plain floats for the control loop."""

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Memoryless(self.at)


class Angleless(Momentary):
    """Base class of effects determined by the moment alone, not by the motor angle."""

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Level(self.at)

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0


def unmet(effects: Iterable[Effect], available: frozenset[Channel]) -> dict[str, frozenset[Channel]]:
    """Returns the missing channels of each effect; empty if all are available.

    ``available`` is `Motion.available()` for a record, or the channels that a control loop can supply. Check
    this before the axis moves, because on line a missing channel does not raise an error: a `Moment` has
    defaults.
    """
    lacking = {each.name: each.needs() - available for each in effects}
    return {name: channels for name, channels in lacking.items() if channels}
