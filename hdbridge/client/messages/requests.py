"""Requests of a client to an axis or the machine; values are checked before anything moves."""

from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field, StringConstraints

from hdbridge.client.messages.values import (
    Acceleration,
    AdaptationMode,
    Angle,
    Name,
    Real,
    Report,
    Request,
    Scheme,
    Seconds,
    Speed,
    Velocity,
    Words,
)

QUEUE_MAXIMUM: Final = 1000
"""Maximum number of way points in a request."""
AXES_MAXIMUM: Final = 32


class Move(Request):
    """Move to a load angle, jerk-limited; a present motion is redirected without a stop."""

    target_deg: Angle = Field(description="load angle to go to, degrees", examples=[30.0])
    velocity_deg_s: Speed | None = Field(
        None, description="highest speed, deg/s; else the axis's limit", examples=[20.0]
    )
    acceleration_deg_s2: Acceleration | None = Field(
        None, description="highest acceleration, deg/s2; else the axis's limit", examples=[100.0]
    )
    wait: bool = Field(True, strict=True, description="answer when the axis rests there; else at once")


class Coordinated(Request):
    """Move several axes to their targets, so that all begin and end together."""

    targets_deg: dict[Name, Angle] = Field(
        min_length=1,
        max_length=AXES_MAXIMUM,
        description="load angle of each axis, degrees",
        examples=[{"joint-1": 30.0, "joint-2": -12.5}],
    )
    speed: Annotated[Real, Field(gt=0, le=1)] = Field(
        1.0, description="share of each axis's limits of speed and acceleration", examples=[0.5]
    )
    wait: bool = Field(True, strict=True, description="answer when all rest; else at once")


class Jog(Request):
    """Turn at a speed while the request is repeated, as with a dead man's switch."""

    velocity_deg_s: Velocity = Field(description="speed with its sign, deg/s; 0 stops", examples=[-5.0])
    timeout_s: Annotated[Real, Field(gt=0, le=5)] = Field(
        0.5, description="without another jog by then the axis stops within its limits", examples=[0.5]
    )


class QueueItem(Request):
    """A way point: move there, rest, continue."""

    target_deg: Angle = Field(description="load angle, degrees", examples=[45.0])
    velocity_deg_s: Speed | None = Field(None, description="highest speed, deg/s; else the axis's limit")
    acceleration_deg_s2: Acceleration | None = Field(
        None, description="highest acceleration, deg/s2; else the axis's limit"
    )
    dwell_s: Seconds = Field(0.0, description="rest there before the next, seconds", examples=[0.5])


class Queue(Request):
    """Way points to append to the queue."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"points": [{"target_deg": 10.0}, {"target_deg": 20.0}]}]}
    )

    points: list[QueueItem] = Field(min_length=1, max_length=QUEUE_MAXIMUM)


class StreamPoint(Request):
    """One knot of a streamed path; between knots the daemon interpolates (cubic Hermite)."""

    time_s: Annotated[Real, Field(ge=0, le=1e7)] = Field(
        description="since the stream began, seconds; later than the knot before", examples=[0.02]
    )
    position_deg: Angle = Field(description="load angle then, degrees", examples=[10.002])
    velocity_deg_s: Velocity | None = Field(
        None, description="speed then, deg/s; else the slope between its neighbours", examples=[0.2]
    )


class Compensate(Request):
    """Select the parts of the model that compensate; the change is ramped."""

    scheme: Scheme = Field(description="`none` switches it off", examples=["both"])


class SwitchLoadLoop(Request):
    """Switch the load loop (integral of the measured error) on or off, if the machine file has one."""

    on: bool = Field(strict=True, description="on, or off", examples=[True])


class ActivateModel(Request):
    """Activate a model of the axis's history, also during motion; the change is ramped."""

    version: Annotated[int, Field(strict=True, ge=1, le=10**9)] | Literal["pending", "active"] = Field(
        description="its number in `hdbridge model log`; `pending` commits the one that waits, `active` "
        "reads the active one again",
        examples=[4],
    )


class Home(Request):
    """Home by a method of the drive (CiA 402, mode HM)."""

    method: Annotated[int, Field(strict=True, ge=-128, le=127)] = Field(
        description="homing method, 6098h: see the drive's manual", examples=[37]
    )
    switch_velocity_deg_s: Speed | None = Field(
        None, description="speed towards the switch, deg/s at the load; else as the daemon finds right"
    )
    zero_velocity_deg_s: Speed | None = Field(
        None, description="speed towards the zero, deg/s at the load; else as the daemon finds right"
    )
    acceleration_deg_s2: Acceleration | None = Field(
        None, description="acceleration, deg/s2 at the load; else the axis's limit"
    )
    offset_deg: Angle = Field(0.0, description="load angle of the home position (607Ch)")
    timeout_s: Annotated[Real, Field(ge=0.1, le=3600)] = Field(60.0, description="time-out, seconds")


class SdoWrite(Request):
    """A value for an object of the drive, by the type that its EDS gives it."""

    value: Annotated[str, StringConstraints(strict=True, min_length=1, max_length=2000)] = Field(
        description="decimal or 0x...; text, or bytes in hexadecimal", examples=["0x10"]
    )


class SdoValue(Report):
    """An object of the drive as it was read."""

    index: int = Field(ge=0, le=0xFFFF, description="number of the object", examples=[0x6064])
    subindex: int = Field(ge=0, le=0xFF, examples=[0])
    name: str = Field(description="its name in the EDS", examples=["Position actual value"])
    type: str = Field(description="its type", examples=["int32"])
    value: int | float | bool | str | None = Field(
        description="bytes are hexadecimal; None for a float that is not a number", examples=[123456]
    )


class Mark(Request):
    """A remark for the flight recorder, at the present cycle."""

    text: Words = Field(min_length=1, examples=["coupling tightened"])


class Adapt(Request):
    """Mode in which the model's parameters follow the load encoder."""

    mode: AdaptationMode = Field(examples=["observe"])
