"""Moves the simulated axis without a bus and records its encoders.

Generates records in bulk, at least 250 times faster than real time, with the same loops, mechanics and
encoders as the drive with firmware. All moves begin and end at rest, with continuous speed.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hdbridge.sim.machine import Machine
from hdbridge.units import DEG_PER_TURN

Floats = NDArray[np.float64]


class Readings(NamedTuple):
    """Readings, one entry per sample; angles as measured by the encoders, multi-turn."""

    time_s: Floats
    motor_deg: Floats
    load_deg: Floats
    target_deg: Floats
    load_torque_nm: Floats
    motor_torque_nm: Floats
    temperature_c: Floats


class Exercise:
    """Moves one machine, with one demand per cycle; distances are motor degrees from its current position."""

    def __init__(self, machine: Machine, cycle_s: float = 0.004, cycles_per_sample: int = 1) -> None:
        self.machine = machine
        self.cycle_s = cycle_s
        self._substeps = round(cycle_s / machine.dt_s)
        if abs(self._substeps * machine.dt_s - cycle_s) > 1e-9:
            raise ValueError(f"cycle_s: found {cycle_s:g}; expected a multiple of {machine.dt_s:g}")
        self._per_sample = cycles_per_sample
        motor, load = machine.truth.motor, machine.truth.load_.encoder
        self._counts_per_deg = motor.encoder.direction * motor.encoder.counts_per_turn / DEG_PER_TURN
        self._load_counts_per_deg = load.direction * load.counts_per_turn / DEG_PER_TURN
        self._rated_nm = motor.encoder.direction * motor.rated_torque_nm
        self._zero = motor.encoder.zero_counts
        self._load_zero = load.zero_counts
        self._cycle = 0
        self._target = float(machine.motor_counts)
        self._parts: list[Floats] = [np.empty((len(Readings._fields), 0))]

    @property
    def target_deg(self) -> float:
        """Last demanded motor angle."""
        return (self._target - self._zero) / self._counts_per_deg

    @property
    def samples(self) -> int:
        """Number of samples recorded so far."""
        return sum(each.shape[1] for each in self._parts)

    def hold(self, duration_s: float) -> None:
        self.lead(lambda seconds: 0.0 * seconds, duration_s)

    def move(self, distance_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """Moves by a distance; each speed ramp is half a cosine with the given peak acceleration."""
        distance = abs(distance_deg)
        ramp_s = 0.5 * math.pi * speed_deg_s / acceleration_deg_s2
        if speed_deg_s * ramp_s > distance:  # short move: it brakes before it reaches full speed
            ramp_s = math.sqrt(0.5 * math.pi * distance / acceleration_deg_s2)
        speed = min(speed_deg_s, distance / ramp_s if ramp_s else speed_deg_s)
        even_s = max(0.0, distance / speed - ramp_s) if speed else 0.0

        def ramped(seconds: Floats | float) -> Floats:
            """Returns the distance covered after a given time of acceleration."""
            return 0.5 * speed * (seconds - ramp_s / math.pi * np.sin(math.pi * seconds / ramp_s))

        def way(seconds: Floats) -> Floats:
            up = ramped(np.clip(seconds, 0.0, ramp_s))
            even = speed * np.clip(seconds - ramp_s, 0.0, even_s)
            left = np.clip(2.0 * ramp_s + even_s - seconds, 0.0, ramp_s)
            down = 0.5 * speed * ramp_s - ramped(left)
            return math.copysign(1.0, distance_deg) * (up + even + down)

        if distance:
            self.lead(way, 2.0 * ramp_s + even_s, distance_deg)

    def sine(self, amplitude_deg: float, frequency_hz: float, periods: float) -> None:
        """Oscillates as 1 - cos, from here to twice the amplitude from here."""
        turn = math.tau * frequency_hz
        self.lead(lambda seconds: amplitude_deg * (1.0 - np.cos(turn * seconds)), periods / frequency_hz)

    def readings(self) -> Readings:
        """Returns all samples recorded so far."""
        return Readings(*np.concatenate(self._parts, axis=1))

    def lead(
        self, way: Callable[[Floats], Floats], duration_s: float, distance_deg: float | None = None
    ) -> None:
        """Follows ``way`` (distance as a function of time) for ``duration_s``.

        The motion ends exactly at ``distance_deg`` if given.
        """
        cycles = max(1, math.ceil(duration_s / self.cycle_s - 1e-9))
        ways = way(np.arange(1, cycles + 1, dtype=np.float64) * self.cycle_s)
        if distance_deg is not None:
            ways[-1] = distance_deg
        target = self._target + self._counts_per_deg * ways
        seen = self.machine.follow_all([self._target, *target.tolist()], [self._substeps] * cycles)
        number = self._cycle + np.arange(1, cycles + 1)
        columns = (
            number * self.cycle_s,
            (np.floor(seen.motor_reading + 0.5) - self._zero) / self._counts_per_deg,
            (np.floor(seen.load_reading + 0.5) - self._load_zero) / self._load_counts_per_deg,
            (target - self._zero) / self._counts_per_deg,
            seen.load_torque_nm,
            seen.torque_permille / 1000.0 * self._rated_nm,
            seen.temperature_c,
        )
        self._parts.append(np.stack(columns)[:, number % self._per_sample == 0])
        self._cycle += cycles
        self._target = float(target[-1])
