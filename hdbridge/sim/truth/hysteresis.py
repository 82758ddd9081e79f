"""Tooth errors and hysteresis laws of the truth file."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from hdbridge.files.yamlfile import wrong
from hdbridge.strictness import Strict


class TrueOrder(Strict):
    """Term of the tooth error: amplitude * cos(order * angle + phase)."""

    order: int = Field(ge=1, le=512, description="periods per turn of the angle it belongs to")
    amplitude_arcsec: float = Field(ge=0, le=36_000, description="amplitude, at the load")
    phase_deg: float = Field(ge=-360, le=360, description="phase at the angle zero")


class RollingFriction(Strict):
    """Rolling-friction law of the article: after a reversal the error crosses to the other branch within a
    width.
    """

    law: Literal["rolling_friction"] = Field(description="the article's law; no return-point memory")
    offset_arcsec: float = Field(ge=0, le=36_000, description="error after long motion in one direction")
    width_deg: float = Field(gt=0, le=36_000, description="motor travel of the crossing")
    exponent: float = Field(ge=1, le=10, description="exponent n of the crossing; 1 is a jump")
    start_arcsec: float = Field(0.0, description="error at the start")

    @model_validator(mode="after")
    def _starts_within(self) -> Self:
        if abs(self.start_arcsec) > self.offset_arcsec:
            raise wrong(
                f"{self.start_arcsec:g} arcsec lies outside -offset_arcsec to offset_arcsec, "
                f"{self.offset_arcsec:g}",
                "start_arcsec",
            )
        return self


class SlipElement(Strict):
    """Spring in series with a slider."""

    limit_arcsec: float = Field(ge=0, le=36_000, description="error at which the slider slips")
    yield_deg: float = Field(gt=0, le=36_000, description="motor travel from zero to slipping")


class MaxwellSlip(Strict):
    """Parallel elasto-plastic elements; a reversal is remembered until a larger one erases it."""

    law: Literal["maxwell_slip"] = Field(description="Maxwell slip, Prandtl-Ishlinskii; return-point memory")
    elements: tuple[SlipElement, ...] = Field(
        min_length=1, max_length=64, description="elements; their errors add up"
    )


class BoucWen(Strict):
    """Bouc-Wen law: a differential equation in the motor's travel rather than in time."""

    law: Literal["bouc_wen"] = Field(description="Bouc-Wen, the smooth law")
    offset_arcsec: float = Field(ge=0, le=36_000, description="error after long motion in one direction")
    yield_deg: float = Field(gt=0, le=36_000, description="offset divided by the slope at error zero")
    exponent: float = Field(1.0, ge=1, le=10, description="sharpness of the transition to the offset")
    beta: float = Field(
        0.5, ge=0.5, le=1, description="dissipating part; 1 - beta is gamma. At 0.5 it unloads along a line"
    )


class Dahl(Strict):
    """Dahl's law: the slope is a power of the remaining distance to the offset ahead."""

    law: Literal["dahl"] = Field(description="Dahl's law; no return-point memory")
    offset_arcsec: float = Field(ge=0, le=36_000, description="error after long motion in one direction")
    yield_deg: float = Field(gt=0, le=36_000, description="offset divided by the slope at error zero")
    exponent: float = Field(1.0, ge=0.5, le=5, description="1: exponential; below 1 the offset is reached")


Hysteresis = Annotated[RollingFriction | MaxwellSlip | BoucWen | Dahl, Field(discriminator="law")]
