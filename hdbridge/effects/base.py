"""What an effect is: one physical cause of transmission error, written once.

From one description an effect is predicted over a whole record (vectorised), tracked on line (sample by
sample, in plain floats), fitted (columns that are linear in its coefficients, for given shape parameters)
and named as a cause. Batch and on-line give the same numbers; `tests/effects` holds every effect to it.

An effect is a frozen pydantic model: its fields are the parameters of the model file, with the unit in the
name, a physical range and a description. Nothing here does any I/O.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

FloatArray = NDArray[np.float64]


class Channel(Enum):
    """A quantity that an effect needs to know besides the motor angle."""

    TIME = "time_s"
    LOAD_TORQUE = "load_torque_nm"
    MOTOR_TORQUE = "motor_torque_nm"
    TEMPERATURE = "temperature_c"


class Start(Enum):
    """What is known about the gear's past at the first sample.

    A saturated start is what a pre-conditioning move leaves behind: the axis last moved in that direction
    by more than any memory it has. A virgin start knows nothing and takes the elastic state as zero.
    """

    VIRGIN = 0
    FORWARD = 1
    BACKWARD = -1


class Moment(NamedTuple):
    """The channels of one control cycle; the motor angle is given apart, because the inverse varies it."""

    time_s: float = 0.0
    load_torque_nm: float = 0.0
    motor_torque_nm: float = 0.0
    temperature_c: float = 20.0


@dataclass(frozen=True, slots=True)
class Motion:
    """What an axis did: the inputs of a prediction, as arrays of one length.

    ``motor_deg`` is the *commanded* multi-turn motor angle where the record has it: a quantised encoder
    chatters at every reversal, and a hysteresis law with an infinite initial slope turns that into error.
    """

    motor_deg: FloatArray
    """Motor angle, degrees, multi-turn, shape (n,)."""
    time_s: FloatArray | None = None
    load_torque_nm: FloatArray | None = None
    motor_torque_nm: FloatArray | None = None
    temperature_c: FloatArray | None = None

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.motor_deg)


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


class Tracker(ABC):
    """An effect followed on line.

    `peek` answers "what would the error be at this motor angle, coming from the present state" as often as
    it is asked; only `advance` moves the state on.
    """

    __slots__ = ()

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
    """What it needs beside the motor angle."""
    shape: ClassVar[tuple[Shape, ...]] = ()
    """Its non-linear parameters; all others are spoken for by `columns`."""

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

    def parameters(self) -> dict[str, Any]:
        """The parameters as the model file has them."""
        return self.model_dump(mode="json")


class Memoryless(Tracker):
    """Base for the trackers of effects without state: to advance is to peek."""

    __slots__ = ()

    def advance(self, motor_deg: float, moment: Moment) -> float:
        """Same as `peek`."""
        return self.peek(motor_deg, moment)
