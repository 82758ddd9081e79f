"""A foreign axis as the firmware sees it (`hdbridge.device.motion.Machine`): servo, mechanics, encoders.

Deterministic: the same parameters and seed, driven alike, give the same numbers bit for bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from foreign.mechanics import ARCSEC, DT_S, Mechanics, plant_of, substep
from foreign.servos import Servo, demand, loops_of, settle, torque
from numba import njit


@dataclass(frozen=True)
class Encoders:
    """Motor and load encoder. The angle of a count is that of its middle."""

    motor_counts_per_turn: int
    motor_interpolation: int
    """Interpolation steps per count in the control loops. The bus carries whole counts."""
    motor_flicker_counts: float
    """Rms noise of each motor reading, in the loops and on the bus."""
    load_counts_per_turn: int
    load_noise_arcsec: float
    """Rms noise of each load reading."""
    torque_noise_permille: float = 0.0
    """Rms noise of the reported torque, thousandths of the rated torque."""


class ForeignMachine:
    """A foreign servo axis at rest at the angle zero, its power stage off."""

    dt_s = DT_S

    def __init__(self, mechanics: Mechanics, servo: Servo, encoders: Encoders, seed: int) -> None:
        self.mechanics, self.servo, self.encoders = mechanics, servo, encoders
        self.plant, self.loops = plant_of(mechanics), loops_of(servo)
        self._noise = np.random.default_rng([0xF0E, seed])
        self._steps = np.array(
            [
                math.tau / encoders.motor_counts_per_turn,
                encoders.motor_interpolation,
                encoders.motor_flicker_counts,
            ]
        )
        self._powered = False
        self._most_permille = 10.0 * servo.torque_limit_percent
        self._limit_permille = self._most_permille
        self._torque_nm = 0.0
        self.temperature_c = 25.0
        self.elapsed_s = 0.0
        settle(self.loops, 0.0)
        self._sample()

    @property
    def torque_limit_permille(self) -> float:
        """Highest torque, in thousandths of the rated one, up to the servo's own limit."""
        return self._limit_permille

    @torque_limit_permille.setter
    def torque_limit_permille(self, permille: float) -> None:
        self._limit_permille = min(max(0.0, permille), self._most_permille)

    def follow(
        self, start_counts: float, end_counts: float, substeps: int, trace: np.ndarray | None = None
    ) -> None:
        """Follows a demand for one cycle, from set-point ``start_counts`` to set-point ``end_counts``.

        ``trace`` takes one row per substep: motor and load angle in radians, torque in Nm.
        """
        if substeps < 1:
            return
        step = self._steps[0]
        knots = self.loops.knots
        if not self._powered:
            settle(self.loops, start_counts * step)
            self._powered = True
        elif knots[3] != start_counts * step:  # the demand restarts elsewhere
            knots[:4] = start_counts * step
        knots[:3] = knots[1:4]
        knots[3] = end_counts * step
        limit_nm = self._limit_permille / 1000.0 * self.servo.rated_torque_nm
        noise = self._normals(substeps // self.loops.parameters[0]["substeps"] + 1)
        rows = np.empty((0, 3)) if trace is None else trace
        _drive(self.plant, self.loops, self._steps, noise, substeps, limit_nm, rows)
        cycle_s = substeps * DT_S
        knots[4] = (knots[3] - knots[2]) / cycle_s
        self._torque_nm = float(self.loops.state[0]["actual_nm"])
        self.elapsed_s += cycle_s
        self._sample()

    def coast(self, substeps: int, braked: bool) -> None:
        """Runs without torque; friction and, if closed, the brake slow the motor."""
        self._powered = False
        self._torque_nm = 0.0
        _roll(self.plant, self.mechanics.brake_nm if braked else 0.0, substeps)
        self.elapsed_s += substeps * DT_S
        self._sample()

    @property
    def true_motor_deg(self) -> float:
        """True motor angle, for evaluations."""
        return math.degrees(self.plant.state[0]["motor"])

    @property
    def true_load_deg(self) -> float:
        """True load angle, for evaluations."""
        return math.degrees(self.plant.state[0]["load"])

    @property
    def load_torque_nm(self) -> float:
        """Torque of gravity on the load."""
        return -self.mechanics.gravity_nm * math.sin(self.plant.state[0]["load"])

    def _normals(self, count: int) -> np.ndarray:
        return self._noise.standard_normal(count)

    def _sample(self) -> None:
        """Samples encoders and torque as the drive reports them."""
        encoders, state = self.encoders, self.plant.state[0]
        motor, load, current = self._normals(3).tolist()
        self.motor_counts = round(state["motor"] / self._steps[0] + encoders.motor_flicker_counts * motor)
        noisy = state["load"] + encoders.load_noise_arcsec * ARCSEC * load
        self.load_counts = round(noisy * encoders.load_counts_per_turn / math.tau)
        self.velocity_counts_s = float(state["motor_speed"] / self._steps[0])
        permille = 1000.0 * self._torque_nm / self.servo.rated_torque_nm
        self.torque_permille = round(permille + encoders.torque_noise_permille * current)


@njit(cache=True)
def _drive(plant, loops, encoder, noise, count, limit_nm, trace):
    """Advances by ``count`` substeps. ``encoder``: radians per count, steps per count, flicker in counts."""
    p, s, sample = loops.parameters[0], loops.state[0], 0
    limit_nm = min(limit_nm, p.torque_limit)
    for i in range(count):
        if i % p.substeps == 0:
            reading = plant.state[0].motor / encoder[0] + encoder[2] * noise[sample]
            reading = round(reading * encoder[1]) / encoder[1] * encoder[0]
            target = demand(p.interpolation, loops.knots, i / count, count * DT_S)
            torque(loops, reading, target[0], target[1], target[2], limit_nm)
            sample += 1
        missing_nm = s.torque_nm - s.actual_nm
        mean_nm = s.torque_nm - p.current_mean * missing_nm
        s.actual_nm += p.current_share * missing_nm
        substep(plant.parameters, plant.orders, plant.elements, plant.state, mean_nm, 0.0)
        if trace.shape[0] > 0:
            trace[i, 0], trace[i, 1], trace[i, 2] = plant.state[0].motor, plant.state[0].load, s.actual_nm


@njit(cache=True)
def _roll(plant, brake_nm, count):
    """Advances by ``count`` substeps without torque."""
    for _ in range(count):
        substep(plant.parameters, plant.orders, plant.elements, plant.state, 0.0, brake_nm)
