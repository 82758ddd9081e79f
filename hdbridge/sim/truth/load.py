"""Section ``load`` of the truth file."""

from typing import Literal

from pydantic import Field

from hdbridge.sim.truth.encoder import TrueLoadEncoder
from hdbridge.strictness import Strict


class TrueGravity(Strict):
    """Mass on the axis, subject to gravity."""

    mass_kg: float = Field(gt=0, le=1e5, description="mass")
    arm_m: float = Field(gt=0, le=100, description="its distance from the axis")
    down_deg: float = Field(0.0, ge=-360, le=360, description="load angle at which it hangs straight down")
    tilt_deg: float = Field(0.0, ge=0, le=90, description="tilt of the axis; 90 is upright, without torque")


class TrueStribeck(Strict):
    """Friction at the load that increases as the speed approaches zero."""

    breakaway_nm: float = Field(
        ge=0, le=1e6, description="friction at rest, in place of the Coulomb friction"
    )
    speed_rad_s: float = Field(gt=0, le=100, description="load speed at which the increase has fallen to 1/e")


class TrueThinning(Strict):
    """Grease that thins when sheared: viscous friction / (1 + speed / ``speed_rad_s``)^exponent."""

    speed_rad_s: float = Field(gt=0, le=1_000, description="load speed at which thinning begins")
    exponent: float = Field(0.5, gt=0, le=1, description="degree of thinning; 1 ends at a constant torque")


class TrueVibration(Strict):
    """Nearby machine that shakes the load."""

    frequency_hz: float = Field(gt=0, le=500, description="frequency")
    torque_nm: float = Field(ge=0, le=1e6, description="amplitude of the torque on the load")
    phase_deg: float = Field(0.0, ge=-360, le=360, description="phase when the axis is switched on")


class TrueSlip(Strict):
    """Spring between load and ground that slips at its torque limit."""

    limit_nm: float = Field(gt=0, le=1e6, description="friction at which the spring slips")
    travel_deg: float = Field(gt=0, le=360, description="load travel from no friction to slipping")


class TrueLoad(Strict):
    """Load and its encoder."""

    inertia_kg_m2: float = Field(gt=0, le=1e6, description="inertia of the load, at the load")
    coulomb_nm: float = Field(
        0.0, ge=0, le=1e6, description="Coulomb friction at the load; leaves wind-up at rest"
    )
    viscous_nm_s_per_rad: float = Field(0.0, ge=0, le=1e6, description="viscous friction at the load")
    presliding: tuple[TrueSlip, ...] = Field(
        (), max_length=16, description="friction at the load that yields before it slips; they add up"
    )
    stribeck: TrueStribeck | None = Field(None, description="friction near rest; without it: Coulomb only")
    thinning: TrueThinning | None = Field(None, description="shear thinning of the viscous friction")
    gravity: TrueGravity | None = Field(None, description="a mass on the axis; without it: balanced")
    vibration: tuple[TrueVibration, ...] = Field((), max_length=16, description="shaking from outside")
    torque_sense: Literal[1, -1] = Field(
        1,
        description="sign of the reported torque: 1: it pushes the load forward, -1: the gear delivers it",
    )
    encoder: TrueLoadEncoder = Field(description="encoder at the load")

    @property
    def presliding_nm_per_deg(self) -> float:
        """Stiffness of the presliding friction that holds the load before it slips."""
        return sum(each.limit_nm / each.travel_deg for each in self.presliding)

    @property
    def whole_inertia_kg_m2(self) -> float:
        """Inertia of the load including the mass on it."""
        if self.gravity is None:
            return self.inertia_kg_m2
        return self.inertia_kg_m2 + self.gravity.mass_kg * self.gravity.arm_m**2
