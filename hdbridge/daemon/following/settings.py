"""Keys under ``adaptation`` of a machine file: what the adaptation may change, and how fast."""

from typing import Annotated, Literal

from pydantic import Field

from hdbridge.strictness import Strict

Mode = Literal["off", "observe", "on"]
Parameter = Annotated[str, Field(pattern=r"^[a-z_]+\.[a-z_]+$")]


class Excitation(Strict):
    """Motion required between two updates of the estimate."""

    turns: float = Field(
        2.0,
        ge=0.5,
        le=1000,
        description="motor turns, both directions together, for the motor orders",
    )
    reversals: int = Field(2, ge=1, le=1000, description="reversals, to separate the loop from the zero")
    samples: int = Field(10, ge=2, le=10_000, description="standstills and stretches of slow motion")


class AdaptationSettings(Strict):
    """Settings of the adaptation. Rates are per hour of axis time, bounds relative to the committed model."""

    mode: Mode = Field("off", description="observe only reports what would change")
    parameters: tuple[Parameter, ...] | None = Field(
        None,
        description="adapted parameters, as EFFECT.PARAMETER; by default all that wear or temperature move",
    )
    rate_arcsec_per_hour: float = Field(
        30.0, gt=0, le=36_000, description="fastest change of any coefficient of the model"
    )
    zero_rate_arcsec_per_hour: float = Field(
        60.0,
        gt=0,
        le=36_000,
        description="fastest plausible change of the zero (reported, never applied)",
    )
    bound_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="largest deviation of a coefficient, as a share of the committed one",
    )
    least_bound_arcsec: float = Field(
        5.0, ge=0, le=3600, description="largest deviation, if that share is smaller"
    )
    zero_bound_arcsec: float = Field(
        60.0,
        gt=0,
        le=3600,
        description="largest plausible change of the zero",
    )
    half_life_turns: float = Field(
        40.0,
        ge=1,
        le=1e6,
        description="motor turns after which older observations count half",
    )
    excitation: Excitation = Field(default_factory=Excitation, description="motion required for an update")
    slow_deg_s: float = Field(
        0.5,
        gt=0,
        le=100,
        description="highest load speed at which motion is used",
    )
    interval_s: float = Field(
        60.0, ge=1, le=86_400, description="minimum time between changes of the model in use"
    )
    smallest_arcsec: float = Field(
        0.1, ge=0, le=100, description="smallest change of a coefficient that is applied"
    )
    folder: str | None = Field(
        None,
        min_length=1,
        description="folder of AXIS.json and AXIS.log.jsonl; by default 'adaptation' next to the axis file",
    )
