"""The simulated axis as a drive's firmware has it: loops, motor, gear, load and two encoders.

Deterministic: the same truth and seed, driven alike, give the same numbers bit for bit. It knows no clock;
each call advances it by whole substeps.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hdbridge.sim import fast
from hdbridge.sim.encoder import Losses, fixed_errors
from hdbridge.sim.heat import Heat
from hdbridge.sim.loops import Loops, Seen, Slow
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

FloatArray = fast.FloatArray


class Cycles(NamedTuple):
    """What a machine tells at the end of each of many cycles, as its properties do."""

    motor_reading: FloatArray
    load_reading: FloatArray
    torque_nm: FloatArray
    torque_permille: FloatArray
    temperature_c: FloatArray
    load_torque_nm: FloatArray


class Machine:
    """A servo axis at rest at the angle zero, its power stage off."""

    def __init__(self, truth: Truth, seed: int, *, may_compile: bool = False, loaded: bool = False) -> None:
        """``may_compile``: it may stand still for some seconds until it goes on faster; see `sim.fast`.
        ``loaded``: `follow_all` may tell a torque on the load from outside.
        """
        self.truth = truth
        self.dt_s = truth.substep_s
        """Length of a substep."""
        loops = Loops(truth, loaded=loaded)
        self._loops: fast.AnyLoops = loops
        self._to_compile = loops if may_compile else None
        self._powered = False
        self._hold_counts: float | None = None
        self._hold_deg = 0.0
        motor, load = truth.motor.encoder, truth.load_.encoder
        self._motor_counts_per_deg = motor.direction * motor.counts_per_turn / DEG_PER_TURN
        self._motor_zero = motor.zero_counts
        self._load_counts_per_deg = load.direction * load.counts_per_turn / DEG_PER_TURN
        self._load_zero = load.zero_counts
        self._noise_deg = load.noise_arcsec / ARCSEC_PER_DEG
        self._torque_sense = float(truth.load_.torque_sense)
        self._noise = random.Random(f"load encoder {seed}")
        self._noise_now_deg = 0.0
        self._rated_nm = truth.motor.rated_torque_nm
        self._limit_nm = self._rated_limit_nm = loops.servo.limit_nm
        self._limit_permille = 1000.0 * self._limit_nm / self._rated_nm
        self._sense_permille = 1000.0 * motor.direction
        self._heat = Heat(truth)
        self._motor_errors, self._load_errors = fixed_errors(motor), fixed_errors(load)
        self._motor_losses = Losses(motor.losses) if motor.losses else None
        self._load_losses = Losses(load.losses) if load.losses else None
        self._see(loops.seen())
        self._sample()

    def follow(self, start_counts: float, end_counts: float, substeps: int, outer_nm: float = 0.0) -> None:
        """Closed loop: the demand moves evenly from start to end, in motor counts (may be fractional).

        When the power stage was off before, the loops start from where the motor stands: a demand that rests
        within a count of it does not move the axis.
        """
        if substeps < 1:
            return
        if self._to_compile is not None and fast.waiting.over(substeps):
            self._loops = fast.compiled_loops(self._to_compile)
            self._to_compile = None
        loops, slow = self._loops, self._slow(outer_nm)
        engaged = not self._powered
        if engaged:
            self._powered = True
            self._hold_deg = loops.power_on(slow)
            near = abs(self._motor_reading(self._motor_deg) - start_counts) <= 1.0
            self._hold_counts = start_counts if near else None
        per_deg = self._motor_counts_per_deg
        demand_deg = (start_counts - self._motor_zero) / per_deg
        elapsed_s = substeps * self.dt_s
        speed_deg_s = (end_counts - start_counts) / per_deg / elapsed_s
        if self._hold_counts is not None:
            if start_counts == end_counts == self._hold_counts:
                demand_deg = self._hold_deg
            else:
                self._hold_counts = None
        if engaged:
            loops.begin_demand(demand_deg)
        self._see(loops.follow(demand_deg, speed_deg_s, substeps, slow))
        self._finish(elapsed_s)

    def follow_all(
        self,
        counts: Sequence[float],
        substeps: Sequence[int],
        outer_nm: FloatArray | None = None,
        held_nm: FloatArray | None = None,
    ) -> Cycles:
        """Closed loop over many cycles, each from the demand before it; the same numbers as by `follow`.

        ``counts`` has the demand at the begin and at the end of each cycle, ``substeps`` how many each has,
        ``outer_nm`` the torque on the load from outside in each, in addition to its weight, ``held_nm`` the
        torque by which the loops hold the axis before each, positive forward; NaN where they go on.
        """
        outer_nm = np.zeros(len(substeps)) if outer_nm is None else outer_nm
        held_nm = np.full(len(substeps), np.nan) if held_nm is None else held_nm
        told = Cycles(*(np.empty(len(substeps)) for _ in Cycles._fields))
        done = 0
        while done < len(substeps):
            if self._evenly(substeps):
                rest = Cycles(*(each[done:] for each in told))
                self._follow_compiled(counts[done:], substeps[done:], outer_nm[done:], held_nm[done:], rest)
                break
            if not math.isnan(held_nm[done]):
                self._loops.hold(float(held_nm[done]))
            self.follow(counts[done], counts[done + 1], substeps[done], float(outer_nm[done]))
            told.motor_reading[done] = self.motor_reading
            told.load_reading[done] = self.load_reading
            told.torque_nm[done] = self.torque_nm
            told.torque_permille[done] = self.torque_permille
            told.temperature_c[done] = self.temperature_c
            told.load_torque_nm[done] = self._torque_sense * (self._weight_nm + outer_nm[done])
            done += 1
        return told

    def _evenly(self, substeps: Sequence[int]) -> bool:
        """Whether the compiled loops can go on by themselves: nothing happens between the cycles."""
        if not self._powered or self._to_compile is not None:
            return False
        if self._motor_errors or self._load_errors or self._motor_losses or self._load_losses:
            return False
        return isinstance(self._loops, fast.EvenLoops) and min(substeps) > 0

    def _follow_compiled(
        self,
        counts: Sequence[float],
        substeps: Sequence[int],
        outer_nm: FloatArray,
        held_nm: FloatArray,
        told: Cycles,
    ) -> None:
        per_deg, steps = self._motor_counts_per_deg, np.array(substeps, dtype=np.int64)
        demand = np.array(counts, dtype=np.float64)
        start_deg = (demand[:-1] - self._motor_zero) / per_deg
        if self._hold_counts is not None:
            moves = np.flatnonzero((demand[:-1] != self._hold_counts) | (demand[1:] != self._hold_counts))
            start_deg[: moves[0] if len(moves) else len(steps)] = self._hold_deg
            if len(moves):
                self._hold_counts = None
        speed_deg_s = (demand[1:] - demand[:-1]) / per_deg / (steps * self.dt_s)
        assert isinstance(self._loops, fast.EvenLoops)
        seen, told.temperature_c[:] = self._loops.follow_all(
            start_deg, speed_deg_s, steps, self._heat, self._limit_nm, outer_nm, held_nm
        )
        noise = np.zeros(len(steps))
        if self._noise_deg:
            noise = np.array([self._noise.gauss(0.0, self._noise_deg) for _ in steps])
        self._see(tuple(seen[-1].tolist()))
        self._noise_now_deg = float(noise[-1])
        self._sample()
        _, motor_deg, _, load_deg, body_deg, _, _, weight_nm, torque_nm, _, _ = seen.T
        told.motor_reading[:] = motor_deg * self._motor_counts_per_deg + self._motor_zero
        told.load_reading[:] = (load_deg + body_deg + noise) * self._load_counts_per_deg + self._load_zero
        told.torque_nm[:] = self.truth.motor.encoder.direction * torque_nm
        told.torque_permille[:] = np.round(self._sense_permille * torque_nm / self._rated_nm)
        told.load_torque_nm[:] = self._torque_sense * (weight_nm + outer_nm)

    def coast(self, substeps: int, braked: bool, outer_nm: float = 0.0) -> None:
        """Power stage off: friction, or the brake, slows the motor and holds it."""
        self._powered = False
        brake_nm = self.truth.motor.brake_nm if braked else 0.0
        self._see(self._loops.coast(brake_nm, substeps, self._slow(outer_nm)))
        self._finish(substeps * self.dt_s)

    @property
    def velocity_counts_s(self) -> float:
        """The motor's speed as the drive measures it."""
        return self._measured_deg_s * self._motor_counts_per_deg

    @property
    def torque_nm(self) -> float:
        """The motor's torque, not rounded, in the sense of the motor encoder."""
        return self.truth.motor.encoder.direction * self._torque_nm

    @property
    def torque_limit_permille(self) -> float:
        """Highest torque, in thousandths of the rated one; set it up to what the truth file allows."""
        return self._limit_permille

    @torque_limit_permille.setter
    def torque_limit_permille(self, permille: float) -> None:
        wanted_nm = max(0.0, permille) / 1000.0 * self._rated_nm
        self._limit_nm = min(wanted_nm, self._rated_limit_nm)
        self._limit_permille = 1000.0 * self._limit_nm / self._rated_nm

    @property
    def temperature_c(self) -> float:
        """Temperature of motor and gear."""
        return self._heat.body_c

    @property
    def load_torque_nm(self) -> float:
        """Torque of gravity on the load, as a sensor at the load's flange tells it; its sense is the file's.

        Drag of the gear's own bearings and the load's inertia are not in it.
        """
        return self._torque_sense * self._weight_nm

    @property
    def elapsed_s(self) -> float:
        """Time since the axis was switched on."""
        return self._heat.since_s

    @property
    def true_motor_deg(self) -> float:
        """The motor's angle itself, for tests."""
        return self._motor_deg

    @property
    def true_load_deg(self) -> float:
        """The load's angle itself, for tests."""
        return self._load_deg

    @property
    def true_output_deg(self) -> float:
        """The gear's output before its spring, for tests: where the load comes to rest."""
        return self._output_deg

    def _slow(self, outer_nm: float = 0.0) -> Slow:
        """What the loops have to know for the next cycle."""
        return self._heat.body_c, self._heat.rub, self._limit_nm, self._lost_deg(), outer_nm

    def _see(self, seen: Seen) -> None:
        """What the loops say after a cycle."""
        (
            self._motor_deg,
            self._sampled_motor_deg,
            self._load_deg,
            self._sampled_load_deg,
            self._body_deg,
            self._output_deg,
            self._measured_deg_s,
            self._weight_nm,
            self._torque_nm,
            self._torque_squares,
            self._friction_j,
        ) = seen

    def _sample(self) -> None:
        """What the drive measures at the end of a cycle; asked more often than it changes."""
        self.motor_reading = self._motor_reading(self._sampled_motor_deg)
        """The motor encoder in counts, before it is rounded."""
        self.motor_counts = math.floor(self.motor_reading + 0.5)
        """Motor encoder: whole counts, multi-turn, never wrapped. A count's middle is its angle."""
        deg = self._sampled_load_deg
        if self._load_errors:
            deg += sum(each.error_deg(deg) for each in self._load_errors)
        deg += self._body_deg
        deg += self._noise_now_deg
        reading = deg * self._load_counts_per_deg + self._load_zero
        if self._load_losses is not None:
            reading += self._load_losses.counts(self._heat.since_s)
        self.load_reading = reading
        """The load encoder in counts, before it is rounded."""
        self.load_counts = math.floor(reading + 0.5)
        """Load encoder: whole counts, multi-turn, never wrapped; with the noise of this instant."""
        self.torque_permille = round(self._sense_permille * self._torque_nm / self._rated_nm)
        """The motor's torque, in thousandths of the rated one, in the sense of the motor encoder."""

    def _lost_deg(self) -> float:
        """What the motor encoder has lost."""
        if self._motor_losses is None:
            return 0.0
        return self._motor_losses.counts(self._heat.since_s) / self._motor_counts_per_deg

    def _motor_reading(self, motor_deg: float) -> float:
        """The motor encoder at an angle, before it is rounded."""
        if self._motor_errors:
            motor_deg += sum(each.error_deg(motor_deg) for each in self._motor_errors)
        if self._motor_losses is not None:
            motor_deg += self._lost_deg()
        return motor_deg * self._motor_counts_per_deg + self._motor_zero

    def _finish(self, elapsed_s: float) -> None:
        """What is slow against a control cycle: the temperature, and a new sample of the noise."""
        if self._noise_deg:
            self._noise_now_deg = self._noise.gauss(0.0, self._noise_deg)
        if elapsed_s:
            self._heat.warm(self._torque_squares, self._friction_j, elapsed_s)
        self._sample()
