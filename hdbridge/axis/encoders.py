"""Encoders of the axis file: their scaling, and the object with the load encoder's reading."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import Field, model_validator

from hdbridge.files.yamlfile import wrong
from hdbridge.strictness import Strict

NodeId = Annotated[int, Field(ge=1, le=127)]
Direction = Literal[1, -1]
INT32_MAX = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Scale:
    """Conversion between an encoder's counts and degrees of its shaft.

    It is separate from `Encoder` for use in the control cycle, where pydantic's attribute access would take
    longer than the computation.
    """

    direction: int
    counts_per_turn: int

    def counts(self, deg: float) -> float:
        """Converts a shaft angle in degrees to (fractional) counts."""
        return self.direction * deg * self.counts_per_turn / 360.0

    def degrees(self, counts: float) -> float:
        """Converts a reading in counts to the shaft angle in degrees."""
        return self.direction * counts * 360.0 / self.counts_per_turn


class Encoder(Strict):
    """An encoder: counts per turn and direction."""

    counts_per_turn: int = Field(
        ge=1, le=INT32_MAX, description="counts per turn of the encoder's shaft, after multiplication"
    )
    direction: Direction = Field(1, description="-1 if the encoder counts down when the axis turns forward")

    @property
    def scale(self) -> Scale:
        return Scale(self.direction, self.counts_per_turn)

    def counts(self, deg: float) -> float:
        return self.scale.counts(deg)

    def degrees(self, counts: float) -> float:
        return self.scale.degrees(counts)

    @property
    def resolution_arcsec(self) -> float:
        """Size of one count, arcseconds of the encoder's own shaft."""
        return 1_296_000.0 / self.counts_per_turn


class MotorEncoder(Encoder):
    """Motor encoder, with which the drive closes its position loop (6064h, 607Ah)."""


class Source(Strict):
    """Object that contains the load encoder's reading."""

    WRAPS: ClassVar[dict[str, int]] = {"int32": 2**32, "uint32": 2**32, "int16": 2**16, "uint16": 2**16}

    index: int = Field(0x60E4, ge=0x1000, le=0xFFFF, description="index of the object")
    subindex: int = Field(1, ge=0, le=255, description="sub-index of the object")
    type: Literal["int32", "uint32", "int16", "uint16"] = Field("int32", description="type of the object")
    via: Literal["tpdo"] = Field("tpdo", description="by PDO")
    node: NodeId | None = Field(
        None, description="node id of an encoder that is a node of its own (CiA 406, 6004h)"
    )
    range_counts: int | None = Field(
        None,
        ge=2,
        le=2**32,
        description="reading at which the encoder wraps to zero (single-turn encoder: counts per turn); by "
        "default the range of the type",
    )

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        if self.range_counts is not None and self.range_counts > self.WRAPS[self.type]:
            raise wrong(f"{self.type} holds no more than {self.WRAPS[self.type]} counts", "range_counts")
        return self

    @property
    def address(self) -> tuple[int, int]:
        """Index and sub-index of the object."""
        return self.index, self.subindex

    @property
    def wraps_at_counts(self) -> int:
        """Number of counts after which the reading wraps."""
        return self.range_counts or self.WRAPS[self.type]


POSITION_ACTUAL: Final = (0x6064, 0)
"""Object with the position actual value of the motor (CiA 402-2)."""


class LoadEncoder(Encoder):
    """Encoder at the load, which measures the positioning error."""

    source: Source = Field(default_factory=Source, description="source of its reading")

    @property
    def is_motor_encoder(self) -> bool:
        """True if the source is the motor encoder, which means that the axis has no encoder at the load."""
        return self.source.node is None and self.source.address == POSITION_ACTUAL
