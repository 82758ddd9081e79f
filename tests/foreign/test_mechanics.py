"""The foreign mechanics obey their equations: statics, energy, frequencies, friction."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from foreign.draw import candidates
from foreign.mechanics import (
    ARCSEC,
    DT_S,
    BoucWen,
    MaxwellSlip,
    energy_j,
    hysteresis,
    plant_of,
    static_error_arcsec,
    substep,
)
from foreign.servos import STRUCTURES
from hypothesis import given
from hypothesis import strategies as st

AXES = [next(candidates(0, structure)) for structure in STRUCTURES]
LAWS = [
    BoucWen(30.0, 6.0, 1.0, 0.5),
    BoucWen(-20.0, 9.0, 1.7, 0.7),
    MaxwellSlip(((10.0, 2.0), (15.0, 8.0), (5.0, 20.0))),
]


def lossless(mechanics):
    return replace(
        mechanics,
        coulomb_nm=0.0,
        viscous_nm_s_per_rad=0.0,
        damping_nm_s_per_rad=0.0,
        load_viscous_nm_s_per_rad=0.0,
    )


def advance(plant, seconds, torque_nm=0.0, brake_nm=0.0, every=1):
    """Advances a plant; returns rows of motor angle, motor speed, load angle, load speed and energy."""
    rows = []
    for at in range(round(seconds / DT_S)):
        substep(plant.parameters, plant.orders, plant.elements, plant.state, torque_nm, brake_nm)
        if at % every == 0:
            s = plant.state[0]
            rows.append([s["motor"], s["motor_speed"], s["load"], s["load_speed"], energy_j(plant)])
    return np.array(rows)


def frequency_and_damping(signal: np.ndarray, step_s: float) -> tuple[float, float]:
    """Returns frequency (Hz) and damping ratio of a ring-down about zero, from its zero crossings and
    peaks.
    """
    at = np.flatnonzero(np.diff(np.sign(signal)))
    crossings = at + signal[at] / (signal[at] - signal[at + 1])
    peaks = [np.abs(signal[a : b + 1]).max() for a, b in pairwise(at)]
    decay = -np.polyfit(np.arange(len(peaks)), np.log(peaks), 1)[0] / math.pi
    return 0.5 / (np.diff(crossings).mean() * step_s), decay / math.hypot(1.0, decay)


@given(st.sampled_from(LAWS), st.lists(st.floats(-60.0, 60.0), min_size=1, max_size=6))
def test_compiled_hysteresis_is_independent_of_the_step(law, travels):
    plant = plant_of(replace(AXES[0].mechanics, hysteresis=law, motor_orders=()))
    exponent, beta = (law.exponent, law.beta) if isinstance(law, BoucWen) else (0.0, 0.0)
    got = []
    for travel in travels:
        count = max(1, math.ceil(abs(travel) / 0.1))
        for _ in range(count):
            value, _ = hysteresis(plant.elements, exponent, beta, math.radians(travel / count))
        got.append(value / ARCSEC)
    expected = static_error_arcsec(
        replace(AXES[0].mechanics, hysteresis=law, motor_orders=()), np.cumsum(travels)
    )
    assert got == pytest.approx(expected, abs=0.01)
    assert np.abs(got).max() <= (abs(law.offset_arcsec) if isinstance(law, BoucWen) else 30.0) + 1e-9


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: f"{axis.structure}-{axis.seed}")
def test_without_losses_energy_is_kept_and_with_them_it_never_grows(axis):
    for mechanics, loss in ((lossless(axis.mechanics), False), (axis.mechanics, True)):
        plant = plant_of(replace(mechanics, gravity_nm=0.2 * mechanics.stiffness_nm_per_rad * ARCSEC * 600.0))
        plant.state[0]["motor_speed"], plant.state[0]["load"] = 40.0, 3e-4
        energy = advance(plant, 1.0, every=10)[:, 4]
        if loss:
            assert np.diff(energy).max() < 1e-4 * energy[0]  # oscillation of the integrator
            assert energy[-1] < 0.7 * energy[0]
        else:
            assert energy == pytest.approx(energy[0], rel=0.01)


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: f"{axis.structure}-{axis.seed}")
def test_the_load_rings_at_its_natural_frequency(axis):
    mechanics = replace(axis.mechanics, motor_orders=(), hysteresis=MaxwellSlip(()))
    plant = plant_of(mechanics)
    plant.state[0]["load"] = 1e-4
    held = advance(plant, 6.0 / mechanics.held_hz, brake_nm=1e3)
    assert not np.any(held[:, 0])  # a braked motor stands exactly
    frequency_hz, damping = frequency_and_damping(held[:, 2], DT_S)
    drag = mechanics.damping_nm_s_per_rad + mechanics.load_viscous_nm_s_per_rad
    damped = drag / 2.0 / math.sqrt(mechanics.stiffness_nm_per_rad * mechanics.load_inertia_kg_m2)
    assert damping == pytest.approx(damped, rel=0.01)
    assert frequency_hz == pytest.approx(mechanics.held_hz * math.sqrt(1.0 - damped**2), rel=2e-3)

    plant = plant_of(lossless(mechanics))
    plant.state[0]["load"] = 1e-4
    free = advance(plant, 8.0 / mechanics.free_hz)
    relative = free[:, 2] - free[:, 0] / mechanics.ratio
    assert frequency_and_damping(relative, DT_S)[0] == pytest.approx(mechanics.free_hz, rel=2e-3)


def test_coulomb_friction_stops_the_axis_by_energy_balance():
    mechanics = replace(lossless(AXES[0].mechanics), coulomb_nm=0.05, stribeck_rise=0.0, motor_orders=())
    mechanics = replace(mechanics, hysteresis=MaxwellSlip(()), damping_nm_s_per_rad=20.0)
    plant = plant_of(mechanics)
    speed = 60.0
    plant.state[0]["motor_speed"], plant.state[0]["load_speed"] = speed, speed / mechanics.ratio
    stop_s = mechanics.inertia_kg_m2 * speed / 0.05
    rows = advance(plant, 2.0 * stop_s + 0.5)
    assert rows[-1, 0] == pytest.approx(0.5 * speed * stop_s, rel=0.01)
    assert rows[-1, 1] == 0.0
