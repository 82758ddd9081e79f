"""Optional measured channels of the axis file, in addition to the encoders.

Each channel is an object of the drive, received by PDO. It has a unit, a plausible range, and a time for
which the last reading is held. `hdbridge.drive.channels` tracks the channels on line.
"""

from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple, Self

from pydantic import Field, create_model, model_validator

from hdbridge.axis.effects.motion import MEASURED
from hdbridge.files.yamlfile import wrong
from hdbridge.strictness import Strict

EveryCycles = Annotated[int, Field(ge=1, le=240, description="reading with every n-th SYNC")]
HoldMs = Annotated[
    float,
    Field(gt=0, le=600_000, description="time for which the last reading is held"),
]


class Scale(NamedTuple):
    """Conversion ``at_zero + per_count * counts``, and plausible range from ``least`` to ``greatest``."""

    per_count: float
    at_zero: float
    least: float
    greatest: float


class ChannelSource(Strict):
    """Object of the drive that contains a channel's reading."""

    index: int = Field(ge=0x1000, le=0xFFFF, description="index of the object")
    subindex: int = Field(0, ge=0, le=255, description="sub-index of the object")
    type: Literal["int32", "uint32", "int16", "uint16", "int8", "uint8"] = Field(
        description="type of the object"
    )
    via: Literal["tpdo"] = Field("tpdo", description="by PDO")


class LoadTorque(Strict):
    """Torque on the load, from a sensor at its flange or from the drive."""

    source: ChannelSource = Field(description="object with the reading")
    newton_metres_per_count: float = Field(gt=0, le=1e6, description="torque at the load per count")
    direction: Literal[1, -1] = Field(1, description="-1 if the count falls when the torque pushes forward")
    maximum_nm: float = Field(1000.0, gt=0, le=1e6, description="largest plausible torque, either direction")
    every_cycles: EveryCycles = 1
    hold_ms: HoldMs = 100.0

    @property
    def scale(self) -> Scale:
        """Conversion from counts to newton metres at the load; forward torque is positive."""
        limit = self.maximum_nm
        return Scale(self.direction * self.newton_metres_per_count, 0.0, -limit, limit)


class Temperature(Strict):
    """Temperature of the gear."""

    source: ChannelSource = Field(description="object with the reading")
    celsius_per_count: float = Field(gt=0, le=1000, description="degrees Celsius per count")
    celsius_at_zero: float = Field(
        0.0, ge=-1000, le=1000, description="temperature at a reading of zero (-273.15 for kelvin)"
    )
    minimum_celsius: float = Field(-40.0, ge=-273.15, le=1000, description="lowest plausible temperature")
    maximum_celsius: float = Field(150.0, ge=-273.15, le=1000, description="highest plausible temperature")
    every_cycles: EveryCycles = 25
    hold_ms: HoldMs = 5000.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.minimum_celsius >= self.maximum_celsius:
            raise wrong(
                f"found {self.maximum_celsius:g}; expected more than minimum_celsius, "
                f"{self.minimum_celsius:g}",
                "maximum_celsius",
            )
        return self

    @property
    def scale(self) -> Scale:
        """Conversion from counts to degrees Celsius."""
        return Scale(self.celsius_per_count, self.celsius_at_zero, self.minimum_celsius, self.maximum_celsius)


class Quantity(Strict):
    """Any other measured quantity, in its unit."""

    source: ChannelSource = Field(description="object with the reading")
    per_count: float = Field(ge=-1e6, le=1e6, description="its unit per count")
    at_zero: float = Field(0.0, ge=-1e9, le=1e9, description="value at a reading of zero, in its unit")
    minimum: float = Field(-1e9, description="lower limit of plausible readings")
    maximum: float = Field(1e9, description="upper limit of plausible readings")
    every_cycles: EveryCycles = 1
    hold_ms: HoldMs = 100.0

    @property
    def scale(self) -> Scale:
        """Conversion from counts to the channel's unit."""
        return Scale(self.per_count, self.at_zero, self.minimum, self.maximum)


MeasuredChannel = LoadTorque | Temperature | Quantity
BY_KEY: Final = {each.axis_key: each for each in MEASURED if each.axis_key}
"""Channels that the axis file can contain, by key."""

OWN_KEYS: Final = frozenset({"load_torque", "temperature"})
if TYPE_CHECKING:

    class OtherChannels(Strict):
        """Measured channels that `AxisConfig` does not declare."""

else:
    OtherChannels = create_model(
        "OtherChannels",
        __base__=Strict,
        **{
            key: (Quantity | None, Field(None, description=f"{each.about}, {each.unit}"))
            for key, each in BY_KEY.items()
            if key not in OWN_KEYS
        },
    )
