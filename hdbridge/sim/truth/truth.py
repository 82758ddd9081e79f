"""Truth file: the true values of all parameters of the simulated axis.

A calibration must find these values without reading the file. docs/ci.md describes each key, and
`profiles/article/truth.yaml` is the article's bench. Angles and torques of the gear are at the load. Other
modules of this package define the sections.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

import yaml
from pydantic import Field, model_validator

from hdbridge.device.behaviour import Behaviour
from hdbridge.files.yamlfile import document_from_text, read_yaml, wrong
from hdbridge.sim.truth.gear import TrueGear
from hdbridge.sim.truth.load import TrueLoad
from hdbridge.sim.truth.motor import TrueMotor, TrueServo
from hdbridge.sim.truth.resonance import Resonance
from hdbridge.strictness import Strict


class TrueTemperature(Strict):
    """Thermal mass that is warmed by losses and cooled by the surroundings."""

    ambient_c: float = Field(22.0, ge=-60, le=100, description="temperature of the surroundings")
    start_c: float | None = Field(None, ge=-60, le=200, description="temperature at the start; else ambient")
    resistance_k_per_w: float = Field(1.0, ge=0, le=1_000, description="warming per watt of losses")
    time_constant_s: float = Field(1_200.0, gt=0, le=1e6, description="time constant of the warming")
    copper_loss_w: float = Field(
        0.0,
        ge=0,
        le=1e5,
        description="loss in the winding at rated torque, proportional to the torque squared",
    )
    zero_drift_arcsec_per_k: float = Field(
        0.0, ge=-3_600, le=3_600, description="shift of the gear's output per kelvin above ambient"
    )
    zero_time_constant_s: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="time constant with which the shift follows the temperature; 0: at once",
    )
    reference_c: float | None = Field(
        None, ge=-60, le=200, description="temperature at which the growths below are none; else ambient"
    )
    tooth_growth_per_k: float = Field(0.0, ge=-1, le=1, description="growth of the tooth error per kelvin")
    friction_growth_per_k: float = Field(
        0.0, ge=-1, le=1, description="growth of the motor's friction and of the hysteresis per kelvin"
    )
    ambient_k_per_hour: float = Field(
        0.0, ge=-100_000, le=100_000, description="steady warming of the surroundings"
    )
    ambient_swing_k: float = Field(
        0.0, ge=0, le=100, description="amplitude of the periodic change of the surroundings"
    )
    ambient_period_s: float = Field(
        3_600.0, gt=0, le=1e6, description="period of the change of the surroundings"
    )

    @property
    def unchanged_c(self) -> float:
        """Reference temperature, at which all parameters have the values of the truth file."""
        return self.ambient_c if self.reference_c is None else self.reference_c


class Truth(Strict):
    """True parameters of the simulated axis."""

    schema_: Literal["hdbridge.truth/1"] = Field(
        alias="schema", description="schema and version of this file"
    )
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
    firmware: Behaviour = Field(default_factory=Behaviour, description="choices of the drive's firmware")
    intervals: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="95 % intervals of the fitted values, by key"
    )
    provenance: dict[str, Any] = Field(
        default_factory=dict, description="origin of the values; the simulated drive does not read it"
    )

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a truth file, or the truth.yaml of a profile's folder; InputError gives file:line:column."""
        path = Path(path)
        return read_yaml(path / "truth.yaml" if path.is_dir() else path).validate(cls)

    @classmethod
    def from_text(cls, text: str, path: Path | str = "truth.yaml") -> Self:
        """Reads the text of a truth file; ``path`` names it in error messages."""
        return document_from_text(text, path).validate(cls)

    def changed(self, **sections: Mapping[str, Any]) -> Self:
        """Returns a copy with changed keys in some sections; InputError if the result is invalid."""
        data = self.model_dump(mode="json", by_alias=True, exclude_unset=True)
        for name, keys in sections.items():
            data[name] = {**data.get(name, {}), **keys}
        return self.from_text(yaml.safe_dump(data, sort_keys=False), "changed truth") if sections else self

    @property
    def substep_s(self) -> float:
        """Time step in seconds."""
        return self.substep_ms / 1000.0

    @property
    def load_frequency_hz(self) -> float:
        """Natural frequency of the load on the gear's spring with the motor held, Hz."""
        return math.sqrt(self.gear.stiffness_nm_per_rad / self.load_.whole_inertia_kg_m2) / math.tau

    @property
    def resonance(self) -> Resonance:
        return Resonance(
            self.gear.stiffest_nm_per_rad,
            math.degrees(self.load_.presliding_nm_per_deg),
            self.load_.inertia_kg_m2,
            self.motor.inertia_kg_m2 * self.gear.ratio**2,
        )

    @property
    def highest_stiffness_nm_per_rad(self) -> float:
        """Maximum stiffness of the spring for which the time step resolves the resonance."""
        return self.resonance.stiffest_nm_per_rad(1.0 / self.substep_s)

    @model_validator(mode="after")
    def _intervals_are_intervals(self) -> Self:
        for place, (lower, upper) in self.intervals.items():
            if lower > upper:
                raise wrong(f"found {lower:g} above {upper:g}; expected lower, upper", "intervals", place)
        return self

    @model_validator(mode="after")
    def _step_resolves_the_spring(self) -> Self:
        fastest = self.resonance.rad_s
        if fastest * self.substep_s > 1.0:
            raise wrong(
                f"{self.substep_ms:g} ms is too long for a resonance of {fastest / math.tau:.0f} Hz; "
                f"expected at most {1000.0 / fastest:.2g} ms, or a lower stiffness",
                "substep_ms",
            )
        return self
