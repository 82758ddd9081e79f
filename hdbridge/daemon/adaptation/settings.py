"""Keys under ``adaptation`` of a machine file: what the adaptation may change, and how fast."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from hdbridge.strictness import Strict

Mode = Literal["off", "observe", "on"]
Parameter = Annotated[str, Field(pattern=r"^[a-z_]+\.[a-z_]+$")]


class Standing(StrEnum):
    """State of an axis's adaptation."""

    OFF = "off"
    WAITING = "waiting"
    """Nothing to learn from: at rest, too fast, without power, or too little motion yet."""
    FOLLOWING = "following"
    FROZEN = "frozen"
    """A doubt stops learning; the reason is reported. It ends when its cause does, or by `resume`."""


class Excitation(Strict):
    """Motion required between two updates of the estimate."""

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
    """Settings of the adaptation. Rates are per hour of axis time, bounds relative to the committed model."""

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
