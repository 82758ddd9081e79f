"""Simulated axis as seen by a drive's firmware: loops, motor, gear, load and two encoders.

Deterministic: the same truth, seed and commands yield the same numbers bit for bit. The machine has no clock;
each call advances it by whole substeps.
"""

from __future__ import annotations

import copy
import math
import random
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hdbridge.sim import fast
from hdbridge.sim.axis import Axis, Measured
from hdbridge.sim.response import Response
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG

FloatArray = fast.FloatArray


class Cycles(NamedTuple):
    """Measurements at the end of many cycles, named like the machine's attributes; shape (n,) each."""

    motor_reading: FloatArray
    load_reading: FloatArray
    torque_nm: FloatArray
    torque_permille: FloatArray
    temperature_c: FloatArray
    load_torque_nm: FloatArray


class Machine:
    """Servo axis, initially at rest at angle zero with its power stage off.

    Its attributes include those of `Measured`.
    """

    def __init__(self, truth: Truth, seed: int, *, may_compile: bool = False, loaded: bool = False) -> None:
        """``may_compile`` permits a pause of some seconds, then the machine is faster (`sim.fast`).

        ``loaded`` permits an external torque on the load in `follow_all`.
        """
        self.truth = truth
        self.dt_s = truth.substep_s
        axis = Axis(truth, loaded=loaded)
        self._axis: fast.AnyAxis = axis
        self._to_compile = axis if may_compile else None
        self._compile_after(0)
        self._noise_deg = truth.load_.encoder.noise_arcsec / ARCSEC_PER_DEG
        self._noise = random.Random(f"load encoder {seed}")
        self._rated_nm = truth.motor.rated_torque_nm
        self._sense = float(truth.motor.encoder.direction)
        self._limit_nm = self._rated_limit_nm = axis.servo.limit_nm
        self._limit_permille = 1000.0 * self._limit_nm / self._rated_nm
        self._response: Response | None = None
        if truth.servo.response is not None:
            self._response = Response(truth.servo.response, math.degrees(axis.motor_counts_per_deg))
        self._take(axis.at_first())

    def copy(self) -> Machine:
        """Returns an independent machine in the same state; faster than building a new one."""
        other = copy.copy(self)
        other._axis, other._response = copy.deepcopy((self._axis, self._response))
        other._noise = copy.copy(self._noise)
        if self._to_compile is not None:
            assert isinstance(other._axis, Axis)
            other._to_compile = other._axis
        return other

    def follow(self, start_counts: float, end_counts: float, substeps: int, outer_nm: float = 0.0) -> None:
        """Runs a closed-loop cycle in which the demand moves linearly from start to end, in motor counts.

        If the power stage was off, the loops start at the motor's position, so a resting demand within a
        count of this position does not move the axis.
        """
        if substeps < 1:
            return
        self._compile_after(substeps)
        noise_deg = self._chance_deg()
        if self._response is not None:
            before = self._response.demand_counts
            self._response.advance(start_counts, end_counts, substeps * self.dt_s)
            start_counts, end_counts = start_counts + before, end_counts + self._response.demand_counts
        self._take(self._axis.drive(start_counts, end_counts, substeps, self._limit_nm, noise_deg, outer_nm))

    def follow_all(
        self,
        counts: Sequence[float],
        substeps: Sequence[int],
        outer_nm: FloatArray | None = None,
        held_nm: FloatArray | None = None,
    ) -> Cycles:
        """Runs many closed-loop cycles, each from the previous demand, with the same results as `follow`.

        ``counts`` contains the demand at the start of the first and at the end of each cycle, shape (n + 1,);
        ``substeps`` the substeps of each cycle; ``outer_nm`` the external torque on the load in each cycle,
        in addition to its weight; ``held_nm`` the torque with which the loops hold the axis before each
        cycle, positive forward, or NaN for no change.
        """
        outer_nm = np.zeros(len(substeps)) if outer_nm is None else outer_nm
        held_nm = np.full(len(substeps), np.nan) if held_nm is None else held_nm
        readings = np.empty((len(substeps), len(Cycles._fields)))
        for cycle, count in enumerate(substeps):
            if not isinstance(self._axis, Axis) and min(substeps[cycle:]) > 0:
                counts, torque_nm = self._responded(counts, substeps, cycle)
                noise_deg = np.zeros(len(substeps) - cycle)
                if self._noise_deg:
                    noise_deg[:] = [self._chance_deg() for _ in noise_deg]
                demand = np.array(counts[cycle:], dtype=np.float64)
                steps = np.array(substeps[cycle:], dtype=np.int64)
                on = slice(cycle, None)
                self._take(
                    self._axis.drive_all(
                        demand, steps, self._limit_nm, noise_deg, outer_nm[on], held_nm[on], readings[on]
                    )
                )
                if self._response is not None:
                    readings[on, 2] += torque_nm
                    readings[on, 3] = [
                        round(1000.0 * each / self._rated_nm) for each in readings[on, 2].tolist()
                    ]
                break
            if not math.isnan(held_nm[cycle]):
                self._axis.hold(float(held_nm[cycle]))
            self.follow(counts[cycle], counts[cycle + 1], count, float(outer_nm[cycle]))
            readings[cycle] = [getattr(self, name) for name in Cycles._fields]
        return Cycles(*readings.T)

    def coast(self, substeps: int, braked: bool, outer_nm: float = 0.0) -> None:
        """Runs a cycle with the power stage off; friction and, if ``braked``, the brake slow the motor."""
        brake_nm = self.truth.motor.brake_nm if braked else 0.0
        if self._response is not None:
            self._response.rest()
        self._take(self._axis.roll(brake_nm, substeps, self._limit_nm, self._chance_deg(), outer_nm))

    @property
    def torque_limit_permille(self) -> float:
        """Torque limit, in thousandths of the rated torque; the truth file's limit is the maximum."""
        return self._limit_permille

    @torque_limit_permille.setter
    def torque_limit_permille(self, permille: float) -> None:
        wanted_nm = max(0.0, permille) / 1000.0 * self._rated_nm
        self._limit_nm = min(wanted_nm, self._rated_limit_nm)
        self._limit_permille = 1000.0 * self._limit_nm / self._rated_nm

    def _responded(
        self, counts: Sequence[float], substeps: Sequence[int], first: int
    ) -> tuple[Sequence[float], list[float]]:
        """Returns the demand with the measured response, and its contribution to the torque of each cycle."""
        if self._response is None:
            return counts, []
        demand, torque_nm = list(counts), []
        demand[first] += self._response.demand_counts
        for cycle in range(first, len(substeps)):
            self._response.advance(counts[cycle], counts[cycle + 1], substeps[cycle] * self.dt_s)
            demand[cycle + 1] += self._response.demand_counts
            torque_nm.append(self._sense * self._response.torque_nm)
        return demand, torque_nm

    def _compile_after(self, substeps: int) -> None:
        """Switches to the compiled axis if that pays off after this number of substeps."""
        if self._to_compile is not None and fast.waiting.over(substeps):
            self._axis = fast.compiled_axis(self._to_compile)
            self._to_compile = None

    def _chance_deg(self) -> float:
        """Returns a sample of the load encoder's noise."""
        return self._noise.gauss(0.0, self._noise_deg) if self._noise_deg else 0.0

    def _take(self, measured: Measured) -> None:
        """Stores the axis's measurements after a cycle."""
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
        ) = measured
        if self._response is not None and self._response.torque_nm:
            self.torque_nm += self._sense * self._response.torque_nm
            self.torque_permille = round(1000.0 * self.torque_nm / self._rated_nm)
