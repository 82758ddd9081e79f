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
from hdbridge.sim.axis import Axis, Told
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG

FloatArray = fast.FloatArray


class Cycles(NamedTuple):
    """What a machine tells at the end of each of many cycles, by its attributes of the same names."""

    motor_reading: FloatArray
    load_reading: FloatArray
    torque_nm: FloatArray
    torque_permille: FloatArray
    temperature_c: FloatArray
    load_torque_nm: FloatArray


class Machine:
    """A servo axis at rest at the angle zero, its power stage off."""

    motor_counts: int
    """Motor encoder: whole counts, multi-turn, never wrapped. A count's middle is its angle."""
    load_counts: int
    """Load encoder: whole counts, multi-turn, never wrapped; with the noise of this instant."""
    torque_permille: int
    """The motor's torque, in thousandths of the rated one, in the sense of the motor encoder."""
    motor_reading: float
    """The motor encoder in counts, before it is rounded."""
    load_reading: float
    """The load encoder in counts, before it is rounded."""
    velocity_counts_s: float
    """The motor's speed as the drive measures it."""
    torque_nm: float
    """The motor's torque, not rounded, in the sense of the motor encoder."""
    temperature_c: float
    """Temperature of motor and gear."""
    load_torque_nm: float
    """Torque of gravity, and of what acts from outside, on the load, as a sensor at the load's flange tells
    it; its sense is the file's. Drag of the gear's own bearings and the load's inertia are not in it."""
    elapsed_s: float
    """Time since the axis was switched on."""
    true_motor_deg: float
    """The motor's angle itself, for tests."""
    true_load_deg: float
    """The load's angle itself, for tests."""
    true_output_deg: float
    """The gear's output before its spring, for tests: where the load comes to rest."""

    def __init__(self, truth: Truth, seed: int, *, may_compile: bool = False, loaded: bool = False) -> None:
        """``may_compile``: it may stand still for some seconds until it goes on faster; see `sim.fast`.
        ``loaded``: `follow_all` may tell a torque on the load from outside.
        """
        self.truth = truth
        self.dt_s = truth.substep_s
        """Length of a substep."""
        axis = Axis(truth, loaded=loaded)
        self._axis: fast.AnyAxis = axis
        self._to_compile = axis if may_compile else None
        self._noise_deg = truth.load_.encoder.noise_arcsec / ARCSEC_PER_DEG
        self._noise = random.Random(f"load encoder {seed}")
        self._rated_nm = truth.motor.rated_torque_nm
        self._limit_nm = self._rated_limit_nm = axis.loops.servo.limit_nm
        self._limit_permille = 1000.0 * self._limit_nm / self._rated_nm
        self._take(axis.at_first())

    def follow(self, start_counts: float, end_counts: float, substeps: int, outer_nm: float = 0.0) -> None:
        """Closed loop: the demand moves evenly from start to end, in motor counts (may be fractional).

        When the power stage was off before, the loops start from where the motor stands: a demand that rests
        within a count of it does not move the axis.
        """
        if substeps < 1:
            return
        if self._to_compile is not None and fast.waiting.over(substeps):
            self._axis = fast.compiled_axis(self._to_compile)
            self._to_compile = None
        noise_deg = self._chance_deg()
        self._take(self._axis.drive(start_counts, end_counts, substeps, self._limit_nm, noise_deg, outer_nm))

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
        told = np.empty((len(substeps), len(Cycles._fields)))
        for cycle, count in enumerate(substeps):
            if isinstance(self._axis, fast.EvenAxis) and min(substeps[cycle:]) > 0:
                noise_deg = np.array([self._chance_deg() for _ in substeps[cycle:]])
                demand = np.array(counts[cycle:], dtype=np.float64)
                steps = np.array(substeps[cycle:], dtype=np.int64)
                on = slice(cycle, None)
                self._take(
                    self._axis.drive_all(
                        demand, steps, self._limit_nm, noise_deg, outer_nm[on], held_nm[on], told[on]
                    )
                )
                break
            if not math.isnan(held_nm[cycle]):
                self._axis.hold(float(held_nm[cycle]))
            self.follow(counts[cycle], counts[cycle + 1], count, float(outer_nm[cycle]))
            told[cycle] = [getattr(self, name) for name in Cycles._fields]
        return Cycles(*told.T)

    def coast(self, substeps: int, braked: bool, outer_nm: float = 0.0) -> None:
        """Power stage off: friction, or the brake, slows the motor and holds it."""
        brake_nm = self.truth.motor.brake_nm if braked else 0.0
        self._take(self._axis.roll(brake_nm, substeps, self._limit_nm, self._chance_deg(), outer_nm))

    @property
    def torque_limit_permille(self) -> float:
        """Highest torque, in thousandths of the rated one; set it up to what the truth file allows."""
        return self._limit_permille

    @torque_limit_permille.setter
    def torque_limit_permille(self, permille: float) -> None:
        wanted_nm = max(0.0, permille) / 1000.0 * self._rated_nm
        self._limit_nm = min(wanted_nm, self._rated_limit_nm)
        self._limit_permille = 1000.0 * self._limit_nm / self._rated_nm

    def _chance_deg(self) -> float:
        """A sample of the load encoder's noise."""
        return self._noise.gauss(0.0, self._noise_deg) if self._noise_deg else 0.0

    def _take(self, told: Told) -> None:
        """What the axis tells after a cycle."""
        (
            self.motor_reading,
            self.load_reading,
            self.torque_nm,
            self.torque_permille,
            self.temperature_c,
            self.load_torque_nm,
            self.motor_counts,
            self.load_counts,
            self.velocity_counts_s,
            self.elapsed_s,
            self.true_motor_deg,
            self.true_load_deg,
            self.true_output_deg,
        ) = told
