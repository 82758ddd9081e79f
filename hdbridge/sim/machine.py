"""The simulated axis as a drive's firmware has it: loops, motor, gear, load and two encoders.

Deterministic: the same truth and seed, driven alike, give the same numbers bit for bit. It knows no clock;
each call advances it by whole substeps.
"""

from __future__ import annotations

import math
import random

from hdbridge.sim.encoder import Body, Late, Losses, fixed_errors
from hdbridge.sim.gear import warmth_factor
from hdbridge.sim.loaded_plant import LoadedPlant
from hdbridge.sim.plant import Plant
from hdbridge.sim.servo import Servo
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN


class Machine:
    """A servo axis at rest at the angle zero, its power stage off."""

    def __init__(self, truth: Truth, seed: int) -> None:
        self.truth = truth
        self.dt_s = truth.substep_s
        """Length of a substep."""
        self._plant = LoadedPlant(truth) if LoadedPlant.needed(truth) else Plant(truth)
        self._servo = Servo(truth)
        self._powered = False
        self._hold_counts: float | None = None
        self._hold_deg = 0.0
        self._torque_nm = 0.0
        self._copper_loss_w = truth.temperature.copper_loss_w / truth.motor.rated_torque_nm**2
        motor, load = truth.motor.encoder, truth.load_.encoder
        self._motor_counts_per_deg = motor.direction * motor.counts_per_turn / DEG_PER_TURN
        self._load_counts_per_deg = load.direction * load.counts_per_turn / DEG_PER_TURN
        self._noise_deg = load.noise_arcsec / ARCSEC_PER_DEG
        self._noise = random.Random(f"load encoder {seed}")
        self._noise_now_deg = 0.0
        self._rated_limit_nm = self._servo.limit_nm
        self._elapsed_s = 0.0
        self._motor_errors, self._load_errors = fixed_errors(motor), fixed_errors(load)
        self._motor_losses, self._load_losses = Losses(motor.losses), Losses(load.losses)
        body = Body(load, self.dt_s)
        self._body = body if body else None
        start_deg = self._plant.now.motor_deg
        self._late_motor = Late(motor.late_ms / 1e3, self.dt_s, start_deg) if motor.late_ms else None
        start_deg = self._plant.encoder_deg
        self._late_load = Late(load.late_ms / 1e3, self.dt_s, start_deg) if load.late_ms else None
        dead_s = truth.servo.dead_time_ms / 1e3
        self._late_demand = Late(dead_s, self.dt_s, 0.0) if dead_s else None
        self._watched = bool(self._body or self._late_motor or self._late_load)
        self._motor_is_wrong = bool(self._motor_errors or motor.losses)
        self._friction = warmth_factor(truth, truth.temperature.friction_growth_per_k)
        heat = truth.temperature
        self._weather = bool(heat.ambient_k_per_hour or heat.ambient_swing_k)
        self._warm(self._plant.now.temperature_c)

    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        """Closed loop: the demand moves evenly from start to end, in motor counts (may be fractional).

        When the power stage was off before, the loops start from where the motor stands: a demand that rests
        within a count of it does not move the axis.
        """
        if substeps < 1:
            return
        plant, servo = self._plant, self._servo
        conditions = plant.now
        engaged = not self._powered
        if engaged:
            self._powered = True
            self._hold_deg = servo.engage(self._seen_deg(conditions.motor_deg), plant.motor_deg_s)
            near = abs(self._motor_reading(conditions.motor_deg) - start_counts) <= 1.0
            self._hold_counts = start_counts if near else None
        zero = self.truth.motor.encoder.zero_counts
        demand = (start_counts - zero) / self._motor_counts_per_deg
        speed = (end_counts - start_counts) / self._motor_counts_per_deg / (substeps * self.dt_s)
        if self._hold_counts is not None:
            if start_counts == end_counts == self._hold_counts:
                demand = self._hold_deg
            else:
                self._hold_counts = None
        if engaged and self._late_demand is not None:
            self._late_demand = Late(self.truth.servo.dead_time_ms / 1e3, self.dt_s, demand)
        dt = self.dt_s
        torque_of, advance = servo.torque_nm, plant.advance
        torque = squares = 0.0
        late = self._late_demand
        if late is not None:
            for substep in range(substeps):
                before = late.deg
                late.feed(demand + (substep + 1) * dt * speed)
                seen_deg = self._seen_deg(conditions.motor_deg)
                torque = torque_of(before, (late.deg - before) / dt, seen_deg)
                advance(torque, 0.0)
                self._watch()
                squares += torque * torque
        elif self._watched or self._motor_is_wrong:
            for substep in range(substeps):
                seen_deg = self._seen_deg(conditions.motor_deg)
                torque = torque_of(demand + substep * dt * speed, speed, seen_deg)
                advance(torque, 0.0)
                self._watch()
                squares += torque * torque
        else:
            for substep in range(substeps):
                torque = torque_of(demand + substep * dt * speed, speed, conditions.motor_deg)
                advance(torque, 0.0)
                squares += torque * torque
        self._torque_nm = torque
        self._finish(substeps, squares * self._copper_loss_w * dt)

    def coast(self, substeps: int, braked: bool) -> None:
        """Power stage off: friction, or the brake, slows the motor and holds it."""
        self._powered = False
        self._torque_nm = 0.0
        brake_nm = self.truth.motor.brake_nm if braked else 0.0
        for _ in range(substeps):
            self._plant.advance(0.0, brake_nm)
            if self._watched:
                self._watch()
        self._servo.engage(self._seen_deg(self._plant.now.motor_deg), self._plant.motor_deg_s)
        self._finish(substeps, 0.0)

    @property
    def motor_counts(self) -> int:
        """Motor encoder: whole counts, multi-turn, never wrapped. A count's middle is its angle."""
        late = self._late_motor
        return math.floor(self._motor_reading(late.deg if late else self._plant.now.motor_deg) + 0.5)

    @property
    def load_counts(self) -> int:
        """Load encoder: whole counts, multi-turn, never wrapped; with the noise of this instant."""
        late = self._late_load
        deg = late.deg if late else self._plant.encoder_deg
        if self._load_errors:
            deg += sum(each.error_deg(deg) for each in self._load_errors)
        if self._body:
            deg += self._body.deg
        deg += self._noise_now_deg
        return self._load_losses.counts(self._elapsed_s) + math.floor(
            deg * self._load_counts_per_deg + self.truth.load_.encoder.zero_counts + 0.5
        )

    @property
    def velocity_counts_s(self) -> float:
        """The motor's speed as the drive measures it."""
        return self._servo.measured_deg_s * self._motor_counts_per_deg

    @property
    def torque_nm(self) -> float:
        """The motor's torque, not rounded, in the sense of the motor encoder."""
        return self.truth.motor.encoder.direction * self._torque_nm

    @property
    def torque_permille(self) -> int:
        """The motor's torque, in thousandths of the rated one, in the sense of the motor encoder."""
        sense = self.truth.motor.encoder.direction
        return round(1000.0 * sense * self._torque_nm / self.truth.motor.rated_torque_nm)

    @property
    def torque_limit_permille(self) -> float:
        """Highest torque, in thousandths of the rated one; set it up to what the truth file allows."""
        return 1000.0 * self._servo.limit_nm / self.truth.motor.rated_torque_nm

    @torque_limit_permille.setter
    def torque_limit_permille(self, permille: float) -> None:
        wanted_nm = max(0.0, permille) / 1000.0 * self.truth.motor.rated_torque_nm
        self._servo.limit_nm = min(wanted_nm, self._rated_limit_nm)

    @property
    def temperature_c(self) -> float:
        """Temperature of motor and gear."""
        return self._plant.now.temperature_c

    @property
    def load_torque_nm(self) -> float:
        """Torque of gravity on the load, as a sensor at the load's flange tells it; positive forward.

        Drag of the gear's own bearings and the load's inertia are not in it.
        """
        return self._plant.outer_torque_nm

    @property
    def elapsed_s(self) -> float:
        """Time since the axis was switched on."""
        return self._elapsed_s

    @property
    def true_motor_deg(self) -> float:
        """The motor's angle itself, for tests."""
        return self._plant.now.motor_deg

    @property
    def true_load_deg(self) -> float:
        """The load's angle itself, for tests."""
        return self._plant.now.load_deg

    @property
    def true_output_deg(self) -> float:
        """The gear's output before its spring, for tests: where the load comes to rest."""
        return self._plant.output_deg

    def _seen_deg(self, motor_deg: float) -> float:
        """The motor's angle as its encoder sees it, before it is rounded."""
        if not self._motor_is_wrong:
            return motor_deg
        seen_deg = motor_deg + sum(each.error_deg(motor_deg) for each in self._motor_errors)
        return seen_deg + self._motor_losses.counts(self._elapsed_s) / self._motor_counts_per_deg

    def _motor_reading(self, motor_deg: float) -> float:
        """The motor encoder at an angle, before it is rounded."""
        return self._seen_deg(motor_deg) * self._motor_counts_per_deg + self.truth.motor.encoder.zero_counts

    def _watch(self) -> None:
        """What the encoders keep of each substep."""
        plant = self._plant
        if self._late_motor is not None:
            self._late_motor.feed(plant.now.motor_deg)
        if self._late_load is not None:
            self._late_load.feed(plant.encoder_deg)
        if self._body is not None:
            self._body.feed(plant.encoder_deg)

    def _finish(self, substeps: int, copper_j: float) -> None:
        """What is slow against a control cycle: the temperature, and a new sample of the noise."""
        if self._noise_deg:
            self._noise_now_deg = self._noise.gauss(0.0, self._noise_deg)
        heat, plant = self.truth.temperature, self._plant
        elapsed_s = substeps * self.dt_s
        if elapsed_s:
            self._elapsed_s += elapsed_s
            loss_w = (copper_j + plant.loss_j) / elapsed_s
            plant.loss_j = 0.0
            goal_c = heat.ambient_c + heat.resistance_k_per_w * loss_w
            if self._weather:
                goal_c += heat.ambient_k_per_hour * self._elapsed_s / 3600.0
                goal_c += heat.ambient_swing_k * math.sin(math.tau * self._elapsed_s / heat.ambient_period_s)
            nearer = -math.expm1(-elapsed_s / heat.time_constant_s)
            plant.now.temperature_c += (goal_c - plant.now.temperature_c) * nearer
            self._warm(plant.now.temperature_c)

    def _warm(self, temperature_c: float) -> None:
        """Friction by temperature."""
        if self._friction is not None:
            self._plant.scale_friction(self._friction.at(temperature_c))
