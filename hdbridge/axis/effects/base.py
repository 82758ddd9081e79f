"""Base class of effects: one physical cause of transmission error, written once.

A single description serves to predict an effect over a whole record (vectorised), to track it on line (sample
by sample, in plain floats), to fit it (columns for its linear coefficients, at given shape parameters), to
propose it for a record, and to name it as a cause. Batch and on-line results are equal, which `tests/effects`
verifies for each effect.

An effect is a frozen pydantic model. Its fields are the parameters in the model file, each with its unit in
the name, a physical range and a description. The module does no I/O.

Speed, acceleration and direction are channels like any other. They are derived from the *uncompensated*
command (see `kinematics.py`), so effects that depend on them do not depend on the angle that the inverse is
trying. Otherwise the correction of one cycle would affect the speed in the next.
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
from hdbridge.strictness import Strict, complaint

GRID: Final[Mapping[int, int]] = {1: 6, 2: 4, 3: 3}
"""Grid points per shape parameter in the default proposals, by number of shape parameters."""


class Law(Strict, ABC):
    """Law of an effect, as needed by a model: the equation, in batch and on line, and its bounds."""

    name: ClassVar[str]
    """Canonical name, used in model files, findings and tests."""
    about: ClassVar[Cause]
    channels: ClassVar[frozenset[Channel]] = frozenset()
    """Channels usually required in addition to the motor angle; for those of an instance see `needs`."""
    compensable: ClassVar[Compensable]
    """Possibility of compensating effects of this kind, with the reason; see `is_compensable`."""
    shape: ClassVar[tuple[Shape, ...]] = ()
    """Shape parameters, in which the error is non-linear; `columns` covers the linear parameters."""

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error at the load in each sample, arcsec, shape (n,)."""
        error: FloatArray = self.columns(motion, start) @ self.coefficients()
        return error

    @abstractmethod
    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """Returns a new on-line tracker of this effect, with the same results as `predict`."""

    @abstractmethod
    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the design-matrix columns at the current shape parameters, shape (n, p).

        The prediction is ``columns @ coefficients``.
        """

    @abstractmethod
    def coefficients(self) -> FloatArray:
        """Returns the linear coefficients in the order of `columns`, shape (p,)."""

    @abstractmethod
    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns this effect with new coefficients and, if given, new shape parameters."""

    @abstractmethod
    def bound_arcsec(self) -> float:
        """Returns an upper bound of the absolute error, arcsec."""

    @abstractmethod
    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns an upper bound of the *fall* of the error with the motor angle, arcsec per motor degree.

        The compensation can invert a sum of effects if this bound is less than the gear's own slope of
        3600 / N. A hysteresis only rises along its path, so its bound is zero.
        """

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Returns an approximate tracker with a limited fall, for the inverse; None if the effect has none.

        Backlash has such a tracker: the error on either side of the gap is known, and the load's path across
        the gap, within a fraction of a motor degree, hardly matters.
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
    """Cause of transmission error: its law, and hints for a diagnosis, which all have defaults."""

    part: ClassVar[Part | None] = None
    """Part of a model that the effect constitutes."""
    changes: ClassVar[Part | None] = None
    """Part of a model that the effect modifies; None for an addition."""
    replaces: ClassVar[str] = ""
    """Name of the effect that this effect replaces in a model; empty for an addition."""
    carries: ClassVar[Mapping[Part, str]] = {}
    """Model parts that the effect scales, each with the name of the field that contains its copy."""
    typical: ClassVar[Mapping[str, Any]] = {}
    """Typical parameters, for `candidate`."""
    usual: ClassVar[int] = 1
    """Maximum number of similar instances on one axis. More point to a single cause outside the catalogue; 1
    permits no second instance."""
    nonnegative: ClassVar[bool] = False
    """True if the coefficients cannot be negative."""
    curved: ClassVar[bool] = False
    """True if the columns depend on the coefficients, so that a linear fit must be iterated."""
    sought: ClassVar[Sought | None] = None
    """Form of the matched filter that finds initial shape parameters, for effects with too many possible
    locations for a grid."""
    ordinary_arcsec: ClassVar[float] = 0.0
    """Peak error of this cause, or of one indistinguishable from it, on a healthy axis."""
    incidental: ClassVar[frozenset[str]] = frozenset()
    """Names of coefficients that are not evidence of the cause, because they can be non-zero without it."""
    inexact: ClassVar[float] = 0.0
    """Fraction of the effect's mean square that may appear as a smaller instance, because a real effect
    deviates from its law."""
    drifting: ClassVar[tuple[str, ...]] = ()
    """Parameters that drift over months with wear and temperature: either all parameters covered by
    `columns`, or none. Empty also if a fault of the load encoder alone could imitate such a drift."""

    @classmethod
    def candidate(cls, ratio: float, base: Sequence[Effect] = ()) -> Self:
        """Returns an effect of typical size for a gear ratio, as the initial value of a fit or for a plan.

        An effect that modulates orders or a loop contains copies of them, taken from the effects in ``base``
        or, if ``base`` has none, with typical values.
        """
        values = {**cls.typical, **cls._carried(base)}
        if "ratio" in cls.model_fields:
            values["ratio"] = ratio
        return cls(**values).tidied(ratio)

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        """Returns the fields that are copies of parts of the model ``base``."""
        return {}

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields candidates of this kind for a record and the model ``base``, over their shape parameters.

        Their coefficients are arbitrary. By default, they are `candidate` with shape parameters on a grid
        over their ranges. There is no candidate if the model lacks the part that the effect would scale.
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
        """Yields the effects that could cause a spectral line at this number of periods per load turn.

        See `Sought.LINE`.
        """
        return iter(())

    def implausible(self, observations: Observations) -> str:
        """Returns the reason why this instance is physically impossible, however well it fits; else empty."""
        return ""

    def unidentifiable(self, observations: Observations) -> str:
        """Returns the reason why this record cannot separate this instance from another cause; else empty.

        Such a cause is not reported, but it may be listed as an alias of a reported cause.
        """
        return ""

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the coordinate on which the effect depends, for plots; by default its first channel."""
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
        """Returns the samples that alone must show the effect; None if all samples may count."""
        return None

    def changing(self, motion: Motion) -> FloatArray | None:
        """Returns test columns that must have zero coefficients if the effect is as its law states, (n, k).

        Each column is either the change of the prediction if the coefficient changes by one at some point of
        the record and keeps the new value, or a similar effect nearby. The effect must have a single
        component. Returns None if such changes do not contradict the effect.
        """
        return None

    def scales(self) -> tuple[Part, Effect] | None:
        """Returns the model part that the effect scales, with an effect to plot; None if no plot shows it."""
        return None

    def pieces(self) -> tuple[Self, ...]:
        """Returns the components of the effect as separate effects, each with one order or step."""
        return (self,)

    def joined(self, other: Effect) -> Self | None:
        """Returns one effect that combines this one and ``other``; None if they remain separate."""
        return None

    def largest_piece_arcsec(self) -> float:
        """Returns the largest component's amplitude over its full range, even if a record covers only a part.

        Returns 0 for an effect that a record always shows in full.
        """
        return 0.0

    def symmetric_fraction(self, order: int) -> float:
        """Returns the fraction of a motor order that this effect leaves in the mean over both directions."""
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
        """Returns this cause if it can explain the change from ``before`` to ``now``, else None."""
        return None

    @classmethod
    def unmeasured(cls, ratio: float) -> Effect | None:
        """Returns the effect that this cause resembles if its channel is not measured, or None."""
        return None

    def reparametrised(
        self,
        now: Sequence[Effect],
        given: Sequence[Effect],
        observations: Observations,
    ) -> tuple[Effect, ...] | None:
        """Reparametrises ``now``, which contains this effect, to bring its parts closest to ``given``.

        Returns None if there is no alternative parametrisation.
        """
        return None

    def found_in(self, effects: Sequence[Effect]) -> Effect:
        """Returns the effect of this kind among ``effects``, by default this effect itself."""
        return next((each for each in effects if type(each) is type(self)), self)

    def tidied(self, ratio: float) -> Self:
        """Returns the effect in the form in which a model with this gear ratio stores it."""
        return self

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the possible deviations of a real effect from this law, arcsec, shape (n, k).

        Each column is one standard deviation of an independent deviation.
        """
        return np.empty((len(motion), 0))

    def violations(self) -> list[str]:
        """Describes the parameters that are outside their physical ranges; `fitted` does not reject them."""
        try:
            type(self).model_validate(self.parameters())
        except ValidationError as error:
            return [
                f"{'.'.join(map(str, each['loc']))} = {each['input']:.3g}"
                if isinstance(each["input"], float)
                else complaint(each, self.name)
                for each in error.errors()
            ]
        return []


class Linear(Effect):
    """Base class of effects whose coefficients are parameters, listed in `linear`.

    A subclass only defines `columns`, in the units of these parameters.
    """

    linear: ClassVar[tuple[str, ...]]
    """Parameters in which the error is linear, in column order."""

    def coefficients(self) -> FloatArray:
        """Returns the linear parameters in their units."""
        return np.array([getattr(self, each) for each in self.linear], dtype=np.float64)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(each, (i,), (each,)) for i, each in enumerate(self.linear))

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the effect with new linear parameters and, if given, new shape parameters."""
        values = dict(zip(self.linear, map(float, coefficients), strict=True))
        return self.model_copy(update={**values, **dict(shape or {})})


class Momentary(Effect):
    """Base class of effects without state, which depend only on the motor angle and the moment."""

    @abstractmethod
    def at(self, motor_deg: float, moment: Moment) -> float:
        """Returns the error at the load at one moment, arcsec; uses plain floats for the control loop."""

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Memoryless(self.at)


class Angleless(Momentary):
    """Base class of effects without state that depend only on the moment, not on the motor angle."""

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return Level(self.at)

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0


def missing_channels(
    effects: Iterable[Effect], available: frozenset[Channel]
) -> dict[str, frozenset[Channel]]:
    """Returns the missing channels of each effect that lacks any, by the name of the effect.

    ``available`` is `Motion.available()` for a record, or the channels that a control loop can supply. Check
    this before the axis moves. On line, a missing channel raises no error, because a `Moment` has defaults.
    """
    lacking = {each.name: each.needs() - available for each in effects}
    return {name: channels for name, channels in lacking.items() if channels}
