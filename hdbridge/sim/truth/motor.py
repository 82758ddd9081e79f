"""Sections ``motor`` and ``servo`` of the truth file."""

from typing import Literal

from pydantic import Field

from hdbridge.sim.truth.encoder import TrueMotorEncoder
from hdbridge.strictness import Strict


class TrueMotorStribeck(Strict):
    """Friction on the motor's shaft that increases as the speed approaches zero, where no lubricant film
    forms.
    """

    rise: float = Field(ge=0, le=10, description="increase at rest, as a fraction of the Coulomb friction")
    speed_rad_s: float = Field(gt=0, le=1_000, description="speed at which the increase has fallen to 1/e")


class TrueMotor(Strict):
    """Motor with the wave generator, and the friction on their shaft."""

    inertia_kg_m2: float = Field(gt=0, le=100, description="inertia of motor and wave generator")
    rated_torque_nm: float = Field(gt=0, le=10_000, description="rated torque, the unit of 6077h")
    coulomb_nm: float = Field(
        0.0, ge=0, le=10_000, description="Coulomb friction; it holds the shaft at rest"
    )
    viscous_nm_s_per_rad: float = Field(0.0, ge=0, le=1_000, description="viscous friction")
    stribeck: TrueMotorStribeck | None = Field(
        None, description="friction near rest; without it: Coulomb only"
    )
    brake_nm: float = Field(1.0, ge=0, le=100_000, description="torque up to which the brake holds")
    encoder: TrueMotorEncoder = Field(description="encoder on the motor shaft")


class TrueLoadFeedforward(Strict):
    """Drive's model of the load behind the gear's spring, as commissioned."""

    inertia_kg_m2: float = Field(gt=0, le=100, description="inertia of the load, seen by the motor")
    frequency_hz: float = Field(ge=1, le=500, description="natural frequency of the load, the motor held")
    damping_ratio: float = Field(ge=0, le=2, description="damping ratio of the load, the motor held")


class TrueNotch(Strict):
    """Notch on the torque, exact at its frequency (bilinear transform)."""

    frequency_hz: float = Field(gt=0, le=900, description="centre, at most 0.45 of the rate of the substeps")
    depth: float = Field(ge=0, le=1, description="gain at the centre")
    width: float = Field(gt=0, le=10, description="bandwidth over the frequency")


class TrueObserver(Strict):
    """Disturbance observer: low-pass of the motor torque minus the torque that accelerates the inertia."""

    frequency_hz: float = Field(gt=0, le=500, description="corner frequency of the estimate")
    share: float = Field(ge=0, le=1, description="part of the estimate that is added to the torque")
    inertia_kg_m2: float = Field(gt=0, le=100, description="inertia that the observer assumes, at the motor")


class TrueResponse(Strict):
    """Measured response in addition to the loops, by cycle, latest first."""

    cycle_ms: float = Field(gt=0, le=1_000, description="control cycle of the responses")
    demand_ms: tuple[float, ...] = Field(
        (), max_length=4096, description="added to the demand, per speed of the command"
    )
    torque_nm_s_per_rad: tuple[float, ...] = Field(
        (), max_length=4096, description="added to the reported torque, per speed of the command"
    )
    torque_nm: tuple[float, ...] = Field(
        (), max_length=4096, description="added to the reported torque in the direction of the command"
    )


class TrueServo(Strict):
    """Loops of the drive: position and velocity cascade with feed-forward, limited in torque."""

    position_gain_per_s: float = Field(gt=0, le=5_000, description="position loop: speed per position error")
    velocity_gain_nm_s_per_rad: float = Field(
        gt=0, le=1_000, description="velocity loop: torque per speed error"
    )
    integral_time_ms: float = Field(gt=0, le=10_000, description="velocity loop: integral time")
    integral_of: Literal["speed", "position"] = Field(
        "speed", description="error that is integrated: speed (PI) or position (PIV)"
    )
    integral_dead_band: float = Field(
        1.0,
        ge=0,
        le=1_000,
        description="shortfall within which the integral is held once the demand rests, in interpolated "
        "steps",
    )
    hunting_band: float = Field(
        16.0,
        ge=0,
        le=100_000,
        description="overshoot within which the motor rests and does not hunt, in interpolated steps",
    )
    command_filter_ms: float = Field(
        gt=0, le=100, description="time constant of the second-order filter on the demand"
    )
    moving_average_ms: float = Field(0.0, ge=0, le=100, description="moving average of the demand")
    speed_filter_ms: float = Field(
        0.0, ge=0, le=100, description="time constant of the lag on the measured speed"
    )
    torque_filter_ms: float = Field(0.0, ge=0, le=100, description="time constant of the lag on the torque")
    notch: TrueNotch | None = Field(None, description="notch on the torque; without it: none")
    observer: TrueObserver | None = Field(None, description="disturbance observer; without it: none")
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
    dead_time_ms: float = Field(0.0, ge=0, le=100, description="age of the demand when the loops use it")
    torque_limit_percent: float = Field(gt=0, le=1_000, description="highest torque, of the rated one")
    response: TrueResponse | None = Field(
        None,
        description="measured response in addition to the loops; without it: none",
    )
