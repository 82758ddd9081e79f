"""What an effect is: one physical cause of transmission error, written once.

From one description an effect is predicted over a whole record (vectorised), tracked on line (sample by
sample, in plain floats), fitted (columns that are linear in its coefficients, for given shape parameters)
and named as a cause. Batch and on-line give the same numbers; `tests/effects` holds every effect to it.

An effect is a frozen pydantic model: its fields are the parameters of the model file, with the unit in the
name, a physical range and a description. Nothing here does any I/O.

Speed, acceleration and direction are channels like any other: they are those of the *uncompensated* command
(`kinematics.py` defines them once), so an effect that depends on them does not depend on the angle that the
inverse is trying out. Otherwise one cycle's correction would be differenced into the next one's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from hdbridge.errors import InputError

FloatArray = NDArray[np.float64]


class Channel(Enum):
    """A quantity that an effect needs to know besides the motor angle; its value is its column in a record.

    This is the one table of measured channels: a row here is read from the drive, recorded, handed to effects
    and offered to a diagnosis without any further edit.
    """

    _value_: str
    about: str
    """A measured one in words; empty for all others."""
    unit: str
    at_rest: float
    """What stands in where a measured one is not known."""
    axis_key: str
    """The key of the axis file that says where it comes from; empty where every drive tells it."""

    def __new__(
        cls, column: str, about: str = "", unit: str = "", at_rest: float = 0.0, axis_key: str = ""
    ) -> Self:
        """A row of the table; derived channels have a column only."""
        self = object.__new__(cls)
        self._value_, self.about, self.unit, self.at_rest, self.axis_key = (
            column,
            about,
            unit,
            at_rest,
            axis_key,
        )
        return self

    LOAD_TORQUE = "load_torque_nm", "torque at the load", "Nm", 0.0, "load_torque"
    MOTOR_TORQUE = "motor_torque_nm", "torque of the motor", "Nm"
    TEMPERATURE = "temperature_c", "temperature of the gear", "\N{DEGREE SIGN}C", 20.0, "temperature"

    TIME = "time_s"
    SPEED = "motor_speed_deg_s"
    """Of the command; derived from angle and time where it is not given."""
    ACCELERATION = "motor_acceleration_deg_s2"
    """Of the command; derived from angle and time where it is not given."""
    DIRECTION = "direction"
    """Sign of the last motion of the command, held at rest; always derived."""
    LOAD_ANGLE = "load_deg"
    """Predicted load angle: motor angle / N plus the model's error (never the noisy measured one)."""

    @property
    def title(self) -> str:
        """Its name in words, without the unit."""
        return str(self.value).rpartition("_")[0].replace("_", " ")


MEASURED: Final = tuple(each for each in Channel if each.about)
"""The measured channels, in the order in which a `Moment` has them."""
SLOT: Final[Mapping[Channel, int]] = {each: slot for slot, each in enumerate(MEASURED)}
"""Where each measured channel stands in `Moment.measured`."""
AT_REST: Final = tuple(each.at_rest for each in MEASURED)
"""Readings where none is known."""


def readings(known: Mapping[Channel, float]) -> tuple[float, ...]:
    """`Moment.measured` of what is known; the rest as at rest."""
    return tuple(known.get(each, each.at_rest) for each in MEASURED)


class Start(Enum):
    """What is known about the gear's past at the first sample.

    A saturated start is what a pre-conditioning move leaves behind: the axis last moved in that direction
    by more than any memory it has. A virgin start knows nothing and takes the elastic state as zero.
    """

    VIRGIN = 0
    FORWARD = 1
    BACKWARD = -1


class Moment(NamedTuple):
    """The channels of one control cycle; the motor angle is given apart, because the inverse varies it.

    `kinematics.Observer` makes one per cycle from the command, with the derived channels filled in.
    """

    time_s: float = 0.0
    measured: tuple[float, ...] = AT_REST
    """Readings of the channels in `MEASURED`, in that order; `SLOT` says where each stands."""
    motor_speed_deg_s: float = 0.0
    motor_acceleration_deg_s2: float = 0.0
    direction: int = 0
    """1 or -1, held at rest; 0 before the first motion: then what `Start` says counts."""
    load_deg: float = 0.0
    """Predicted load angle, degrees of the load, multi-turn."""


@dataclass(frozen=True, slots=True)
class Motion:
    """What an axis did: the inputs of a prediction, as arrays of one length.

    ``motor_deg`` is the *commanded* multi-turn motor angle where the record has it: a quantised encoder
    chatters at every reversal, and a hysteresis law with an infinite initial slope turns that into error.
    """

    motor_deg: FloatArray
    """Motor angle, degrees, multi-turn, shape (n,)."""
    time_s: FloatArray | None = None
    measured: Mapping[Channel, FloatArray] = field(default_factory=dict)
    """The measured channels that are known (`MEASURED`), each of shape (n,)."""
    motor_speed_deg_s: FloatArray | None = None
    """Given where something better is known than differences of a quantised angle."""
    motor_acceleration_deg_s2: FloatArray | None = None
    load_deg: FloatArray | None = None
    """Predicted load angle, degrees of the load; only the load encoder's own lines need it so exactly."""

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.motor_deg)

    def available(self) -> frozenset[Channel]:
        """The channels that these arrays give, derived ones included."""
        found = {each for each in Channel if self._given(each) is not None}
        found.add(Channel.DIRECTION)
        if self.time_s is not None:
            found |= {Channel.SPEED, Channel.ACCELERATION}
        return frozenset(found)

    def channel(self, channel: Channel, effect: str) -> FloatArray:
        """A channel as given, shape (n,); InputError where it is not, naming the effect that asks."""
        values = self._given(channel)
        if values is None:
            raise missing_error(effect, frozenset({channel}))
        return values

    def _given(self, channel: Channel) -> FloatArray | None:
        if channel in SLOT:
            return self.measured.get(channel)
        values: FloatArray | None = getattr(self, channel.value, None)
        return values


def measured_by_all(parts: Sequence[Mapping[Channel, FloatArray]]) -> dict[Channel, FloatArray]:
    """The measured channels that every part has, the parts one after the other."""
    common = [each for each in MEASURED if all(each in part for part in parts)]
    return {each: np.concatenate([part[each] for part in parts]) for each in common}


def missing_error(effect: str, channels: frozenset[Channel]) -> InputError:
    """The one complaint about channels that are not there."""
    names = ", ".join(sorted(each.value for each in channels))
    return InputError(
        f"the effect '{effect}' needs the channel {names}, which is not there; "
        "record it (a column of that name), or leave the effect out of the model"
    )


@dataclass(frozen=True, slots=True)
class Shape:
    """A parameter that the effect is *not* linear in, with the range in which a fit may look for it."""

    name: str
    lower: float
    upper: float
    logarithmic: bool = False
    """True where the fit should step in the logarithm (widths, time constants)."""


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


@dataclass(frozen=True, slots=True)
class Compensable:
    """Whether the compensation should make up for an effect, and why (not)."""

    possible: bool
    why: str


class Tracker(ABC):
    """An effect followed on line.

    `peek` answers "what would the error be at this motor angle, coming from the present state" as often as
    it is asked; only `advance` moves the state on.
    """

    __slots__ = ()

    @property
    def memory_deg(self) -> float:
        """Motor angle that, run in one direction, makes the state independent of where it began.

        0 where the path is not remembered at all. Memory of time (creep, warmth) does not count.
        """
        return 0.0

    @abstractmethod
    def peek(self, motor_deg: float, moment: Moment) -> float:
        """Error in arcsec at the load if the motor moved straight to ``motor_deg``; changes nothing."""

    @abstractmethod
    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Move to ``motor_deg``, keep the new state and return the error in arcsec at the load."""


class Effect(BaseModel, ABC):
    """One cause of transmission error with its parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: ClassVar[str]
    """The canonical name: in model files, findings and tests."""
    about: ClassVar[Cause]
    channels: ClassVar[frozenset[Channel]] = frozenset()
    """What it needs in addition to the motor angle as a rule; an instance's own needs: `needs`."""
    compensable: ClassVar[Compensable]
    """Whether the load really moves so, and can be told in advance; see `is_compensable`."""
    replaces: ClassVar[str] = ""
    """Name of the effect in whose place it stands in a model, where it does not add to the others."""
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


class Memoryless(Tracker):
    """Base for the trackers of effects without state: to advance is to peek."""

    __slots__ = ()

    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Same as `peek`."""
        return self.peek(motor_deg, moment)
