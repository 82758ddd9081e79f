"""The causes in the simulated axis, each by its physics; the sizes are tested in test_hidden."""

import math
from typing import Any

import numpy as np
import pytest
from support.bare_axis import truth as truth_of
from support.hidden.elastic import remembering

from hdbridge.sim.encoder import Late, Signals
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.hysteresis_laws import law_of
from hdbridge.sim.loaded_plant import LoadedPlant, Spring
from hdbridge.sim.machine import Machine
from hdbridge.sim.plant import Plant
from hdbridge.sim.truth import Dahl, RollingFriction, Truth
from hdbridge.sim.truth.encoder import TrueSignals
from hdbridge.sim.truth.gear import TrueStiffening

ARCSEC_PER_RAD = math.degrees(1.0) * 3600.0


def axis(**changes: Any) -> Truth:
    """Returns the article's axis with a perfect gear and fine encoders; ``load__gravity`` sets its key."""
    plain = {
        "gear__motor_orders": [], "gear__hysteresis": None, "load__encoder__coupling": None,
        "motor__encoder__counts_per_turn": 512_000, "motor__encoder__interpolation": 1,
        "load__encoder__counts_per_turn": 28_800_000,
    }  # fmt: skip
    return truth_of(**(plain | changes))


def mass(torque_nm: float = 20.0, down_deg: float = 0.0) -> dict[str, float]:
    return {"mass_kg": torque_nm / 9.80665 / 0.1, "arm_m": 0.1, "down_deg": down_deg}


STAGES = {
    "first_torque_nm": 4.0,
    "second_stiffness_nm_per_rad": 20_000.0,
    "second_torque_nm": 9.0,
    "third_stiffness_nm_per_rad": 28_000.0,
}


def moved(truth: Truth, *distances_deg: float, speed_deg_s: float = 700.0) -> tuple[Machine, Exercise]:
    machine = Machine(truth, 1)
    exercise = Exercise(machine)
    for distance in distances_deg:
        exercise.move(distance, speed_deg_s, 3000.0)
        exercise.hold(0.5)
    return machine, exercise


def error_arcsec(machine: Machine, ratio: float = 50.0) -> float:
    return (machine.true_load_deg - machine.true_motor_deg / ratio) * 3600.0


# Spring, load, friction


def test_the_stages_of_the_spring_join() -> None:
    spring = Spring(16_000.0, TrueStiffening(**STAGES), 0.0)
    steps = np.linspace(-0.1, 0.1, 20_001)
    torques = np.array([spring.pull_nm(each) for each in steps])
    slopes = np.diff(torques) / np.diff(steps)
    assert np.all(slopes > 0.0)
    assert np.max(np.abs(np.diff(torques))) < 1.01 * 1e-5 * np.max(slopes)
    assert np.allclose(torques, -torques[::-1])


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_load_friction_yields_before_it_slips(sense: float) -> None:
    """The load lags by the wind-up of the friction, and after a reversal it follows less than the motor."""
    sliders = [{"limit_nm": 1.0, "travel_deg": 0.02}, {"limit_nm": 2.0, "travel_deg": 0.1}]
    machine, exercise = moved(axis(load__presliding=sliders), sense * 100.0, speed_deg_s=60.0)
    held_arcsec = 3.0 / 16_000 * ARCSEC_PER_RAD
    assert error_arcsec(machine) == pytest.approx(-sense * held_arcsec, rel=0.01)
    errors, loads = [error_arcsec(machine)], [machine.true_load_deg]
    for _ in range(40):
        exercise.move(-sense * 0.5, 20.0, 400.0)
        exercise.hold(0.3)
        errors.append(error_arcsec(machine))
        loads.append(machine.true_load_deg)
    rise = sense * np.diff(errors)
    assert np.all(sense * np.diff(loads) < 0.0)  # the load moves in the motor's direction, never in the other
    assert rise[0] > 1.5 * rise[8] > 1.5 * abs(rise[-1])
    assert errors[-1] == pytest.approx(sense * held_arcsec, rel=0.01)


def test_a_load_that_swings_on_its_spring_keeps_its_energy() -> None:
    truth = axis(
        load__gravity=mass(20.0, 0.3),
        gear__stiffening=STAGES,
        gear__damping_nm_s_per_rad=0.0,
        motor__coulomb_nm=0.03,
        substep_ms=0.25,
    )
    plant = LoadedPlant(truth)
    plant.load_deg_s = 30.0
    inertia = truth.load_.whole_inertia_kg_m2
    spring = Spring(16_000.0 * math.pi / 180.0, truth.gear.stiffening, 0.0)

    def energy_j() -> float:
        wind_up = plant.output_deg - plant.now.load_deg
        grid = np.linspace(0.0, abs(wind_up), 400)
        stored = float(np.trapezoid([spring.pull_nm(each) for each in grid], grid)) * math.pi / 180.0
        height = 20.0 * (1.0 - math.cos(math.radians(plant.now.load_deg - 0.3)))
        return 0.5 * inertia * math.radians(plant.load_deg_s) ** 2 + stored + height

    before = energy_j()
    energies = []
    for _ in range(4000):
        plant.step(0.0, 1000.0)  # the motor is held by its brake
        energies.append(energy_j())
    assert 0.97 * before < min(energies)
    assert max(energies) < 1.03 * before


def test_drag_only_takes_energy_away() -> None:
    truth = axis(
        load__viscous_nm_s_per_rad=1.0,
        load__coulomb_nm=0.05,
        load__stribeck={"breakaway_nm": 0.2, "speed_rad_s": 0.05},
        load__thinning={"speed_rad_s": 0.1, "exponent": 0.5},
        gear__damping_nm_s_per_rad=0.0,
    )
    plant = LoadedPlant(truth)
    plant.load_deg_s = 20.0
    peaks = []
    for _ in range(20):
        swing = 0.0
        for _ in range(100):
            plant.step(0.0, 1000.0)
            swing = max(swing, abs(plant.output_deg - plant.now.load_deg))
        peaks.append(swing)
    assert peaks == sorted(peaks, reverse=True)
    assert peaks[-1] < 0.1 * peaks[0]


def test_friction_at_rest_holds_more_than_in_motion() -> None:
    held = {}
    for breakaway_nm in (0.5, 2.0):
        stribeck = {"breakaway_nm": breakaway_nm, "speed_rad_s": 0.02}
        machine, _ = moved(axis(load__coulomb_nm=0.5, load__stribeck=stribeck), 300.0, 0.5)
        held[breakaway_nm] = abs(error_arcsec(machine))
    assert held[0.5] < held[2.0]


def test_play_behind_the_spring_is_crossed_on_a_reversal_unless_gravity_keeps_it_closed() -> None:
    errors = {}
    for preload in (False, True):
        truth = axis(
            gear__backlash_arcsec=20.0,
            load__coulomb_nm=0.3,
            **({"load__gravity": mass(40.0, 90.0)} if preload else {}),
        )
        machine, exercise = moved(truth, 60.0, speed_deg_s=200.0)
        forth = error_arcsec(machine)
        exercise.move(-60.0, 200.0, 300.0)
        exercise.hold(0.5)
        errors[preload] = forth - error_arcsec(machine)
    friction_arcsec = 2.0 * 0.3 / 16_000 * ARCSEC_PER_RAD
    assert -errors[False] == pytest.approx(20.0 + friction_arcsec, abs=8.0)
    assert abs(errors[True]) < friction_arcsec + 1.0


def test_play_in_the_encoder_s_coupling_leaves_the_load_alone() -> None:
    coupling = {"frequency_hz": 200.0, "damping_ratio": 0.2, "play_arcsec": 12.0}
    machine, exercise = moved(axis(load__encoder__coupling=coupling), 60.0)
    forth = machine.load_counts * 0.045 - machine.true_load_deg * 3600.0
    exercise.move(-30.0, 200.0, 300.0)
    exercise.hold(0.5)
    back = machine.load_counts * 0.045 - machine.true_load_deg * 3600.0
    assert (forth, back) == (pytest.approx(-6.0, abs=0.4), pytest.approx(6.0, abs=0.4))


def test_an_axis_with_nothing_on_its_load_moves_alike_in_both_plants() -> None:
    truth = truth_of()
    plants = (Plant(truth), LoadedPlant(truth))
    for step in range(3000):
        for plant in plants:
            plant.step(0.08 * math.sin(step * 0.01), 0.0)
    assert plants[0].now.motor_deg == pytest.approx(plants[1].now.motor_deg, rel=1e-9)
    assert plants[0].encoder_deg == pytest.approx(plants[1].encoder_deg, rel=1e-9)
    assert not LoadedPlant.needed(truth)


# Encoders


def test_signals_err_once_twice_and_four_times_per_line() -> None:
    for key, order, size in (
        ("sine_offset", 1, 0.02),
        ("gain_mismatch", 2, 0.01),
        ("third_harmonic", 4, 0.02),
    ):
        signals = Signals(TrueSignals(lines_per_turn=1000, **{key: 0.02}))
        angles = np.arange(256) / 256.0 * 0.36
        spectrum = np.abs(np.fft.rfft([signals.error_deg(each) for each in angles])) / 128.0
        assert int(np.argmax(spectrum[1:])) + 1 == order
        assert spectrum[order] == pytest.approx(math.degrees(size) / 1000.0, rel=0.05)


@pytest.mark.parametrize("late_s", [0.0002, 0.0005, 0.0013, 0.02])
def test_a_late_sample_is_the_angle_of_that_time(late_s: float) -> None:
    late = Late(late_s, 0.0005, 0.0)
    for step in range(1, 101):
        late.feed(7.0 * step * 0.0005)
    assert late.deg == pytest.approx(7.0 * (100 * 0.0005 - late_s))


def test_a_late_motor_sample_affects_the_bus_but_not_the_loops() -> None:
    machines = [Machine(axis(motor__encoder__late_ms=late_ms), 1) for late_ms in (0.0, 3.0)]
    for machine in machines:
        Exercise(machine).lead(lambda seconds: 400.0 * seconds, 0.5)
    assert machines[0].true_motor_deg == machines[1].true_motor_deg
    behind = (machines[0].motor_counts - machines[1].motor_counts) / 512_000 * 360.0
    assert behind == pytest.approx(400.0 * 0.003, rel=0.02)


def test_counts_lost_on_the_motor_move_the_load() -> None:
    machine, exercise = moved(axis(motor__encoder__losses=[{"time_s": 2.0, "counts": 500}]), 60.0)
    before = machine.motor_counts, machine.true_load_deg
    exercise.hold(3.0)
    assert machine.motor_counts == pytest.approx(before[0], abs=20)
    assert machine.true_load_deg - before[1] == pytest.approx(-500 / 512_000 * 360.0 / 50.0, rel=0.02)


# Gear


def test_a_jumped_tooth_is_a_tooth() -> None:
    machine, exercise = moved(axis(gear__jumps=[{"time_s": 2.0, "teeth": 1}]), 60.0)
    before_deg = machine.true_load_deg
    exercise.hold(4.0)
    assert machine.true_load_deg - before_deg == pytest.approx(3.6, abs=1e-3)
    assert machine.true_motor_deg == pytest.approx(60.0, abs=0.01)


def test_the_gear_yields_in_time_to_a_load() -> None:
    elements = [{"time_constant_s": 1.0, "arcsec_per_nm": 2.0}]
    machine, exercise = moved(axis(load__gravity=mass(5.0, 90.0), gear__creep=elements), 1.0)
    exercise.hold(8.0)
    expected = 5.0 * (2.0 + ARCSEC_PER_RAD / 16_000)
    assert error_arcsec(machine) == pytest.approx(expected, rel=0.02)


def test_hours_of_work_change_loop_and_tooth_error_up_to_a_limit() -> None:
    loop = {"law": "rolling_friction", "offset_arcsec": 40.0, "width_deg": 20.0, "exponent": 1.6}
    ageing = {
        "duration_s": 20.0,
        "hysteresis_growth": 0.5,
        "motor_orders": [{"order": 1, "amplitude_arcsec": 10.0, "phase_deg": 90.0}],
    }
    # At the final angle of 90 deg, the motor order is -10 arcsec.
    machine, exercise = moved(axis(gear__hysteresis=loop, gear__ageing=ageing), 330.0, 120.0)
    begun_s = float(exercise.readings().time_s[-1])
    assert error_arcsec(machine) == pytest.approx(40.0 + (20.0 - 10.0) * begun_s / 20.0, abs=0.2)
    exercise.hold(30.0)
    assert error_arcsec(machine) == pytest.approx(50.0, abs=0.2)
    exercise.move(-90.0, 700.0, 3000.0)
    exercise.hold(0.5)
    assert error_arcsec(machine) == pytest.approx(-60.0, abs=0.2)


def test_warmth_changes_tooth_error_friction_and_the_zero() -> None:
    order = [{"order": 2, "amplitude_arcsec": 10.0, "phase_deg": 0.0}]
    torques, errors = [], []
    for start_c in (22.0, 32.0):
        heat = {
            "ambient_c": start_c,
            "reference_c": 22.0,
            "tooth_growth_per_k": 0.02,
            "friction_growth_per_k": -0.01,
        }
        machine, exercise = moved(axis(gear__motor_orders=order, temperature=heat), 180.0)
        errors.append(error_arcsec(machine))
        exercise.lead(lambda seconds: 300.0 * seconds, 0.8)
        torques.append(float(np.mean(exercise.readings().motor_torque_nm[-100:])))
    assert errors[0] == pytest.approx(10.0, abs=0.1)
    assert errors[1] == pytest.approx(12.0, abs=0.1)
    assert torques[1] == pytest.approx(0.9 * torques[0], rel=0.01)


def test_the_surroundings_warm_the_axis_and_the_housing_follows_late() -> None:
    heat = {
        "time_constant_s": 0.5,
        "ambient_c": 20.0,
        "ambient_k_per_hour": 3600.0,
        "zero_drift_arcsec_per_k": 2.0,
        "zero_time_constant_s": 1.0,
    }
    machine = Machine(axis(temperature=heat), 1)
    for _ in range(2500):
        machine.coast(8, braked=True)
    assert machine.temperature_c == pytest.approx(20.0 + 10.0 - 0.5, abs=0.02)
    assert error_arcsec(machine) == pytest.approx(2.0 * (10.0 - 0.5 - 1.0), abs=0.1)


@pytest.mark.parametrize("exponent", [0.5, 0.8, 1.0, 1.7])
def test_dahl_s_law_is_its_differential_equation(exponent: float) -> None:
    law = law_of(Dahl(law="dahl", offset_arcsec=40.0, yield_deg=3.0, exponent=exponent), 0.0)
    assert law is not None
    z, at_deg = 0.0, 0.0
    for goal in (5.0, 3.0, 4.0, -8.0):
        steps = 4000
        step = (goal - at_deg) / steps
        direction = math.copysign(1.0, step)
        for _ in range(steps):
            at_deg += step
            slope = max(0.0, 1.0 - z * direction) ** exponent / 3.0
            middle = z + 0.5 * step * slope
            z += step * max(0.0, 1.0 - middle * direction) ** exponent / 3.0
        assert law.advance(goal) == pytest.approx(40.0 * z, abs=0.02)
        at_deg = goal


@pytest.mark.parametrize("exponent", [1.3, 1.6, 2.0, 2.6])
def test_the_first_branch_is_the_same_with_memory(exponent: float) -> None:
    truth = RollingFriction(law="rolling_friction", offset_arcsec=40.0, width_deg=20.0, exponent=exponent)
    laws = [law_of(each, 0.0) for each in (truth, remembering(truth))]
    worst = 0.0
    for at_deg in [100.0, *np.linspace(99.9, 75.0, 250)]:
        errors = [law.advance(float(at_deg)) for law in laws if law is not None]
        worst = max(worst, abs(errors[0] - errors[1]))
    assert worst < 0.6
    assert errors == pytest.approx([-40.0, -40.0])


# Exercise


def test_moves_end_where_they_should_and_keep_their_limits() -> None:
    machine = Machine(axis(), 1)
    exercise = Exercise(machine)
    for distance, speed, acceleration in ((500.0, 300.0, 900.0), (-3.0, 300.0, 900.0), (0.01, 5.0, 100.0)):
        before = exercise.target_deg
        first = exercise.samples
        exercise.move(distance, speed, acceleration)
        targets = np.concatenate([[before], exercise.readings().target_deg[first:]])
        assert targets[-1] == pytest.approx(before + distance, abs=1e-9)
        rates = np.diff(targets) / 0.004
        assert np.max(np.abs(rates)) <= speed * 1.001
        assert np.max(np.abs(np.diff(rates[:-1]))) / 0.004 <= acceleration * 1.01
    with pytest.raises(ValueError, match=r"cycle_s: found 0\.0013"):
        Exercise(machine, cycle_s=0.0013)


def test_a_sine_swings_from_rest_to_the_far_side_and_back() -> None:
    exercise = Exercise(Machine(axis(), 1))
    exercise.sine(45.0, 0.5, 1.0)
    targets = exercise.readings().target_deg
    assert targets[0] == pytest.approx(0.0, abs=0.01)
    assert np.max(targets) == pytest.approx(90.0)
    assert targets[-1] == pytest.approx(0.0, abs=1e-9)
