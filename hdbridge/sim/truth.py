"""The truth file: every parameter of the simulated axis, as it really is.

A calibration does not read this file; it has to find out. docs/truth-file.md describes each key, and
`profiles/article/truth.yaml` is the article's bench. Angles and torques of the gear are at the load.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from hdbridge.yamlfile import document_from_text, read_yaml, wrong

Direction = Literal[1, -1]


class _Part(BaseModel):
    """A mapping of the file: frozen, no unknown keys, finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class TrueEncoder(_Part):
    """What every encoder has."""

    counts_per_turn: int = Field(ge=4, le=2**31 - 1, description="counts per turn of its shaft")
    direction: Direction = Field(1, description="-1: counts down as the shaft turns forward")
    zero_counts: int = Field(
        0, ge=-(2**31), le=2**31 - 1, description="reading at the angle zero, where the axis is switched on"
    )


class TrueMotorEncoder(TrueEncoder):
    """The encoder on the motor shaft. It reports whole counts; the drive's loops see finer."""

    interpolation: int = Field(
        64, ge=1, le=65_536, description="steps per count that the drive's own loops see (sine/cosine tracks)"
    )


class TrueCoupling(_Part):
    """The flexible coupling between the load and the load encoder's shaft."""

    frequency_hz: float = Field(
        ge=10, le=5_000, description="natural frequency of the encoder on its coupling"
    )
    damping_ratio: float = Field(ge=0.01, le=2, description="damping ratio of the encoder on its coupling")


class TrueLoadEncoder(TrueEncoder):
    """The encoder at the load."""

    coupling: TrueCoupling | None = Field(None, description="flexible coupling; without it: rigid")
    noise_arcsec: float = Field(0.0, ge=0, le=3_600, description="noise of each reading, rms")


class TrueMotor(_Part):
    """The motor with the wave generator, and the friction on their shaft."""

    inertia_kg_m2: float = Field(gt=0, le=100, description="inertia of motor and wave generator")
    rated_torque_nm: float = Field(gt=0, le=10_000, description="rated torque, the unit of 6077h")
    coulomb_nm: float = Field(
        0.0, ge=0, le=10_000, description="Coulomb friction; it holds the shaft at rest"
    )
    viscous_nm_s_per_rad: float = Field(0.0, ge=0, le=1_000, description="viscous friction")
    brake_nm: float = Field(1.0, ge=0, le=100_000, description="torque up to which the brake holds")
    encoder: TrueMotorEncoder = Field(description="encoder on the motor shaft")


class TrueLoadFeedforward(_Part):
    """The drive's own picture of the load behind the gear's spring, as its commissioning has set it."""

    inertia_kg_m2: float = Field(gt=0, le=100, description="inertia of the load, seen by the motor")
    frequency_hz: float = Field(ge=1, le=500, description="natural frequency of the load, the motor held")
    damping_ratio: float = Field(ge=0, le=2, description="damping ratio of the load, the motor held")


class TrueServo(_Part):
    """The drive's loops: position and velocity cascade with feed-forward, limited in torque."""

    position_gain_per_s: float = Field(gt=0, le=5_000, description="position loop: speed per position error")
    velocity_gain_nm_s_per_rad: float = Field(
        gt=0, le=1_000, description="velocity loop: torque per speed error"
    )
    integral_time_ms: float = Field(gt=0, le=10_000, description="velocity loop: integral time")
    integral_dead_band: float = Field(
        1.0,
        ge=0,
        le=1_000,
        description="shortfall within which the integral rests once the demand does, in interpolated steps",
    )
    hunting_band: float = Field(
        16.0,
        ge=0,
        le=100_000,
        description="overshoot within which it rests, so as not to turn back and hunt, in interpolated steps",
    )
    command_filter_ms: float = Field(
        gt=0, le=100, description="time constant of the second-order filter on the demand"
    )
    velocity_feedforward: float = Field(1.0, ge=0, le=1.5, description="part of the demanded speed")
    inertia_feedforward_kg_m2: float = Field(
        0.0, ge=0, le=100, description="torque per demanded acceleration, for the motor itself"
    )
    load_feedforward: TrueLoadFeedforward | None = Field(
        None, description="torque that carries the load along; without it: none"
    )
    viscous_feedforward_nm_s_per_rad: float = Field(
        0.0, ge=0, le=1_000, description="torque per demanded speed"
    )
    friction_feedforward_nm: float = Field(
        0.0, ge=0, le=10_000, description="torque in the direction of the last demanded motion"
    )
    torque_limit_percent: float = Field(gt=0, le=1_000, description="highest torque, of the rated one")


class TrueOrder(_Part):
    """A term of the tooth error: amplitude * cos(order * angle + phase)."""

    order: int = Field(ge=1, le=512, description="periods per turn of the angle it belongs to")
    amplitude_arcsec: float = Field(ge=0, le=36_000, description="amplitude, at the load")
    phase_deg: float = Field(ge=-360, le=360, description="phase at the angle zero")


class RollingFriction(_Part):
    """The article's law: after a reversal the error crosses to the other side within a width."""

    law: Literal["rolling_friction"] = Field(description="the article's law; no return-point memory")
    offset_arcsec: float = Field(ge=0, le=36_000, description="error after long motion in one direction")
    width_deg: float = Field(gt=0, le=36_000, description="motor travel of the crossing")
    exponent: float = Field(gt=1, le=10, description="shape of the crossing, n")
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


class SlipElement(_Part):
    """A spring in series with a slider."""

    limit_arcsec: float = Field(ge=0, le=36_000, description="error at which it slips")
    yield_deg: float = Field(gt=0, le=36_000, description="motor travel from zero to slipping")


class MaxwellSlip(_Part):
    """Parallel elasto-plastic elements; remembers every reversal that a larger one has not wiped out."""

    law: Literal["maxwell_slip"] = Field(description="Maxwell slip, Prandtl-Ishlinskii; return-point memory")
    elements: tuple[SlipElement, ...] = Field(
        min_length=1, max_length=64, description="elements; their errors add up"
    )


class BoucWen(_Part):
    """A differential equation in the motor's travel, not in time."""

    law: Literal["bouc_wen"] = Field(description="Bouc-Wen, the smooth law")
    offset_arcsec: float = Field(ge=0, le=36_000, description="error after long motion in one direction")
    yield_deg: float = Field(gt=0, le=36_000, description="offset divided by the slope at error zero")
    exponent: float = Field(1.0, ge=1, le=10, description="sharpness of the transition to the offset")
    beta: float = Field(
        0.5, ge=0.5, le=1, description="dissipating part; 1 - beta is gamma. At 0.5 it unloads along a line"
    )


Hysteresis = Annotated[RollingFriction | MaxwellSlip | BoucWen, Field(discriminator="law")]


class TrueGear(_Part):
    """The harmonic gear: what its output does beside turning by motor angle / ratio."""

    ratio: float = Field(ge=1, le=1_000, description="motor turns per load turn")
    stiffness_nm_per_rad: float = Field(gt=0, le=1e9, description="flexspline's spring to the load")
    damping_nm_s_per_rad: float = Field(ge=0, le=1e6, description="flexspline's damping, to the load")
    motor_orders: tuple[TrueOrder, ...] = Field((), description="tooth error by motor angle")
    flexspline_orders: tuple[TrueOrder, ...] = Field(
        (), description="tooth error by the angle between wave generator and flexspline: motor (1 + 1/ratio)"
    )
    load_orders: tuple[TrueOrder, ...] = Field((), description="tooth error by load angle")
    hysteresis: Hysteresis | None = Field(None, description="elastic hysteresis law; without it: none")

    @model_validator(mode="after")
    def _each_order_once(self) -> Self:
        for name in ("motor_orders", "flexspline_orders", "load_orders"):
            seen: set[int] = set()
            for position, each in enumerate(getattr(self, name)):
                if each.order in seen:
                    raise wrong(f"order {each.order} stands twice", name, position, "order")
                seen.add(each.order)
        return self


class TrueLoad(_Part):
    """The load with its encoder."""

    inertia_kg_m2: float = Field(gt=0, le=1e6, description="inertia of the load, at the load")
    coulomb_nm: float = Field(
        0.0, ge=0, le=1e6, description="Coulomb friction at the load; leaves wind-up at rest"
    )
    viscous_nm_s_per_rad: float = Field(0.0, ge=0, le=1e6, description="viscous friction at the load")
    encoder: TrueLoadEncoder = Field(description="encoder at the load")


class TrueTemperature(_Part):
    """One heat store, warmed by losses, cooled by the surroundings."""

    ambient_c: float = Field(22.0, ge=-60, le=100, description="temperature of the surroundings")
    start_c: float | None = Field(None, ge=-60, le=200, description="temperature at the start; else ambient")
    resistance_k_per_w: float = Field(1.0, ge=0, le=1_000, description="warming per watt of losses")
    time_constant_s: float = Field(1_200.0, gt=0, le=1e6, description="time constant of the warming")
    copper_loss_w: float = Field(
        0.0, ge=0, le=1e5, description="loss in the winding at rated torque; it goes with the torque squared"
    )
    zero_drift_arcsec_per_k: float = Field(
        0.0, ge=-3_600, le=3_600, description="shift of the gear's output per kelvin above ambient"
    )


class Truth(_Part):
    """The simulated axis."""

    schema_: Literal["hdbridge.truth/1"] = Field(alias="schema", description="kind and version of this file")
    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name: letters, digits, '.', '_', '-'"
    )
    substep_ms: float = Field(
        0.5, ge=0.05, le=1, description="time step of the simulation and of the drive's loops"
    )
    motor: TrueMotor = Field(description="motor and wave generator")
    servo: TrueServo = Field(description="the drive's loops")
    gear: TrueGear = Field(description="the harmonic gear")
    load_: TrueLoad = Field(alias="load", description="load and load encoder")
    temperature: TrueTemperature = Field(default_factory=TrueTemperature, description="heat")

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a truth file, or the one in a profile's folder; InputError with file:line:column."""
        path = Path(path)
        return read_yaml(path / "truth.yaml" if path.is_dir() else path).validate(cls)

    @classmethod
    def from_text(cls, text: str, path: Path | str = "truth.yaml") -> Self:
        """A truth file's text; ``path`` names it in complaints."""
        return document_from_text(text, path).validate(cls)

    @property
    def substep_s(self) -> float:
        """Time step in seconds."""
        return self.substep_ms / 1000.0

    @property
    def load_frequency_hz(self) -> float:
        """Natural frequency of the load on the gear's spring, the motor held."""
        return math.sqrt(self.gear.stiffness_nm_per_rad / self.load_.inertia_kg_m2) / math.tau

    @model_validator(mode="after")
    def _step_resolves_the_spring(self) -> Self:
        reflected = self.motor.inertia_kg_m2 * self.gear.ratio**2
        stiffness = self.gear.stiffness_nm_per_rad
        fastest = math.sqrt(stiffness / self.load_.inertia_kg_m2 + stiffness / reflected)
        if fastest * self.substep_s > 1.0:
            raise wrong(
                f"{self.substep_ms:g} ms is too long for a resonance of {fastest / math.tau:.0f} Hz; "
                f"expected at most {1000.0 / fastest:.2g}, or less stiffness",
                "substep_ms",
            )
        return self
