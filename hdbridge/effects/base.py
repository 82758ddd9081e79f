"""What an effect is: one physical cause of transmission error, written once.

From one description an effect is predicted over a whole record (vectorised), tracked on line (sample by
sample, in plain floats), fitted (columns that are linear in its coefficients, for given shape parameters),
proposed for a record, and named as a cause. Batch and on-line give the same numbers; `tests/effects` holds
every effect to it.

An effect is a frozen pydantic model: its fields are the parameters of the model file, with the unit in the
name, a physical range and a description. Nothing here does any I/O.

Speed, acceleration and direction are channels like any other: they are those of the *uncompensated* command
(`kinematics.py` defines them once), so an effect that depends on them does not depend on the angle that the
inverse is trying out. Otherwise one cycle's correction would be differenced into the next one's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, ClassVar, Final, Self

import numpy as np
from pydantic import ValidationError

from hdbridge.effects import coordinate as over
from hdbridge.effects.coordinate import Coordinate
from hdbridge.effects.described import (
    Cause,
    Coefficient,
    Compensable,
    Experiment,
    Moves,
    Part,
    Shape,
    Sought,
    Stretch,
)
from hdbridge.effects.motion import (
    AT_REST,
    MEASURED,
    SLOT,
    BoolArray,
    Channel,
    FloatArray,
    IntArray,
    Moment,
    Motion,
    Start,
    measured_by_all,
    missing_error,
    readings,
)
from hdbridge.effects.observations import Observations
from hdbridge.effects.tracker import Memoryless, Tracker
from hdbridge.strictness import Strict

__all__ = [
    "AT_REST",
    "MEASURED",
    "SLOT",
    "BoolArray",
    "Cause",
    "Channel",
    "Coefficient",
    "Compensable",
    "Coordinate",
    "Effect",
    "Experiment",
    "FloatArray",
    "IntArray",
    "Linear",
    "Memoryless",
    "Moment",
    "Motion",
    "Moves",
    "Observations",
    "Part",
    "Shape",
    "Sought",
    "Start",
    "Stretch",
    "Tracker",
    "measured_by_all",
    "missing_error",
    "readings",
    "unmet",
]

GRID: Final[Mapping[int, int]] = {1: 6, 2: 4, 3: 3}
"""Values of each shape that the default proposals try, by the number of shapes."""


class Effect(Strict, ABC):
    """One cause of transmission error with its parameters."""

    name: ClassVar[str]
    """The canonical name: in model files, findings and tests."""
    about: ClassVar[Cause]
    channels: ClassVar[frozenset[Channel]] = frozenset()
    """What it needs in addition to the motor angle as a rule; an instance's own needs: `needs`."""
    compensable: ClassVar[Compensable]
    """Whether the load really moves so, and can be told in advance; see `is_compensable`."""
    replaces: ClassVar[str] = ""
    """Name of the effect in whose place it stands in a model, where it does not add to the others."""
    part: ClassVar[Part | None] = None
    """The part of a model that it is."""
    changes: ClassVar[Part | None] = None
    """The part of a model that it is a change of, where it is no addition to it."""
    carries: ClassVar[Mapping[Part, str]] = {}
    """The parts that it carries a copy of, because it scales them, and the field that holds each."""
    usual: ClassVar[int] = 1
    """So many nearly equal ones an axis may have; more are one thing that is none of them. At 1 there is no
    second.
    """
    nonnegative: ClassVar[bool] = False
    """Whether no coefficient can be negative."""
    curved: ClassVar[bool] = False
    """Whether its columns depend on its coefficients: nearly linear, so that one fits, and fits again."""
    sought: ClassVar[Sought | None] = None
    """Its form, where no grid covers the places at which it may be: of its first shapes."""
    ordinary_arcsec: ClassVar[float] = 0.0
    """Peak that any healthy axis has of it, or of what cannot be distinguished from it."""
    incidental: ClassVar[frozenset[str]] = frozenset()
    """Names of coefficients that are no evidence of it: what they stand for is there without it, too."""
    inexact: ClassVar[float] = 0.0
    """Share of its square by which a real one may differ from the law here, in the form of a smaller one of
    its kind."""
    shape: ClassVar[tuple[Shape, ...]] = ()
    """Its non-linear parameters; all others are spoken for by `columns`."""
    typical: ClassVar[Mapping[str, Any]] = {}
    """Parameters of typical size, for `candidate`."""
    drifting: ClassVar[tuple[str, ...]] = ()
    """The parameters that wear and temperature move in months of work, and that no fault of the load encoder
    alone imitates: all of those that `columns` speaks for, or none.
    """

    @abstractmethod
    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec at the load for each sample, shape (n,)."""

    @abstractmethod
    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """A fresh on-line tracker of this effect; same numbers as `predict`."""

    @abstractmethod
    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Regressors, shape (n, p), for this effect's shape parameters: predict = columns @ coefficients."""

    @abstractmethod
    def coefficients(self) -> FloatArray:
        """The linear coefficients, arcsec, shape (p,), in the order of `columns`."""

    @abstractmethod
    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """This effect with other coefficients, and other shape parameters where given."""

    @abstractmethod
    def bound_arcsec(self) -> float:
        """A bound on the absolute error, arcsec."""

    @abstractmethod
    def slope_bound_arcsec_per_deg(self) -> float:
        """A bound on how steeply the error can *fall* with the motor angle, arcsec per motor degree.

        The compensation can invert a sum of effects while this stays below the gear's own slope of
        3600 / N. Hysteresis only ever rises along its path, so its bound is zero.
        """

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """A tracker that falls nowhere steeper than that, for the inverse; None where there is none.

        Play has one: on either side of it the error is what it is, and how the load gets across, within a
        fraction of a motor degree, hardly matters.
        """
        return None

    @classmethod
    def candidate(cls, ratio: float, base: Sequence[Effect] = ()) -> Self:
        """One of typical size for a gear of this ratio, to start a fit or a plan from.

        An effect that carries orders or a loop (because it modulates them) takes them from the effects in
        ``base``, or typical ones where these have none.
        """
        values = {**cls.typical, **cls._carried(base)}
        if "ratio" in cls.model_fields:
            values["ratio"] = ratio
        return cls(**values)

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:  # noqa: ARG003
        """Parameters that are copies of what a model has."""
        return {}

    # --- what it is like in a record

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Effects of this kind that a record with the model ``base`` may be screened for, over their shapes.

        Their coefficients are of no account. As a rule a grid over the ranges of `shape`, around `candidate`;
        nothing where the model lacks a part that it would scale.
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
    def at_lines(cls, periods_per_turn: int) -> Iterator[Self]:  # noqa: ARG003
        """Those that can be a line of so many periods per turn of the load; of what is sought as one."""
        return iter(())

    def implausible(self, observations: Observations) -> str:
        """Why this very effect cannot be, whatever a fit says, in words; else empty."""
        return ""

    def unidentifiable(self, observations: Observations) -> str:
        """Why such a record cannot tell this very effect from another cause, in words; else empty.

        It is not named there, but it may be an alias of what is.
        """
        return ""

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """What it depends on, over which a picture shows it; as a rule its first channel."""
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
        """Where it must be seen by itself, if that is not everywhere."""
        return None

    def changing(self, motion: Motion) -> FloatArray | None:
        """What it would add if its coefficient changed by one along the way or next to it, a column per place
        of change, shape (n, k), of an effect of one piece; None where that is no contradiction to it.
        """
        return None

    def scales(self) -> tuple[Part, Effect] | None:
        """The part of a model that it scales, where a picture can show it as a growth of that."""
        return None

    def pieces(self) -> tuple[Self, ...]:
        """What it is made of: one order, one step each."""
        return (self,)

    def joined(self, other: Effect) -> Self | None:
        """One effect that is both; None where the two stand side by side."""
        return None

    def largest_piece_arcsec(self) -> float:
        """Amplitude of the largest of its parts over all that it may do, seen or not; 0 where all is seen."""
        return 0.0

    def left_in_mean(self, order: int) -> float:
        """Share of an order of the motor that is left in the mean over both directions."""
        return 1.0

    def waves(self) -> tuple[tuple[float, float, float], ...]:
        """Of a sum of waves of the motor angle: periods per turn, amplitude (arcsec), phase (degrees)."""
        return ()

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        """What reports and files call its coefficients."""
        return tuple(
            Coefficient(f"coefficient_{i + 1}_arcsec", (i,), ()) for i in range(len(self.coefficients()))
        )

    @classmethod
    def of_change(cls, before: Effect, now: Effect) -> Self | None:  # noqa: ARG003
        """This cause, where it can be what has made ``now`` of ``before``; see `changes`."""
        return None

    @classmethod
    def unmeasured(cls, ratio: float) -> Effect | None:  # noqa: ARG003
        """What it looks like where its channel was not measured; None where that is nothing in particular."""
        return None

    def retold(
        self,
        now: Sequence[Effect],
        given: Sequence[Effect],
        observations: Observations,
    ) -> tuple[Effect, ...] | None:
        """``now``, of which it is one, told by another convention so that the parts are nearest to the
        model's, ``given``; None where there is nothing to be told otherwise.
        """
        return None

    def found_in(self, effects: Sequence[Effect]) -> Effect:
        """It as a model has it; itself where the model has none."""
        return next((each for each in effects if type(each) is type(self)), self)

    def tidied(self, ratio: float) -> Self:
        """As it goes into a model of this ratio."""
        return self

    def law_discrepancy(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """How a real one may differ from the law here, arcsec, a column per standard deviation, (n, k)."""
        return np.empty((len(motion), 0))

    # --- what it is in a file

    def parameters(self) -> dict[str, Any]:
        """The parameters as the model file has them."""
        return self.model_dump(mode="json")

    def needs(self) -> frozenset[Channel]:
        """The channels that this very effect needs, as its parameters have it."""
        return self.channels

    def is_compensable(self) -> bool:
        """Whether the compensation should make up for this very effect."""
        return self.compensable.possible

    def violations(self) -> list[str]:
        """Parameters outside their physical ranges, in words; `fitted` does not refuse them."""
        try:
            type(self).model_validate(self.parameters())
        except ValidationError as error:
            return [
                f"{'.'.join(map(str, each['loc'])) or self.name}: {each['msg']}" for each in error.errors()
            ]
        return []


class Linear(Effect):
    """Base for effects whose coefficients simply are some of their parameters: `linear` names them.

    `columns` is all that is left to write, in the unit of the parameters.
    """

    linear: ClassVar[tuple[str, ...]]
    """The parameters that the error is linear in, in the order of the columns."""

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec, shape (n,)."""
        error: FloatArray = self.columns(motion, start) @ self.coefficients()
        return error

    def coefficients(self) -> FloatArray:
        """The linear parameters, in their units."""
        return np.array([getattr(self, each) for each in self.linear], dtype=np.float64)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        """By the parameters."""
        return tuple(Coefficient(each, (i,), (each,)) for i, each in enumerate(self.linear))

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Other linear parameters, and other shape parameters where given."""
        values = dict(zip(self.linear, map(float, coefficients), strict=True))
        return self.model_copy(update={**values, **dict(shape or {})})


def unmet(effects: Iterable[Effect], available: frozenset[Channel]) -> dict[str, frozenset[Channel]]:
    """Per effect the channels that it needs and that are not there; empty when all is well.

    ``available`` is `Motion.available()` for a record, or what a control loop can supply. On line nothing
    complains later: a `Moment` has defaults, so ask before the axis moves.
    """
    lacking = {each.name: each.needs() - available for each in effects}
    return {name: channels for name, channels in lacking.items() if channels}
