"""Fits of servos that differ from the initial assumption of a fit."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from foreign.draw import draw
from scipy.optimize import least_squares
from support.demo import AXIS
from twin_foreign_axes import axis_of, bench, start

from hdbridge.axis import AxisConfig
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import compare
from hdbridge.twin.fit import MOST_DEAD_CYCLES, fit, start_of, starts
from hdbridge.twin.mechanics import measured_mechanics
from hdbridge.twin.misfit import (
    CHANNELS,
    Data,
    Replays,
    Values,
    channel_residuals,
    misfit,
    prepare,
    residuals,
    units,
    values_of,
)
from hdbridge.twin.parameters import BY_NAME, at_coordinates, coordinates, default_truth, with_values
from hdbridge.twin.replay import replay

MOTION = """
schema: hdbridge.plan/1
name: short
precondition_deg: 60
reference_s: 0.3
acceleration_deg_s2: 10000000
procedures:
  - {{procedure: stepping, count: {count}, step_deg: {step_deg}}}
  - {{procedure: sines, amplitudes_deg: [{amplitude_deg}], frequency_hz: {hz}, periods: 8}}
"""
FITTED = MOTION.format(count=8, step_deg=150, amplitude_deg=20, hz=4)
OTHER = MOTION.format(count=6, step_deg=97, amplitude_deg=15, hz=6)
PLAIN = (
    "motor inertia", "Coulomb friction", "viscous friction", "load inertia", "gear stiffness", "gear damping",
    "position gain", "velocity gain", "integral time", "command filter", "velocity feed-forward",
    "servo dead time",
)  # fmt: skip


def plain_fit(data: Data, start: Truth, steps: int = 25) -> Truth:
    """Returns the reference fit: least squares over the replay, started from soft loops without torque
    feed-forward.
    """
    whole = start.motor.inertia_kg_m2 + start.load_.whole_inertia_kg_m2 / start.gear.ratio**2
    soft = {
        "position_gain_per_s": 40.0,
        "velocity_gain_nm_s_per_rad": 120.0 * whole,
        "integral_time_ms": 25.0,
        "inertia_feedforward_kg_m2": 0.0,
        "load_feedforward": None,
        "viscous_feedforward_nm_s_per_rad": 0.0,
        "friction_feedforward_nm": 0.0,
    }
    truth = start.model_copy(update={"servo": start.servo.model_copy(update=soft)})
    parameters = tuple(BY_NAME[name] for name in PLAIN)
    spread = np.array([each.spread for each in parameters])
    low, high = np.array([each.bounds for each in parameters]).T
    scale = units(data)
    rows = {name: each & ~data.out for name, each in data.counts.items()}

    def left(place: np.ndarray) -> np.ndarray:
        found = residuals(data, at_coordinates(truth, parameters, place.tolist()))
        return np.concatenate([found[name][rows[name]] / scale[name] for name in CHANNELS])

    place = np.clip(coordinates(truth, parameters), low, high)

    def at(moved: np.ndarray) -> np.ndarray:
        return np.clip(place + (moved - 1.0) * spread, low, high)

    # The variables start at one, because least_squares takes steps in proportion to them.
    end = least_squares(lambda moved: left(at(moved)), np.ones(len(place)), diff_step=0.02, max_nfev=steps)
    return at_coordinates(truth, parameters, at(end.x).tolist())


def shares(other: Recording, axis: AxisConfig, truth: Truth) -> dict[str, float]:
    """Returns the errors of following error and torque on the other motion, as shares of the signal."""
    comparison = compare(other.record, replay(other, axis, truth), other.segments, axis.gear.ratio)
    rows = {name: comparison.row(name) for name in ("following_error", "motor_torque")}
    return {name: row.share for name, row in rows.items() if row is not None}


@pytest.mark.parametrize("cycle_ms", [1.0, 4.0])
@pytest.mark.parametrize("dead_time_ms", [0.5, 15.0])
def test_a_start_uses_the_measured_lag_and_a_feasible_dead_time(cycle_ms: float, dead_time_ms: float) -> None:
    late = with_values(default_truth(AXIS), {"servo dead time": dead_time_ms, "command filter": 2.0})
    found = list(starts(late, cycle_ms))
    assert found
    for truth, parameters in found:
        servo = truth.servo
        assert servo.dead_time_ms <= MOST_DEAD_CYCLES * cycle_ms
        lag_ms = servo.dead_time_ms + 2.0 * servo.command_filter_ms + 0.5 * servo.moving_average_ms
        assert lag_ms == pytest.approx(dead_time_ms + 4.0, abs=1e-6)
        (dead,) = (each for each in parameters if each.name == "servo dead time")
        assert dead.most <= MOST_DEAD_CYCLES * cycle_ms


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("structure", ["pi_notch", "piv"])
def test_a_twin_follows_a_foreign_servo_and_is_never_worse_than_a_plain_fit(structure: str) -> None:
    foreign = draw(3, structure)
    axis = axis_of(foreign)
    motions = (Plan.model_validate(yaml.safe_load(each)) for each in (FITTED, OTHER))
    fitted, other = (bench(foreign, each) for each in motions)
    data = prepare(fitted, axis, start(axis, foreign))
    with Replays(data, 1) as replays:
        found = fit(replays)
    plain = plain_fit(data, start_of(data.base, data, measured_mechanics(data)))
    assert misfit(data, found.residuals) < 1.02 * misfit(data, residuals(data, plain))
    twin, reference = (shares(other, axis, each) for each in (found.truth, plain))
    assert twin["following_error"] < max(0.05, 1.02 * reference["following_error"])
    assert twin["motor_torque"] < max(0.10, 1.02 * reference["motor_torque"])
    left = channel_residuals(data, found.residuals, dict.fromkeys(CHANNELS, 1e-09))
    assert values_of(left, 1.0) is Values.REPLAY
