"""What an axis did, as effects see it: channels, motions of whole records, moments of a control loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hdbridge.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


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
