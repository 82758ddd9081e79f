"""Causes hidden in the simulated axis have the size that their description states."""

import random
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from support.bare_axis import truth as truth_of
from support.hidden import CAUSES, UNKNOWN, Run, hide
from support.keys import changed

from hdbridge.sim.exercise import Exercise
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

SPEED_DEG_S = 14.0
RUN = Run(
    duration_s=31.0,
    load_speed_deg_s=SPEED_DEG_S,
    load_acceleration_deg_s2=40.0,
    motor_turns=57.0,
    load_reach_deg=(0.0, 370.0),
)


def axis() -> Truth:
    """The article's axis with finer encoders and a stiffer spring, at the coarsest time step."""
    return truth_of(
        substep_ms=1.0, motor__encoder__counts_per_turn=512_000, motor__encoder__interpolation=1,
        load__encoder__counts_per_turn=28_800_000, gear__stiffness_nm_per_rad=32_000.0,
        gear__damping_nm_s_per_rad=34.0,
    )  # fmt: skip


class Errors:
    """Errors at the load, by the encoders, in the parts of one short run."""

    def __init__(self, truth: Truth) -> None:
        exercise = Exercise(Machine(truth, 1, may_compile=True))
        marks: dict[str, tuple[int, int]] = {}

        def part(name: str, do: Callable[[], None]) -> None:
            before = exercise.samples
            do()
            marks[name] = (before, exercise.samples)

        fast = (SPEED_DEG_S * 50.0, 40.0 * 50.0)
        exercise.move(60.0, *fast)
        exercise.move(-60.0, *fast)
        exercise.hold(0.3)
        part("forth", lambda: exercise.move(370.0 * 50.0, *fast))
        exercise.hold(0.3)
        part("back", lambda: exercise.move(-600.0, *fast))
        part("end", lambda: exercise.hold(0.5))

        def nested() -> None:
            for distance in (60.0, -10.0, 2.0, -4.0, -6.0, 8.0, -10.0):
                exercise.move(distance, 100.0, 500.0)

        part("nested", nested)
        self._marks = marks
        readings = exercise.readings()
        self._arcsec = (readings.load_deg - readings.motor_deg / 50.0) * 3600.0
        self._load_deg = readings.load_deg

    def part(self, name: str) -> NDArray[np.float64]:
        first, last = self._marks[name]
        return self._arcsec[first:last]

    def even(self) -> NDArray[np.float64]:
        """Returns the errors of the forward move at constant speed."""
        first, last = self._marks["forth"]
        ramp = round(0.3 * (last - first) / 13.0)  # the ramps take 0.55 s of 27 s each
        return self._arcsec[first + 2 * ramp : last - 2 * ramp]


@cache
def bare() -> Errors:
    return Errors(axis())


def peak(there: Errors, here: Errors) -> float:
    """Returns the amplitude of a wave about zero at constant speed."""
    change = there.even() - here.even()
    return float(np.quantile(np.abs(change - np.mean(change)), 0.995))


def moving(there: Errors, here: Errors) -> float:
    """Returns the size of a shift that lasts as long as the axis moves."""
    return float(np.median(np.abs((there.even() - here.even())[-500:])))


def change(there: Errors, here: Errors) -> float:
    """Returns the change at rest from the start to the end."""
    apart = there.part("end") - here.part("end")
    return float(abs(np.median(apart[-50:]) - np.median((there.even() - here.even())[:50])))


def at_a_turn(there: Errors, here: Errors) -> float:
    """Returns the change after one turn of the load, relative to the start."""
    apart = there.even() - here.even()
    return float(abs(np.median(apart[-200:]) - np.median(apart[:200])))


def highest(there: Errors, here: Errors) -> float:
    """Returns the maximum at constant speed."""
    return float(np.max(np.abs(there.even() - here.even())))


def ramping(there: Errors, here: Errors) -> float:
    """Returns the maximum in the ramps."""
    return float(np.max(np.abs(there.part("forth") - here.part("forth"))))


def returning(there: Errors, here: Errors) -> float:
    """Returns the maximum in nested loops."""
    return float(np.max(np.abs(there.part("nested") - here.part("nested"))))


def looping(there: Errors, here: Errors) -> float:
    """Returns the maximum in a crossing, back or in nested loops."""
    back = float(np.max(np.abs(there.part("back") - here.part("back"))))
    return max(back, returning(there, here))


Measure = Callable[[Errors, Errors], float]
# Measure, and its smallest and largest result as shares of the stated size. Second orders add to first ones;
# orders of the motor are a tenth higher near the load's resonance.
EXPECTED: dict[str, tuple[Measure, float, float]] = {
    "motor_order": (peak, 0.95, 1.3),
    "motor_encoder_eccentricity": (peak, 0.95, 1.35),
    "load_order": (peak, 0.9, 1.45),
    "flexspline_order": (peak, 0.95, 1.1),
    "direction_phase": (highest, 0.9, 1.1),
    "torque_modulation": (highest, 0.7, 1.15),
    "compliance": (peak, 0.9, 1.1),
    "inertial_windup": (ramping, 0.85, 1.25),
    "velocity_windup": (moving, 0.93, 1.07),
    "channel_skew": (moving, 0.95, 1.05),
    "backlash": (moving, 0.95, 1.05),
    "hysteresis_memory": (returning, 0.5, 1.1),
    "hysteresis_parameters": (looping, 0.9, 1.2),
    "rate_dependence": (moving, 0.93, 1.07),
    "subdivisional_error": (highest, 0.95, 1.15),
    "zero_drift": (change, 0.75, 1.25),
    "amplitude_drift": (highest, 0.6, 1.2),
    "wear": (change, 0.85, 1.1),
    "creep": (moving, 0.9, 1.05),
    "ratio_error": (at_a_turn, 0.9, 1.1),
    "count_loss": (change, 0.97, 1.03),
    "vibration": (peak, 0.85, 1.2),
    "local_defect": (highest, 0.95, 1.1),
    "unexplained:roller": (highest, 0.9, 1.1),
    "unexplained:seat": (highest, 0.6, 1.05),
    "unexplained:cable": (highest, 0.9, 1.1),
    "unexplained:sensor_warming": (moving, 0.9, 1.05),
}


def size_of(cause: str, rng: random.Random) -> float:
    return rng.uniform(0.5, 1.5) if cause == "subdivisional_error" else rng.uniform(3.0, 9.0)


def test_every_cause_can_be_hidden_and_has_a_size_to_check() -> None:
    assert set(EXPECTED) == {*CAUSES, *UNKNOWN}
    assert len(CAUSES) == 23


@pytest.mark.parametrize("cause", EXPECTED)
def test_a_hidden_cause_has_its_stated_size(cause: str) -> None:
    rng = random.Random(f"size of {cause}")
    wanted = size_of(cause, rng)
    known, hidden = hide(axis(), cause, rng, wanted, RUN)
    assert hidden.cause == cause.split(":", maxsplit=1)[0]
    assert hidden.size_arcsec == pytest.approx(wanted, rel=0.05)
    here = bare()
    if hidden.brings:  # side effects are not to be measured
        here = Errors(changed(known, gear__torque_growth_per_nm=0.0))
    measure, least, most = EXPECTED[cause]
    measured = measure(Errors(known), here)
    assert least * hidden.size_arcsec < measured < most * hidden.size_arcsec, hidden.text
