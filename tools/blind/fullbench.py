"""A full bench on the simulated axis, without a bus: standstill, sweeps, sines, reversals, steps, holds.

Readings are taken 250 times a second and every fifth is kept, as a bench on a bus with a slower recorder
does. Means over the five would smooth the higher orders of the motor in fast sweeps.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

from support.hidden import Run

from hdbridge.sim.exercise import Exercise, Readings
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

CYCLE_S = 0.004
CYCLES_PER_SAMPLE = 5


@dataclass(frozen=True)
class Plan:
    """Motion of the bench, in degrees and turns of the motor."""

    fast_deg_s: float
    slow_deg_s: float
    acceleration_deg_s2: float
    sweep_turns: float
    slow_turns: float
    sines: tuple[float, ...]
    sine_periods: float
    depths_deg: tuple[float, ...]
    step_deg: float
    steps: int
    dwell_s: float
    still_s: float
    pose_deg: float
    holds_deg: tuple[float, ...]


def drawn_plan(rng: random.Random, ratio: float) -> Plan:
    """Draws a plan of 10 to 25 minutes. No speed is a whole number of counts per sample."""
    load_turns = 2.05 if ratio <= 60 else 1.1
    return Plan(
        fast_deg_s=360.0 * rng.uniform(0.9, 1.15),
        slow_deg_s=360.0 * rng.uniform(0.3, 0.45),
        # 16 degrees per second squared at the load: gentle, as in a calibration.
        acceleration_deg_s2=16.0 * ratio,
        sweep_turns=load_turns * ratio,
        slow_turns=rng.uniform(30.0, 40.0),
        sines=(180.0, 45.0, 5.0),
        sine_periods=2.0,
        depths_deg=tuple(
            sorted(rng.uniform(*span) for span in ((1, 2), (3, 5), (6, 10), (12, 18), (22, 34)))
        ),
        step_deg=rng.uniform(37.0, 49.0),
        steps=60,
        dwell_s=rng.uniform(0.4, 0.6),
        still_s=20.0,
        pose_deg=rng.uniform(100.0, 300.0),
        holds_deg=tuple(rng.uniform(200.0, 1500.0) for _ in range(4)),
    )


class Bench:
    """Runs a plan."""

    def __init__(self, truth: Truth, seed: int, plan: Plan) -> None:
        self._plan = plan
        self._exercise = Exercise(Machine(truth, seed, may_compile=True), CYCLE_S, CYCLES_PER_SAMPLE)

    def record(self) -> Readings:
        """Returns the whole record."""
        plan, exercise = self._plan, self._exercise
        self._to(-80.0)
        self._to(0.0)
        exercise.hold(plan.still_s)
        self._pose()
        self._sweep(plan.fast_deg_s, plan.sweep_turns)
        self._pose()
        self._sweep(plan.slow_deg_s, plan.slow_turns)
        self._pose()
        for amplitude in plan.sines:
            self._to(self._exercise.target_deg + 60.0)
            exercise.hold(1.0)
            exercise.sine(amplitude, 0.05, plan.sine_periods)
        self._pose()
        self._nested()
        self._pose()
        self._steps()
        self._pose()
        for each in plan.holds_deg:
            self._to(exercise.target_deg + each)
            exercise.hold(8.0)
        self._pose()
        self._sweep(plan.fast_deg_s, plan.sweep_turns)
        self._pose()
        exercise.hold(plan.still_s)
        return exercise.readings()

    def _to(self, goal_deg: float, speed_deg_s: float | None = None) -> None:
        plan, exercise = self._plan, self._exercise
        exercise.move(
            goal_deg - exercise.target_deg, speed_deg_s or plan.fast_deg_s, plan.acceleration_deg_s2
        )

    def _pose(self) -> None:
        """Moves to the recurring pose, from below and from above."""
        for side in (-70.0, 70.0):
            self._to(self._plan.pose_deg + side)
            self._to(self._plan.pose_deg)
            self._exercise.hold(2.0)

    def _sweep(self, speed_deg_s: float, turns: float) -> None:
        self._to(-70.0)
        self._to(360.0 * turns, speed_deg_s)
        self._exercise.hold(0.5)
        self._to(0.0, speed_deg_s)
        self._exercise.hold(0.5)

    def _nested(self) -> None:
        """Runs reversals of each depth, and nested staircases."""
        base = self._exercise.target_deg + 150.0
        slow = 6.0
        for depth in self._plan.depths_deg:
            self._to(base)
            for point in (-depth, -0.3 * depth, -0.8 * depth, -0.5 * depth, -1.4 * depth, 0.0):
                self._to(base + point, slow)
            self._exercise.hold(0.3)

    def _steps(self) -> None:
        plan = self._plan
        for direction in (1.0, -1.0):
            for _ in range(plan.steps + 1):
                self._to(self._exercise.target_deg + direction * plan.step_deg)
                self._exercise.hold(plan.dwell_s)


def run_of(plan: Plan, truth: Truth) -> Run:
    """Returns the properties of a plan that determine the sizes of causes."""
    ratio = truth.gear.ratio
    sweep_s = 2.0 * 360.0 * plan.sweep_turns / plan.fast_deg_s
    slow_s = 2.0 * 360.0 * plan.slow_turns / plan.slow_deg_s
    steps_s = (
        2.0 * plan.steps * (plan.dwell_s + 2.0 * (plan.step_deg / plan.acceleration_deg_s2 * 1.6) ** 0.5)
    )
    duration_s = 2.0 * sweep_s + slow_s + steps_s + 60.0 * plan.sine_periods + 220.0
    turns = 4.0 * plan.sweep_turns + 2.0 * plan.slow_turns + 2.0 * plan.steps * plan.step_deg / 360.0 + 60.0
    return Run(
        duration_s=duration_s,
        load_speed_deg_s=plan.fast_deg_s / ratio,
        load_acceleration_deg_s2=plan.acceleration_deg_s2 / ratio,
        motor_turns=turns,
        load_reach_deg=(0.0, 360.0 * plan.sweep_turns / ratio),
    )
