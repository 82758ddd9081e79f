"""Values that several messages share: bounded numbers, names, enumerations, and the two base classes."""

from enum import StrEnum
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

WORDS_MAXIMUM: Final = 400
"""Maximum length of a client's text."""

_PRINTABLE: Final = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"
"""Text without characters that move a terminal's cursor, start a log line or reverse the writing
direction."""
Real = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""A number, not its text; NaN and infinity are refused."""
Angle = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e7, le=1e7)]
"""Degrees at the load, multi-turn; the axis's own limits are narrower."""
Speed = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=1e5)]
"""Degrees per second at the load, without a sign."""
Velocity = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e5, le=1e5)]
"""Degrees per second at the load, with a sign."""
Acceleration = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=1e7)]
"""Degrees per second squared at the load."""
Seconds = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=86_400)]
Name = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
"""Name of an axis or a machine, as in its file."""
Words = Annotated[str, StringConstraints(strict=True, max_length=WORDS_MAXIMUM, pattern=_PRINTABLE)]
"""One line of text."""


class Request(BaseModel):
    """Message of a client; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Report(BaseModel):
    """Message of the daemon; keys that a newer daemon adds are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_inf_nan="null")


class ControlState(StrEnum):
    """State of an axis in the control loop, in the order of the loop's numbers."""

    UNVERIFIED = "unverified"
    """The drive was not verified against its axis file; nothing is sent to it."""
    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPING = "stopping"
    """Braking to rest, then switching power off."""
    LENT = "lent"
    """The service controls the drive, for homing; the loop sends it no targets."""
    QUICK_STOPPED = "quick-stopped"
    """Latched until a reset."""
    LATCHED = "latched"
    """Latched until the drive is verified again."""


class MotionMode(StrEnum):
    """Source of an axis's targets, in the order of the loop's numbers."""

    HOLD = "hold"
    GOTO = "goto"
    JOG = "jog"
    STREAM = "stream"
    STOP = "stop"
    FOLLOW = "follow"
    """After the set-points of another master, through the gateway."""


class PowerState(StrEnum):
    """CiA 402 state, from the drive's statusword."""

    NOT_READY_TO_SWITCH_ON = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown"


class Scheme(StrEnum):
    """Parts of the model that compensate."""

    NONE = "none"
    SYNCHRONOUS = "synchronous"
    HYSTERESIS = "hysteresis"
    BOTH = "both"
    EXTENDED = "extended"
    """The whole model, with effects that a diagnosis added."""


class AdaptationMode(StrEnum):
    """Mode in which the model's parameters follow the load encoder."""

    OFF = "off"
    OBSERVE = "observe"
    """Estimates and reports changes without applying them."""
    ON = "on"
