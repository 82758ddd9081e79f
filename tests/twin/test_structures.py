"""Fits of servos that are not the ones a fit assumes first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from foreign.bench import bench_of
from foreign.draw import Truth as Foreign
from foreign.draw import draw
from foreign.mechanics import BoucWen

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Bench
from hdbridge.drive.drive import Drive
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import compare
from hdbridge.twin.fit import MOST_DEAD_CYCLES, Fitted, in_best_structure, start_of, starts
from hdbridge.twin.misfit import (
    CHANNELS,
    Data,
    Replays,
    Values,
    counted,
    misfit,
    prepare,
    residuals,
    units,
    values_of,
    what_is_left,
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


@dataclass(frozen=True)
class Recorded:
    """A foreign axis on two motions, and usual values with its transmission error."""

    axis: AxisConfig
    fitted: Recording
    other: Recording
    start: Truth


def recorded(structure: str, seed: int, folder: Path) -> Recorded:
    foreign = draw(seed, structure)
    with bench_of(foreign, folder) as axis:
        config = axis.axis
    first, other = (run(foreign, each, folder) for each in (FITTED, OTHER))
    return Recorded(config, first, other, with_error_of(foreign, config))


def run(foreign: Foreign, plan: str, folder: Path) -> Recording:
    path = folder / "plan.yaml"
    path.write_text(plan)
    parts = []
    with bench_of(foreign, folder) as axis, Drive(axis.bus, axis.axis, axis.clock) as drive:
        drive.boot()
        place = Bench(drive)
        for task in Plan.load(path).tasks(place.view).tasks:
            done = place.run(task.procedure)
            parts.append(Recording(done.record, done.segments, done.axis, done.ratio))
    return Recording.joined(parts)


def with_error_of(foreign: Foreign, axis: AxisConfig) -> Truth:
    law, truth = foreign.mechanics.hysteresis, default_truth(axis).model_dump(by_alias=True)
    truth["gear"]["motor_orders"] = [each._asdict() for each in foreign.mechanics.motor_orders]
    elements = [
        {"limit_arcsec": limit, "yield_deg": travel} for limit, travel in getattr(law, "elements", ())
    ]
    truth["gear"]["hysteresis"] = (
        {"law": "bouc_wen", "offset_arcsec": law.offset_arcsec, "yield_deg": law.yield_deg}
        if isinstance(law, BoucWen)
        else {"law": "maxwell_slip", "elements": elements}
    )
    return Truth.model_validate(truth)


def plain_fit(data: Data, start: Truth, steps: int = 25) -> Truth:
    """Levenberg-Marquardt over the replay, from soft loops without torque feed-forward: the reference."""
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
    rows = {name: (each > 0.0) & (data.out == 0.0) for name, each in counted(data).items()}

    def left(place: np.ndarray) -> np.ndarray:
        found = residuals(data, at_coordinates(truth, parameters, place.tolist()))
        return np.concatenate([found[name][rows[name]] / scale[name] for name in CHANNELS])

    place, damping = np.clip(coordinates(truth, parameters), low, high), 1e-2
    now = left(place)
    for _ in range(steps):
        table = np.stack([(left(place + 0.02 * step) - now) / 0.02 for step in np.diag(spread)], axis=1)
        gram = table.T @ table
        while damping < 1e6:
            move = np.linalg.solve(gram + damping * np.diag(np.diag(gram) + 1e-9), -table.T @ now)
            there = np.clip(place + np.clip(move, -2.0, 2.0) * spread, low, high)
            tried = left(there)
            if tried @ tried < now @ now:
                place, now, damping = there, tried, 0.3 * damping
                break
            damping *= 4.0
        else:
            break
    return at_coordinates(truth, parameters, place.tolist())


def shares(recorded: Recorded, truth: Truth) -> dict[str, float]:
    """Following error and torque on the other motion, share of the signal."""
    again = replay(recorded.other, recorded.axis, truth)
    told = compare(recorded.other.record, again, recorded.other.segments, recorded.axis.gear.ratio)
    rows = {name: told.row(name) for name in ("following_error", "motor_torque")}
    return {name: row.share for name, row in rows.items() if row is not None}


@pytest.mark.parametrize("cycle_ms", [1.0, 4.0])
@pytest.mark.parametrize("dead_time_ms", [0.5, 15.0])
def test_a_start_has_the_lag_that_was_read_off_and_a_dead_time_that_is_possible(
    cycle_ms: float, dead_time_ms: float
) -> None:
    usual = default_truth(AxisConfig.load(Path(__file__).parents[2] / "profiles" / "demo"))
    late = with_values(usual, {"servo dead time": dead_time_ms, "command filter": 2.0})
    for truth, parameters in starts(late, cycle_ms):
        servo = truth.servo
        assert servo.dead_time_ms <= MOST_DEAD_CYCLES * cycle_ms
        lag_ms = servo.dead_time_ms + 2.0 * servo.command_filter_ms + 0.5 * servo.moving_average_ms
        assert lag_ms == pytest.approx(dead_time_ms + 4.0, abs=1e-6)
        (dead,) = (each for each in parameters if each.name == "servo dead time")
        assert dead.most <= MOST_DEAD_CYCLES * cycle_ms


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("structure", ["pi_notch", "piv"])
def test_a_twin_follows_a_foreign_servo_and_is_never_worse_than_a_plain_fit(
    structure: str, tmp_path: Path
) -> None:
    axis = recorded(structure, 3, tmp_path)
    data = prepare(axis.fitted, axis.axis, axis.start)
    with Replays(data, 1) as replays:
        found: Fitted = in_best_structure(replays, start_of(axis.start, data))
    plain = plain_fit(data, start_of(axis.start, data))
    assert misfit(data, found.residuals) < 1.02 * misfit(data, residuals(data, plain))
    twin, reference = shares(axis, found.truth), shares(axis, plain)
    assert twin["following_error"] < max(0.05, 1.02 * reference["following_error"])
    assert twin["motor_torque"] < max(0.10, 1.02 * reference["motor_torque"])
    left = what_is_left(data, found.residuals, dict.fromkeys(CHANNELS, 1e-09))
    assert values_of(left) is Values.REPLAY
