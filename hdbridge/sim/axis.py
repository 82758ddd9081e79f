"""Simulated axis, cycle by cycle: servo loops, temperature, and the encoder readings at the end of a cycle.

The class `Axis` contains all computations of `hdbridge.sim.machine` in a cycle except noise, so it can be
compiled as a whole and advanced by one call per cycle.
"""

import math
from typing import NamedTuple

from hdbridge.sim.encoder import FixedErrors, Losses
from hdbridge.sim.heat import Heat
from hdbridge.sim.loops import Loops
from hdbridge.sim.state import state
from hdbridge.sim.truth import Truth
from hdbridge.units import DEG_PER_TURN


class Measured(NamedTuple):
    """Measurements at the end of a cycle."""

    motor_reading: float
    """Reading of the motor encoder in counts, before rounding."""
    load_reading: float
    """Reading of the load encoder in counts, before rounding; includes noise."""
    torque_nm: float
    """Motor torque, not rounded, in the direction of the motor encoder."""
    torque_permille: int
    """Motor torque, in thousandths of the rated torque, in the direction of the motor encoder."""
    temperature_c: float
    """Temperature of motor and gear."""
    load_torque_nm: float
    """Torque of gravity and external torque on the load, as measured at the load's flange, with the sign
    that the truth file states. Friction of the gear's bearings and the load's inertia are not included.
    """
    motor_counts: int
    """Reading of the motor encoder in whole counts, multi-turn, never wrapped.

    A count represents the angle at its middle.
    """
    load_counts: int
    """Reading of the load encoder in whole counts, multi-turn, never wrapped."""
    velocity_counts_s: float
    """Motor speed as measured by the drive."""
    elapsed_s: float
    """Time since the axis was switched on."""
    true_motor_deg: float
    """True motor angle, for tests."""
    true_load_deg: float
    """True load angle, for tests."""
    true_output_deg: float
    """True output angle of the gear before its spring, for tests; an unloaded load comes to rest at this
    angle."""


@state
class Axis:
    """Servo axis, initially at rest at angle zero with its power stage off."""

    heat: Heat
    loops: Loops
    motor_counts_per_deg: float
    _hold_counts: float
    _hold_deg: float
    _holds: bool
    """True while the demand has not changed since switch-on."""
    _load_counts_per_deg: float
    _load_errors: FixedErrors
    _load_losses: Losses
    _load_zero: float
    _motor_errors: FixedErrors
    _motor_losses: Losses
    _motor_sense: float
    _motor_zero: float
    _powered: bool
    _rated_nm: float
    _sense_permille: float
    _torque_sense: float

    def __init__(self, truth: Truth, *, loaded: bool = False) -> None:
        """``loaded`` allows an external torque on the load."""
        motor, load = truth.motor.encoder, truth.load_.encoder
        self.loops = Loops(truth, loaded=loaded)
        self.heat = Heat(truth)
        self._powered = self._holds = False
        self._hold_counts = self._hold_deg = 0.0
        self.motor_counts_per_deg = motor.direction * motor.counts_per_turn / DEG_PER_TURN
        self._motor_zero = float(motor.zero_counts)
        self._motor_errors, self._motor_losses = FixedErrors(motor), Losses(motor.losses)
        self._load_counts_per_deg = load.direction * load.counts_per_turn / DEG_PER_TURN
        self._load_zero = float(load.zero_counts)
        self._load_errors, self._load_losses = FixedErrors(load), Losses(load.losses)
        self._rated_nm = truth.motor.rated_torque_nm
        self._motor_sense = float(motor.direction)
        self._sense_permille = 1000.0 * motor.direction
        self._torque_sense = float(truth.load_.torque_sense)

    def at_first(self) -> Measured:
        """Returns the measurements in the initial state."""
        return self._readings(0.0, 0.0, 0.0)

    def drive(
        self,
        start_counts: float,
        end_counts: float,
        substeps: int,
        limit_nm: float,
        noise_deg: float,
        outer_nm: float,
    ) -> Measured:
        """Runs a closed-loop cycle in which the demand moves linearly from start to end, in motor counts.

        ``limit_nm`` is the torque limit, ``noise_deg`` the noise of the load encoder at the end, ``outer_nm``
        the external torque on the load.
        """
        loops, per_deg = self.loops, self.motor_counts_per_deg
        self._prepare(limit_nm, outer_nm)
        demand_deg = (start_counts - self._motor_zero) / per_deg
        elapsed_s = substeps * loops.dt_s
        speed_deg_s = (end_counts - start_counts) / per_deg / elapsed_s
        engaged = not self._powered
        if engaged:
            self._powered = True
            self._hold_deg = loops.switch_on()
            self._hold_counts = start_counts
            self._holds = abs(self._motor_reading(loops.plant.now.motor_deg) - start_counts) <= 1.0
        if self._holds:
            if start_counts == self._hold_counts and end_counts == self._hold_counts:
                demand_deg = self._hold_deg
            else:
                self._holds = False
        if engaged:
            loops.begin_demand(demand_deg)
        loops.follow(demand_deg, speed_deg_s, substeps)
        return self._readings(elapsed_s, noise_deg, outer_nm)

    def roll(
        self, brake_nm: float, substeps: int, limit_nm: float, noise_deg: float, outer_nm: float
    ) -> Measured:
        """Runs a cycle with the power stage off: friction and the brake slow the motor and hold it."""
        self._powered = False
        self._prepare(limit_nm, outer_nm)
        self.loops.coast(brake_nm, substeps)
        return self._readings(substeps * self.loops.dt_s, noise_deg, outer_nm)

    def hold(self, torque_nm: float) -> None:
        """Sets the torque with which the loops hold the axis at rest."""
        self.loops.hold(torque_nm)

    def _prepare(self, limit_nm: float, outer_nm: float) -> None:
        """Passes the inputs that change only between cycles to the loops."""
        self.loops.take(self.heat.body_c, self.heat.friction_factor, limit_nm, self._lost_deg(), outer_nm)

    def _readings(self, elapsed_s: float, noise_deg: float, outer_nm: float) -> Measured:
        """Returns the drive's measurements at the end of a cycle, from the state of the loops."""
        heat, loops, plant = self.heat, self.loops, self.loops.plant
        if elapsed_s > 0.0:
            heat.warm(loops.torque_squares, plant.loss_j, elapsed_s)
        plant.loss_j = 0.0
        motor_reading = self._motor_reading(loops.sampled_motor_deg())
        load_deg = loops.sampled_load_deg()
        read_deg = load_deg + self._load_errors.at_deg(load_deg) + loops.body.deg + noise_deg
        load_reading = read_deg * self._load_counts_per_deg + self._load_zero
        load_reading += self._load_losses.counts(heat.since_s)
        return Measured(
            motor_reading,
            load_reading,
            self._motor_sense * loops.torque_nm,
            round(self._sense_permille * loops.torque_nm / self._rated_nm),
            heat.body_c,
            self._torque_sense * (plant.weight_nm(plant.now.load_deg) + outer_nm),
            # Multi-turn, never wrapped. A count represents the angle at its middle.
            math.floor(motor_reading + 0.5),
            math.floor(load_reading + 0.5),
            loops.servo.measured_deg_s * self.motor_counts_per_deg,
            heat.since_s,
            plant.now.motor_deg,
            plant.now.load_deg,
            plant.output_deg,
        )

    def _motor_reading(self, motor_deg: float) -> float:
        """Returns the reading of the motor encoder at an angle, in counts before rounding."""
        read_deg = motor_deg + self._motor_errors.at_deg(motor_deg) + self._lost_deg()
        return read_deg * self.motor_counts_per_deg + self._motor_zero

    def _lost_deg(self) -> float:
        """Returns the angle error due to lost counts of the motor encoder, degrees."""
        return self._motor_losses.counts(self.heat.since_s) / self.motor_counts_per_deg
