"""Simulated axis, cycle by cycle: servo loops, mechanics, temperature, and the encoder readings at the end.

The class `Axis` contains all computations of `hdbridge.sim.machine` in a cycle except noise, so it can be
compiled as a whole and advanced by one call per cycle.
"""

import math
from typing import NamedTuple

from hdbridge.sim.encoder import Body, FixedErrors, Late, Losses
from hdbridge.sim.heat import Heat
from hdbridge.sim.loaded_plant import LoadedPlant
from hdbridge.sim.plant import Plant
from hdbridge.sim.servo import Servo
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

    _holds: bool
    """True while the demand has not changed since switch-on."""
    _plain: bool
    """True if the demand is not delayed and the encoders are ideal."""

    def __init__(self, truth: Truth, *, loaded: bool = False) -> None:
        """``loaded`` allows an external torque on the load."""
        motor, load = truth.motor.encoder, truth.load_.encoder
        dt_s = self._dt_s = truth.substep_s
        self.plant: Plant = LoadedPlant(truth) if loaded or LoadedPlant.needed(truth) else Plant(truth)
        self.servo = Servo(truth)
        self.heat = Heat(truth)
        self._powered = self._holds = False
        self._hold_counts = self._hold_deg = 0.0
        self.motor_counts_per_deg = motor.direction * motor.counts_per_turn / DEG_PER_TURN
        self._motor_zero = float(motor.zero_counts)
        self._motor_errors = FixedErrors(motor)
        self._motor_losses = Losses(motor.losses)
        self._load_counts_per_deg = load.direction * load.counts_per_turn / DEG_PER_TURN
        self._load_zero = float(load.zero_counts)
        self._load_errors = FixedErrors(load)
        self._load_losses = Losses(load.losses)
        self._body = Body(load, dt_s)
        self._with_late_motor = bool(motor.late_ms)
        self._late_motor = Late(motor.late_ms / 1e3, dt_s, self.plant.now.motor_deg)
        self._with_late_load = bool(load.late_ms)
        self._late_load = Late(load.late_ms / 1e3, dt_s, self.plant.encoder_deg)
        self._with_late_demand = bool(truth.servo.dead_time_ms)
        self._late_demand = Late(truth.servo.dead_time_ms / 1e3, dt_s, 0.0)
        late = self._with_late_motor or self._with_late_load or self._with_late_demand
        self._plain = not (motor.disc or motor.losses or late or self._body.moves)
        self._rated_nm = truth.motor.rated_torque_nm
        # Largest rounding error of the reported torque: half a thousandth of the rated torque.
        self._rounded_nm = 0.0005 * self._rated_nm
        self._motor_sense = float(motor.direction)
        self._sense_permille = 1000.0 * motor.direction
        self._torque_sense = float(truth.load_.torque_sense)
        self._torque_nm = self._torque_squares = 0.0
        self._lost_deg = self._motor_losses.counts(0.0) / self.motor_counts_per_deg

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
        per_deg = self.motor_counts_per_deg
        self._prepare(limit_nm, outer_nm)
        demand_deg = (start_counts - self._motor_zero) / per_deg
        elapsed_s = substeps * self._dt_s
        speed_deg_s = (end_counts - start_counts) / per_deg / elapsed_s
        engaged = not self._powered
        if engaged:
            self._powered = True
            self._hold_deg = self._switch_on()
            self._hold_counts = start_counts
            self._holds = abs(self._motor_reading(self.plant.now.motor_deg) - start_counts) <= 1.0
        if self._holds:
            if start_counts == self._hold_counts and end_counts == self._hold_counts:
                demand_deg = self._hold_deg
            else:
                self._holds = False
        if engaged:
            self._late_demand.begin(demand_deg)
        self._follow(demand_deg, speed_deg_s, substeps)
        return self._readings(elapsed_s, noise_deg, outer_nm)

    def roll(
        self, brake_nm: float, substeps: int, limit_nm: float, noise_deg: float, outer_nm: float
    ) -> Measured:
        """Runs a cycle with the power stage off: friction and the brake slow the motor and hold it."""
        self._powered = False
        self._prepare(limit_nm, outer_nm)
        self._torque_nm = self._torque_squares = 0.0
        for _ in range(substeps):
            self.plant.step(0.0, brake_nm)
            if not self._plain:
                self._watch()
        self._switch_on()
        return self._readings(substeps * self._dt_s, noise_deg, outer_nm)

    def hold(self, torque_nm: float) -> None:
        """Shifts the integral so that the motor's torque at rest rounds to the reading ``torque_nm``."""
        off_nm = torque_nm - self._torque_nm
        off_nm -= min(max(off_nm, -self._rounded_nm), self._rounded_nm)
        self.servo.shift(off_nm)
        self._torque_nm += off_nm

    def _prepare(self, limit_nm: float, outer_nm: float) -> None:
        """Passes the inputs that change only between cycles to the loops and the mechanics."""
        self.plant.now.temperature_c = self.heat.body_c
        self.plant.scale_friction(self.heat.friction_factor)
        self.servo.limit_nm = limit_nm
        self.plant.outer_nm = outer_nm

    def _switch_on(self) -> float:
        """Starts the loops at the motor angle that they measure, and returns that angle."""
        return self.servo.engage(self._seen_deg(self.plant.now.motor_deg), self.plant.motor_deg_s)

    def _follow(self, demand_deg: float, demand_deg_s: float, substeps: int) -> None:
        """Runs some substeps in closed loop, during which the demand moves linearly."""
        servo, plant, dt = self.servo, self.plant, self._dt_s
        now = plant.now
        torque = squares = 0.0
        if self._plain:
            for substep in range(substeps):
                torque = servo.answer_nm(
                    demand_deg + substep * dt * demand_deg_s, demand_deg_s, now.motor_deg
                )
                plant.step(torque, 0.0)
                squares += torque * torque
        else:
            late = self._late_demand
            for substep in range(substeps):
                place_deg, speed_deg_s = demand_deg + substep * dt * demand_deg_s, demand_deg_s
                if self._with_late_demand:
                    place_deg = late.deg
                    late.feed(demand_deg + (substep + 1) * dt * demand_deg_s)
                    speed_deg_s = (late.deg - place_deg) / dt
                torque = servo.answer_nm(place_deg, speed_deg_s, self._seen_deg(now.motor_deg))
                plant.step(torque, 0.0)
                self._watch()
                squares += torque * torque
        self._torque_nm, self._torque_squares = torque, squares

    def _watch(self) -> None:
        """Updates the delays and the body of the load encoder by one substep."""
        plant = self.plant
        if self._with_late_motor:
            self._late_motor.feed(plant.now.motor_deg)
        if self._with_late_load:
            self._late_load.feed(plant.encoder_deg)
        if self._body.moves:
            self._body.feed(plant.encoder_deg)

    def _readings(self, elapsed_s: float, noise_deg: float, outer_nm: float) -> Measured:
        """Returns the drive's measurements at the end of a cycle, from the state of the axis."""
        heat, plant = self.heat, self.plant
        if elapsed_s > 0.0:
            heat.warm(self._torque_squares, plant.loss_j, elapsed_s)
        plant.loss_j = 0.0
        self._lost_deg = self._motor_losses.counts(heat.since_s) / self.motor_counts_per_deg
        motor_deg = self._late_motor.deg if self._with_late_motor else plant.now.motor_deg
        load_deg = self._late_load.deg if self._with_late_load else plant.encoder_deg
        motor_reading = self._motor_reading(motor_deg)
        read_deg = load_deg + self._load_errors.at_deg(load_deg) + self._body.deg + noise_deg
        load_reading = read_deg * self._load_counts_per_deg + self._load_zero
        load_reading += self._load_losses.counts(heat.since_s)
        return Measured(
            motor_reading,
            load_reading,
            self._motor_sense * self._torque_nm,
            round(self._sense_permille * self._torque_nm / self._rated_nm),
            heat.body_c,
            self._torque_sense * (plant.weight_nm(plant.now.load_deg) + outer_nm),
            # Multi-turn, never wrapped. A count represents the angle at its middle.
            math.floor(motor_reading + 0.5),
            math.floor(load_reading + 0.5),
            self.servo.measured_deg_s * self.motor_counts_per_deg,
            heat.since_s,
            plant.now.motor_deg,
            plant.now.load_deg,
            plant.output_deg,
        )

    def _seen_deg(self, motor_deg: float) -> float:
        """Returns the motor angle as measured by its encoder, before rounding."""
        return motor_deg + self._motor_errors.at_deg(motor_deg) + self._lost_deg

    def _motor_reading(self, motor_deg: float) -> float:
        """Returns the reading of the motor encoder at an angle, in counts before rounding."""
        return self._seen_deg(motor_deg) * self.motor_counts_per_deg + self._motor_zero
