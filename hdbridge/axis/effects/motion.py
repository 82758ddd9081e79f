"""Motion of an axis as input of effects: channels, the motion of a record, the moment of a control cycle."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hdbridge.errors import InputError
from hdbridge.units import without_unit

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


class Channel(Enum):
    """Quantity that effects use in addition to the motor angle; its value is the name of a record's column.

    This is the only table of measured channels. A channel added here is read from the drive, recorded, passed
    to effects and used by diagnoses without further changes of the code.
    """

    _value_: str
    about: str
    """Description of a measured channel; empty for a derived channel."""
    unit: str
    at_rest: float
    """Default reading of a measured channel."""
    axis_key: str
    """Key of the axis file that defines the channel's source; empty if every drive provides the channel."""

    def __new__(
        cls, column: str, about: str = "", unit: str = "", at_rest: float = 0.0, axis_key: str = ""
    ) -> Self:
        """Creates a row of the table; derived channels have only a column name."""
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
    """Motor speed of the command; derived from angle and time if not given."""
    ACCELERATION = "motor_acceleration_deg_s2"
    """Motor acceleration of the command; derived from angle and time if not given."""
    DIRECTION = "direction"
    """Direction of the last motion of the command, held at rest; always derived."""
    LOAD_ANGLE = "load_deg"
    """Predicted load angle: motor angle / N plus the model's error (never the noisy measured angle)."""

    @property
    def title(self) -> str:
        """Name of the channel in words, without the unit."""
        return without_unit(str(self.value)).removesuffix("_c").replace("_", " ")


MEASURED: Final = tuple(each for each in Channel if each.about)
"""Measured channels in the order of `Moment.measured`."""
SLOT: Final[Mapping[Channel, int]] = {each: slot for slot, each in enumerate(MEASURED)}
"""Index of each measured channel in `Moment.measured`."""
AT_REST: Final = tuple(each.at_rest for each in MEASURED)
"""Default readings of the measured channels, in the order of `MEASURED`."""


def readings(known: Mapping[Channel, float]) -> tuple[float, ...]:
    """Returns a value for `Moment.measured`: the known readings, with defaults for other channels."""
    return tuple(known.get(each, each.at_rest) for each in MEASURED)


class Start(Enum):
    """Elastic state of the gear at the first sample.

    A pre-conditioning move leaves a saturated state: the last motion was in that direction and longer than
    any memory of the gear. The virgin state is zero and assumes nothing about the earlier motion.
    """

    VIRGIN = 0
    FORWARD = 1
    BACKWARD = -1


class Moment(NamedTuple):
    """Channels of one control cycle, without the motor angle, which the inverse varies.

    `kinematics.Observer` creates a moment in each cycle from the command, including the derived channels.
    """

    time_s: float = 0.0
    measured: tuple[float, ...] = AT_REST
    """Readings of the measured channels, in the order of `MEASURED`; for their indices see `SLOT`."""
    motor_speed_deg_s: float = 0.0
    motor_acceleration_deg_s2: float = 0.0
    direction: int = 0
    """Direction of the last motion, 1 or -1; 0 before the first motion, when `Start` applies."""
    load_deg: float = 0.0
    """Predicted load angle, degrees of the load, multi-turn."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of an axis: the inputs of a prediction, as arrays of equal length.

    If the record contains the command, ``motor_deg`` is the *commanded* multi-turn motor angle. A quantised
    reading chatters at every reversal, and a hysteresis law with an infinite initial slope would convert the
    chatter into an error.
    """

    motor_deg: FloatArray
    """Motor angle, degrees, multi-turn, shape (n,)."""
    time_s: FloatArray | None = None
    measured: Mapping[Channel, FloatArray] = field(default_factory=dict)
    """Measured channels that are known, each of shape (n,)."""
    motor_speed_deg_s: FloatArray | None = None
    """Motor speed, if a better value is known than the differences of a quantised angle."""
    motor_acceleration_deg_s2: FloatArray | None = None
    load_deg: FloatArray | None = None
    """Predicted load angle, degrees. Only the load encoder's subdivisional error requires such accuracy."""

    def __len__(self) -> int:
        """Returns the number of samples."""
        return len(self.motor_deg)

    def available(self) -> frozenset[Channel]:
        """Returns the channels that these arrays provide, including derived ones."""
        found = {each for each in Channel if self._given(each) is not None}
        found.add(Channel.DIRECTION)
        if self.time_s is not None:
            found |= {Channel.SPEED, Channel.ACCELERATION}
        return frozenset(found)

    def channel(self, channel: Channel, effect: str) -> FloatArray:
        """Returns a channel, shape (n,); if it is missing, raises `InputError` that names ``effect``."""
        values = self._given(channel)
        if values is None:
            raise missing_error(effect, frozenset({channel}))
        return values

    def _given(self, channel: Channel) -> FloatArray | None:
        if channel in SLOT:
            return self.measured.get(channel)
        values: FloatArray | None = getattr(self, channel.value, None)
        return values


def missing_error(effect: str, channels: frozenset[Channel]) -> InputError:
    """Returns the `InputError` for channels that an effect needs and a record lacks."""
    names = ", ".join(sorted(each.value for each in channels))
    return InputError(
        f"the effect '{effect}' needs the channel {names}, which is missing; "
        "record it (a column of that name), or leave the effect out of the model"
    )
