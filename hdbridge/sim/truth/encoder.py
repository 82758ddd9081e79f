"""Encoder sections of the truth file: geometry of the disc, signals, delayed samples, lost counts."""

from typing import Literal, Self

from pydantic import Field, model_validator

from hdbridge.files.yamlfile import wrong
from hdbridge.strictness import Strict

Direction = Literal[1, -1]


class TrueDisc(Strict):
    """Mounting of the graduated disc on its shaft; one reading head."""

    radius_mm: float = Field(gt=0, le=1_000, description="radius of the graduation")
    eccentricity_um: float = Field(
        0.0, ge=0, le=10_000, description="distance of the graduation's centre from the shaft's axis"
    )
    eccentric_at_deg: float = Field(
        0.0, ge=-360, le=360, description="shaft angle at which that distance points away from the head"
    )
    ovality_um: float = Field(
        0.0, ge=0, le=10_000, description="shift of the lines along the track, twice per turn"
    )
    oval_at_deg: float = Field(
        0.0, ge=-360, le=360, description="shaft angle at which that shift is zero and grows"
    )

    @model_validator(mode="after")
    def _lies_on_its_shaft(self) -> Self:
        if self.eccentricity_um > 100.0 * self.radius_mm:
            raise wrong(
                f"{self.eccentricity_um:g} um is more than a tenth of the radius, {self.radius_mm:g} mm",
                "eccentricity_um",
            )
        return self


class TrueSignals(Strict):
    """Sine and cosine signals of the lines, and their imperfections."""

    lines_per_turn: int = Field(ge=1, le=1_000_000, description="signal periods per turn")
    sine_offset: float = Field(0.0, ge=-0.5, le=0.5, description="offset of the sine, of its amplitude")
    cosine_offset: float = Field(0.0, ge=-0.5, le=0.5, description="offset of the cosine, of its amplitude")
    gain_mismatch: float = Field(
        0.0, ge=-0.5, le=0.5, description="relative excess of the sine's amplitude over the cosine's"
    )
    phase_mismatch_deg: float = Field(
        0.0, ge=-45, le=45, description="deficit of their phase difference from 90 degrees"
    )
    third_harmonic: float = Field(
        0.0, ge=-0.3, le=0.3, description="third harmonic of both, relative to the amplitude"
    )


class TrueLoss(Strict):
    """One loss of counts, which remains in the reading."""

    time_s: float = Field(ge=0, le=1e8, description="time since the axis was switched on")
    counts: int = Field(ge=-(2**31), le=2**31 - 1, description="size of the jump, counts")


class TrueEncoder(Strict):
    """Properties of every encoder."""

    counts_per_turn: int = Field(ge=4, le=2**31 - 1, description="counts per turn of its shaft")
    direction: Direction = Field(1, description="-1: counts down as the shaft turns forward")
    zero_counts: int = Field(
        0, ge=-(2**31), le=2**31 - 1, description="reading at the angle zero, where the axis is switched on"
    )
    disc: TrueDisc | None = Field(None, description="mounting of the disc on its shaft; without it: true")
    late_ms: float = Field(0.0, ge=0, le=100, description="age of the reading relative to the other encoder")
    losses: tuple[TrueLoss, ...] = Field((), description="counts lost, each at its time")


class TrueMotorEncoder(TrueEncoder):
    """Encoder on the motor shaft. It reports whole counts; the drive's loops use finer steps."""

    interpolation: int = Field(
        64, ge=1, le=65_536, description="steps per count that the drive's own loops see (sine/cosine tracks)"
    )


class TrueCoupling(Strict):
    """Flexible coupling between the load and the load encoder's shaft."""

    frequency_hz: float = Field(
        ge=10, le=5_000, description="natural frequency of the encoder on its coupling"
    )
    damping_ratio: float = Field(ge=0.01, le=2, description="damping ratio of the encoder on its coupling")
    play_arcsec: float = Field(0.0, ge=0, le=36_000, description="play between the load and the coupling")


class TrueCable(Strict):
    """Cable of the encoder, which is taut beyond an angle and then twists the encoder's body."""

    taut_from_deg: float = Field(
        ge=-36_000, le=36_000, description="load angle above which the cable is taut"
    )
    arcsec_per_deg: float = Field(
        ge=-3_600, le=3_600, description="rotation of the body per degree above that angle"
    )
    drag: float = Field(
        0.0, ge=0, le=1, description="relative difference of the pull between outward and return motion"
    )


class TrueSensorWarming(Strict):
    """Warming of the encoder, which grows with the square of its speed; no temperature channel measures
    it.
    """

    arcsec_at_10_deg_s: float = Field(
        ge=-3_600, le=3_600, description="final shift in long motion at 10 degrees per second"
    )
    time_constant_s: float = Field(gt=0, le=1e6, description="time constant of the warming")


class TrueLoadEncoder(TrueEncoder):
    """Encoder at the load."""

    coupling: TrueCoupling | None = Field(None, description="flexible coupling; without it: rigid")
    noise_arcsec: float = Field(0.0, ge=0, le=3_600, description="noise of each reading, rms")
    signals: TrueSignals | None = Field(None, description="signals within a line; without it: perfect")
    cable: TrueCable | None = Field(None, description="cable that pulls the body; without it: slack")
    sensor_warming: TrueSensorWarming | None = Field(None, description="warming by speed; without it: none")
