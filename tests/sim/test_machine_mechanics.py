"""The mechanics of the simulated axis alone: spring, inertias, friction, coupling."""

import math
from typing import Any

import pytest
from support.bare_axis import truth as truth_of

from hdbridge.sim.loaded_plant import LoadedPlant
from hdbridge.sim.oscillator import exact_step
from hdbridge.sim.plant import Plant
from hdbridge.sim.truth import Truth


def plain(**changes: Any) -> Truth:
    """The article's axis with a perfect gear, keys like ``motor__coulomb_nm`` changed."""
    return truth_of(**{"gear__motor_orders": [], "gear__hysteresis": None, **changes})


def energy_j(plant: Plant, truth: Truth) -> float:
    motor, load = math.radians(plant.motor_deg_s), math.radians(plant.load_deg_s)
    wind_up = math.radians(plant.output_deg - plant.now.load_deg)
    kinetic = truth.motor.inertia_kg_m2 * motor**2 + truth.load_.inertia_kg_m2 * load**2
    return 0.5 * (kinetic + truth.gear.stiffness_nm_per_rad * wind_up**2)


def test_a_coasting_axis_only_loses_energy() -> None:
    truth = plain()
    plant = Plant(truth)
    plant.motor_deg_s = 1000.0
    energy = energy_j(plant, truth)
    while energy > 1e-12:
        plant.step(0.0, 0.0)
        after = energy_j(plant, truth)
        assert after <= energy * (1.0 + 1e-9) or after < 1e-7
        energy = after
        assert plant.now.motor_deg < 400.0
    assert plant.motor_deg_s == 0.0


@pytest.mark.parametrize("substep_ms", [0.1, 0.5, 1.0])
def test_without_losses_energy_and_momentum_stay(substep_ms: float) -> None:
    truth = plain(motor__coulomb_nm=0.0, motor__viscous_nm_s_per_rad=0.0, gear__damping_nm_s_per_rad=0.0)
    truth = truth.model_copy(update={"substep_ms": substep_ms})
    plant = Plant(truth)
    plant.motor_deg_s = 500.0
    energy = energy_j(plant, truth)
    energies = []
    for _ in range(round(500.0 / substep_ms)):
        plant.step(0.0, 0.0)
        energies.append(energy_j(plant, truth))
    # Stepping motor and load alternately adds a little energy to the resonance, at most a few per cent in
    # half a second. The gear's real damping would remove nearly all energy in a twentieth of a second.
    assert max(energies) < energy * (1.0 + 0.3 * substep_ms**2)
    momentum = (
        truth.motor.inertia_kg_m2 * plant.motor_deg_s + truth.load_.inertia_kg_m2 / 50 * plant.load_deg_s
    )
    assert momentum == pytest.approx(truth.motor.inertia_kg_m2 * 500.0, rel=0.2 * substep_ms)


TOOTH = {"gear__motor_orders": [{"order": 4, "amplitude_arcsec": 60.0, "phase_deg": 10.0}]}
LOOP = {"law": "dahl", "offset_arcsec": 60.0, "yield_deg": 5.0}


@pytest.mark.parametrize("gear", [TOOTH, {"gear__hysteresis": LOOP, "gear__hysteresis_reaction": 1.0}])
def test_a_displacement_of_the_output_takes_no_energy_and_gives_none(gear: dict[str, Any]) -> None:
    truth = plain(
        motor__coulomb_nm=0.0, motor__viscous_nm_s_per_rad=0.0, gear__damping_nm_s_per_rad=0.0, **gear
    )
    plant = Plant(truth)
    plant.motor_deg_s, plant.load_deg_s = 1000.0, 20.0
    energy = energy_j(plant, truth)
    for _ in range(4000):
        plant.step(0.0, 0.0)
        # By the nominal ratio it would lose and gain 4 %.
        assert energy_j(plant, truth) == pytest.approx(energy, rel=0.003)


@pytest.mark.parametrize("growth_per_nm", [0.0, 0.02])
def test_at_rest_a_torque_on_the_load_reaches_the_motor_by_the_momentary_ratio(growth_per_nm: float) -> None:
    """The least friction that holds a mass follows from virtual work; growth with torque counts half."""
    torque_nm, slope = 5.0 * 9.80665 * 0.2, math.radians(600.0 / 3600.0)
    gear = {
        "gear__motor_orders": [{"order": 1, "amplitude_arcsec": 600.0, "phase_deg": -90.0}],
        "gear__torque_growth_per_nm": growth_per_nm,
        "load__gravity": {"mass_kg": 5.0, "arm_m": 0.2, "down_deg": -90.0},
    }
    least_nm = torque_nm * (1.0 / 50.0 + slope * (1.0 + 0.5 * growth_per_nm * torque_nm))
    for friction_nm, holds in ((1.004 * least_nm, True), (0.996 * least_nm, False)):
        plant = LoadedPlant(plain(motor__coulomb_nm=friction_nm, **gear))
        for _ in range(2000):
            plant.step(0.0, 0.0)
        assert (plant.now.motor_deg == 0.0) == holds


def test_friction_alone_brakes_as_newton_says() -> None:
    truth = plain(motor__viscous_nm_s_per_rad=0.0)
    plant = Plant(truth)
    plant.motor_deg_s, plant.load_deg_s = 1000.0, 20.0
    inertia = truth.motor.inertia_kg_m2 + truth.load_.inertia_kg_m2 / 50.0**2
    for _ in range(2000):
        plant.step(0.0, 0.0)
    expected_rad = inertia * math.radians(1000.0) ** 2 / 2.0 / truth.motor.coulomb_nm
    assert plant.now.motor_deg == pytest.approx(math.degrees(expected_rad), rel=0.02)


def test_the_load_rings_at_its_frequency_and_fades_as_damped() -> None:
    truth = plain()
    plant = Plant(truth)
    plant.load_deg_s = 1e-3
    peaks, last, rising = [], 0.0, True
    for step in range(300):
        plant.step(0.0, 100.0)
        here = plant.now.load_deg
        if rising and here < last:
            peaks.append((step * truth.substep_s, last))
        rising, last = here > last, here
    damped_hz = truth.load_frequency_hz * math.sqrt(1.0 - 0.2**2)
    assert peaks[1][0] - peaks[0][0] == pytest.approx(1.0 / damped_hz, abs=0.6e-3)
    fade = math.log(peaks[0][1] / peaks[1][1])
    assert fade == pytest.approx(math.tau * 0.2 / math.sqrt(1 - 0.2**2), rel=0.05)


def test_a_torque_within_the_friction_moves_nothing_and_one_beyond_it_does() -> None:
    plant = Plant(plain())
    for _ in range(1000):
        plant.step(0.0299, 0.0)
    assert plant.now.motor_deg == 0.0
    for _ in range(10):
        plant.step(0.0301, 0.0)
    assert plant.now.motor_deg > 0.0


def test_stribeck_friction_sticks_and_falls_with_speed() -> None:
    truth = plain(motor__stribeck={"rise": 0.5, "speed_rad_s": 3.0}, motor__viscous_nm_s_per_rad=0.0)
    plant = Plant(truth)
    for _ in range(1000):
        plant.step(0.0449, 0.0)
    assert plant.now.motor_deg == 0.0
    plant.step(0.0451, 0.0)
    assert plant.motor_deg_s > 0.0
    for speed_rad_s in (-6.0, 1.0, 3.0):
        plant = Plant(truth)
        plant.motor_deg_s, plant.load_deg_s = math.degrees(speed_rad_s), math.degrees(speed_rad_s) / 50.0
        held_nm = 0.03 + 0.015 * math.exp(-((speed_rad_s / 3.0) ** 2))
        for _ in range(20):
            plant.step(math.copysign(held_nm, speed_rad_s), 0.0)
        assert math.radians(plant.motor_deg_s) == pytest.approx(speed_rad_s, rel=1e-3)


def test_friction_at_the_load_leaves_wind_up_at_rest() -> None:
    for coulomb_nm in (0.0, 2.0):
        plant = Plant(plain(load__coulomb_nm=coulomb_nm))
        for torque in [0.04] * 400 + [0.0] * 2000:
            plant.step(torque, 0.0)
        wind_up_nm = abs(plant.now.torque_nm)
        assert plant.load_deg_s == pytest.approx(0.0, abs=1e-9)
        if coulomb_nm:
            assert 0.0 < wind_up_nm <= coulomb_nm * 1.001
        else:
            assert wind_up_nm < 1e-9


def test_the_load_encoder_comes_to_the_load_through_its_coupling() -> None:
    plant = Plant(plain())
    apart = 0.0
    for torque in [0.06] * 200 + [-0.06] * 100:
        plant.step(torque, 0.0)
        apart = max(apart, abs(plant.encoder_deg - plant.now.load_deg))
    for _ in range(400):
        plant.step(0.0, 1.0)
    assert apart * 3600.0 > 0.1
    assert plant.encoder_deg == pytest.approx(plant.now.load_deg, abs=1e-6)


@pytest.mark.parametrize("damping_ratio", [0.0, 0.2, 0.999, 1.0, 1.001, 1.7])
def test_two_exact_half_steps_are_one_step(damping_ratio: float) -> None:
    whole = exact_step(300.0, damping_ratio, 1e-3)
    a, b, c, d = exact_step(300.0, damping_ratio, 0.5e-3)
    twice = (a * a + b * c, a * b + b * d, c * a + d * c, c * b + d * d)
    assert twice == pytest.approx(whole, rel=1e-9, abs=1e-12)
    determinant = whole[0] * whole[3] - whole[1] * whole[2]
    assert determinant == pytest.approx(math.exp(-2.0 * damping_ratio * 300.0 * 1e-3))


@pytest.mark.parametrize("damping_ratio", [1.5, 40.0, 1e4, 1e8])
def test_a_very_large_damping_leaves_a_slow_return(damping_ratio: float) -> None:
    """From rest at a distance; its rate is stiffness over damping."""
    root = math.sqrt(damping_ratio**2 - 1.0)
    slow_per_s = 300.0 / (damping_ratio + root)
    a, b, c, d = exact_step(300.0, damping_ratio, 1e-3)
    distance, rate = 1.0, 0.0
    for _ in range(1000):
        distance, rate = a * distance + b * rate, c * distance + d * rate
    assert distance == pytest.approx((0.5 + 0.5 * damping_ratio / root) * math.exp(-slow_per_s), rel=1e-6)
