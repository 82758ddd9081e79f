"""What the adaptation of an axis may do, and how fast: the keys under ``adaptation`` of a machine file."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from hdbridge.strictness import Strict

Mode = Literal["off", "observe", "on"]
Parameter = Annotated[str, Field(pattern=r"^[a-z_]+\.[a-z_]+$")]


class Standing(StrEnum):
    """What the adaptation of an axis is doing."""

    OFF = "off"
    WAITING = "waiting"
    """Nothing to learn from: at rest, too fast, no power, or too little motion yet."""
    FOLLOWING = "following"
    FROZEN = "frozen"
    """A fault; the reason is told. Ends by itself when what it depends on is well again, or by `resume`."""


class Excitation(Strict):
    """What an axis must have done since the last update before the next one is made."""

    turns: float = Field(
        2.0, ge=0.5, le=1000, description="motor turns (both directions) that show the orders of the motor"
    )
    reversals: int = Field(
        2, ge=1, le=1000, description="reversals of the motor that show the loop and tell it from the zero"
    )
    samples: int = Field(
        10, ge=2, le=10_000, description="stands and stretches of slow motion that were measured"
    )


class AdaptationSettings(Strict):
    """Rates are per hour of the axis's own time, bounds are about the committed model."""

    mode: Mode = Field(
        "off", description="off, observe (only report what would change), or on (change the model in use)"
    )
    parameters: tuple[Parameter, ...] | None = Field(
        None,
        description="what follows, as EFFECT.PARAMETER; without it all that wear and temperature move",
    )
    rate_arcsec_per_hour: float = Field(
        30.0, gt=0, le=36_000, description="fastest change of any one coefficient of the model"
    )
    zero_rate_arcsec_per_hour: float = Field(
        60.0,
        gt=0,
        le=36_000,
        description="fastest change of the zero (told, never applied); a faster one is a fault",
    )
    bound_share: float = Field(
        0.5, gt=0, le=1, description="most that a coefficient may differ from the committed one, of its size"
    )
    least_bound_arcsec: float = Field(
        5.0, ge=0, le=3600, description="most that it may differ where that share is less than this"
    )
    zero_bound_arcsec: float = Field(
        60.0, gt=0, le=3600, description="most that the zero may move since it was taken; more is a fault"
    )
    half_life_turns: float = Field(
        40.0,
        ge=1,
        le=1e6,
        description="motor turns after which what was seen counts half, in the directions that they show",
    )
    excitation: Excitation = Field(
        default_factory=Excitation, description="what must be seen before an update"
    )
    slow_deg_s: float = Field(
        0.5, gt=0, le=100, description="load speed up to which motion is used; faster, only stands are"
    )
    interval_s: float = Field(
        60.0, ge=1, le=86_400, description="least time between two changes of the model in use"
    )
    smallest_arcsec: float = Field(
        0.1, ge=0, le=100, description="change of a coefficient below which the model in use stays as it is"
    )
    folder: str | None = Field(
        None,
        min_length=1,
        description="where state and history are kept (AXIS.json, AXIS.log.jsonl), relative to the machine "
        "file; else the folder 'adaptation' beside the axis file",
    )
