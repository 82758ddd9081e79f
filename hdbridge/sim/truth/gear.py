"""Section ``gear`` of the truth file."""

import math
from typing import Self

from pydantic import Field, model_validator

from hdbridge.files.yamlfile import wrong
from hdbridge.sim.truth.hysteresis import Hysteresis, TrueOrder
from hdbridge.strictness import Strict
from hdbridge.units import ARCSEC_PER_DEG


class TrueStiffening(Strict):
    """Second and third stage of the spring, with a different stiffness beyond each of two torques."""

    first_torque_nm: float = Field(gt=0, le=1e6, description="torque T1 at which the first stage ends")
    second_stiffness_nm_per_rad: float = Field(gt=0, le=1e9, description="stiffness K2 beyond T1")
    second_torque_nm: float = Field(gt=0, le=1e6, description="torque T2 at which the second stage ends")
    third_stiffness_nm_per_rad: float = Field(gt=0, le=1e9, description="stiffness K3 beyond T2")

    @model_validator(mode="after")
    def _breaks_in_order(self) -> Self:
        if self.second_torque_nm <= self.first_torque_nm:
            raise wrong(
                f"{self.second_torque_nm:g} Nm is not above first_torque_nm, {self.first_torque_nm:g}",
                "second_torque_nm",
            )
        return self


class TrueFlank(Strict):
    """Other flank of the teeth, which carries the load after a reversal, with a shifted tooth error."""

    shift_deg: float = Field(
        ge=-90,
        le=90,
        description="shift of the tooth error by motor angle, in either direction from the mean",
    )
    travel_deg: float = Field(gt=0, le=360, description="motor travel from one flank to the other")


class TrueRate(Strict):
    """Growth of the elastic hysteresis with speed: the contribution of the grease to the rolling friction."""

    growth_per_decade: float = Field(ge=-1, le=5, description="growth of the loop per decade of motor speed")
    from_deg_s: float = Field(gt=0, le=1e5, description="motor speed at which the growth sets in")
    time_constant_s: float = Field(0.05, gt=0, le=1e4, description="time constant of the friction")


class TrueWear(Strict):
    """Lost motion between the teeth, growing with the travel of the motor."""

    arcsec_per_1000_turns: float = Field(
        ge=0, le=36_000, description="lost motion in one direction after the first 1000 motor turns"
    )
    exponent: float = Field(1.0, ge=0.1, le=3, description="growth with the travel; below 1 it runs in")


class TrueAgeing(Strict):
    """Gradual change over hours of work, linear from switch-on, then constant."""

    duration_s: float = Field(gt=0, le=1e8, description="duration of the ageing")
    hysteresis_growth: float = Field(
        0.0, ge=-0.95, le=10, description="growth of the elastic hysteresis by then"
    )
    motor_orders: tuple[TrueOrder, ...] = Field((), description="tooth error over motor angle added by then")


class TrueCreep(Strict):
    """Spring with a dashpot in parallel (Kelvin-Voigt), in series with the gear."""

    time_constant_s: float = Field(gt=0, le=1e6, description="time constant of the element")
    amplitude_arcsec: float = Field(
        0.0, ge=-3_600, le=3_600, description="final yield to the teeth's drag in motion"
    )
    arcsec_per_nm: float = Field(0.0, ge=0, le=3_600, description="final yield to the torque at the load")


class TrueJump(Strict):
    """Tooth jump, a shift that remains in the output."""

    time_s: float = Field(ge=0, le=1e8, description="time since the axis was switched on")
    teeth: int = Field(ge=-100, le=100, description="number of teeth by which the output jumps forward")
    duration_s: float = Field(0.1, gt=0, le=10, description="duration of the jump")


class TrueDamage(Strict):
    """Damaged tooth: a bump of the output at one load angle."""

    at_deg: float = Field(ge=-360, le=360, description="load angle of its centre")
    width_deg: float = Field(gt=0, le=180, description="width from foot to foot, of the load")
    height_arcsec: float = Field(ge=-36_000, le=36_000, description="height at its centre")


class TrueRoller(Strict):
    """Roller on the motor's hub, which is pressed more strongly at some load angles than at others."""

    order: float = Field(gt=0, le=512, description="turns of the roller per motor turn, not a whole number")
    amplitude_arcsec: float = Field(ge=0, le=36_000, description="amplitude at the strongest pressure")
    phase_deg: float = Field(0.0, ge=-360, le=360, description="phase at the motor angle zero")
    pressed_at_deg: float = Field(0.0, ge=-360, le=360, description="load angle of the strongest pressure")
    sharpness: float = Field(
        1.0, gt=0, le=50, description="sharpness of the pressure's fall-off from that angle"
    )


class TrueSeat(Strict):
    """Bearing ring that sticks in its seat, is dragged along, and slips at random angles."""

    slip_arcsec: float = Field(gt=0, le=36_000, description="maximum drag distance, before which it slips")
    travel_deg: float = Field(gt=0, le=1e6, description="motor travel for that drag distance")
    seed: int = Field(0, ge=0, description="seed of the slip positions")


class TrueGear(Strict):
    """Harmonic gear: ratio, elasticity, and causes of transmission error."""

    ratio: float = Field(ge=1, le=1_000, description="motor turns per load turn")
    stiffness_nm_per_rad: float = Field(gt=0, le=1e9, description="flexspline's spring to the load")
    damping_nm_s_per_rad: float = Field(ge=0, le=1e6, description="flexspline's damping, to the load")
    motor_orders: tuple[TrueOrder, ...] = Field((), description="tooth error by motor angle")
    flexspline_orders: tuple[TrueOrder, ...] = Field(
        (), description="tooth error by the angle between wave generator and flexspline: motor (1 + 1/ratio)"
    )
    load_orders: tuple[TrueOrder, ...] = Field((), description="tooth error by load angle")
    hysteresis: Hysteresis | None = Field(None, description="elastic hysteresis law; without it: none")

    flank: TrueFlank | None = Field(None, description="tooth error of the other flank; without it: the same")
    torque_growth_per_nm: float = Field(
        0.0, ge=-1, le=10, description="growth of the tooth error per torque at the load, of either sign"
    )
    stiffening: TrueStiffening | None = Field(None, description="stages of the spring; without it: linear")
    backlash_arcsec: float = Field(
        0.0,
        ge=0,
        le=36_000,
        description="dead zone between the gear's spring and the load, from side to side",
    )
    second_hysteresis: Hysteresis | None = Field(None, description="a second law, added to the first")
    hysteresis_reaction: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the hysteresis that displaces the output and reacts by its slope; "
        "the rest is a friction torque",
    )
    rate_dependence: TrueRate | None = Field(None, description="hysteresis by speed; without it: none")
    wear: TrueWear | None = Field(None, description="lost motion by the travel; without it: none")
    ageing: TrueAgeing | None = Field(None, description="changes with hours of work; without it: none")
    creep: tuple[TrueCreep, ...] = Field((), max_length=16, description="elements that yield in time")
    teeth: int | None = Field(None, ge=3, le=100_000, description="teeth of the output; else twice the ratio")
    jumps: tuple[TrueJump, ...] = Field((), description="teeth jumped, each at its time")
    damage: tuple[TrueDamage, ...] = Field((), max_length=64, description="damaged teeth, by load angle")
    roller: TrueRoller | None = Field(None, description="a roller that beats with the load angle")
    seat: TrueSeat | None = Field(None, description="a bearing ring that slips at random")

    @property
    def stiffest_nm_per_rad(self) -> float:
        """Stiffness of the stiffest stage of the spring."""
        later = self.stiffening
        if later is None:
            return self.stiffness_nm_per_rad
        return max(
            self.stiffness_nm_per_rad, later.second_stiffness_nm_per_rad, later.third_stiffness_nm_per_rad
        )

    @model_validator(mode="after")
    def _teeth_give_way_by_less_than_the_spring(self) -> Self:
        tooth_arcsec = sum(each.amplitude_arcsec for each in self.motor_orders)
        per_nm = math.radians(tooth_arcsec / ARCSEC_PER_DEG) * abs(self.torque_growth_per_nm)
        if per_nm * self.stiffest_nm_per_rad >= 1.0:
            raise wrong(
                f"{self.torque_growth_per_nm:g} makes the teeth yield more than the spring does; expected "
                f"less than {abs(self.torque_growth_per_nm) / per_nm / self.stiffest_nm_per_rad:.2g}",
                "torque_growth_per_nm",
            )
        return self

    @model_validator(mode="after")
    def _each_order_once(self) -> Self:
        for name in ("motor_orders", "flexspline_orders", "load_orders"):
            _refuse_twice(getattr(self, name), name)
        if self.ageing is not None:
            _refuse_twice(self.ageing.motor_orders, "ageing", "motor_orders")
        return self


def _refuse_twice(orders: tuple[TrueOrder, ...], *where: str) -> None:
    seen: set[int] = set()
    for position, each in enumerate(orders):
        if each.order in seen:
            raise wrong(f"order {each.order} appears twice", *where, position, "order")
        seen.add(each.order)
