"""Thermal constants are learned from a warm-up and otherwise unchanged."""

from __future__ import annotations

import numpy as np
import pytest
from support.demo import AXIS, TRUTH
from support.keys import changed

from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth.truth import TrueTemperature
from hdbridge.twin.fit import Fitted, solve
from hdbridge.twin.misfit import Replays, prepare
from hdbridge.twin.parameters import named
from hdbridge.twin.thermal import THERMAL, with_warmth

SENSOR_K = 0.1
FRICTION = named("Coulomb friction", "viscous friction")


def warmed(heat: TrueTemperature, seed: int, minutes: float, rests: float = 0.25) -> Recording:
    """Records the demo axis with these thermal constants, at two kinds of work and at rest."""
    rng = np.random.default_rng(seed)
    truth = TRUTH.model_copy(update={"temperature": heat})
    machine = Machine(truth, seed, may_compile=True)
    machine.torque_limit_permille = 10.0 * AXIS.limits.torque_percent
    bench = Exercise(machine, cycle_s=0.02)
    seconds = 60.0 * minutes
    while (now_s := bench.samples * bench.cycle_s) < (1.0 - rests) * seconds:
        fast = rng.random() < 0.5
        until_s = now_s + float(rng.uniform(0.03, 0.1)) * seconds
        while bench.samples * bench.cycle_s < until_s:
            way = float(rng.choice([-1.0, 1.0]))
            bench.move(way * 400.0, 5000.0, 60_000.0) if fast else bench.move(way * 2000.0, 2500.0, 9000.0)
            bench.hold(0.2)
    bench.hold(rests * seconds)
    readings = bench.readings()
    return Recording(
        Record(
            {
                "time_s": readings.time_s,
                "motor_target_deg": readings.target_deg,
                "motor_position_deg": readings.motor_deg,
                "load_position_deg": readings.load_deg,
                "motor_torque_nm": readings.motor_torque_nm,
                "temperature_c": SENSOR_K * np.round(readings.temperature_c / SENSOR_K),
            }
        )
    )


def fitted(recording: Recording) -> Fitted:
    """Solves for the friction with zero steps, only to obtain its uncertainty."""
    few = recording.record.rows(0, 500)
    with Replays(prepare(Recording(few), AXIS, TRUTH), 1) as replays:
        return solve(replays, TRUTH, FRICTION, 0)


HEATS = (
    TrueTemperature(
        ambient_c=26.0, start_c=24.0, resistance_k_per_w=3.0, time_constant_s=250.0, copper_loss_w=20.0
    ),
    TrueTemperature(
        ambient_c=18.0, start_c=16.0, resistance_k_per_w=2.0, time_constant_s=400.0, copper_loss_w=5.0
    ),
)


@pytest.mark.parametrize("seed", range(len(HEATS)))
def test_constants_that_are_off_by_factors_are_learned_from_a_warm_up(seed: int) -> None:
    recording = warmed(HEATS[seed], seed, 10.0)
    after, change = with_warmth(recording, AXIS, fitted(recording), TRUTH)
    assert change is not None
    assert change.cause == "warmth"
    for each in THERMAL:
        lower, upper = after.intervals[each.path]
        assert lower <= getattr(HEATS[seed], each.path.split(".")[-1]) <= upper, each.name
    assert after.temperature.time_constant_s == pytest.approx(HEATS[seed].time_constant_s, rel=0.15)
    assert after.temperature.resistance_k_per_w == pytest.approx(HEATS[seed].resistance_k_per_w, rel=0.15)


def test_seconds_of_motion_leave_thermal_constants_unchanged() -> None:
    heat = TrueTemperature(ambient_c=23.0, resistance_k_per_w=2.0, time_constant_s=600.0, copper_loss_w=5.0)
    recording = warmed(heat, 0, 0.1, rests=0.0)
    after, change = with_warmth(recording, AXIS, fitted(recording), TRUTH)
    assert change is None
    assert after.temperature.ambient_c == pytest.approx(22.0, abs=3.0)
    for each in THERMAL[1:3]:
        lower, upper = after.intervals[each.path]
        usual = getattr(TRUTH.temperature, each.path.split(".")[-1])
        assert getattr(after.temperature, each.path.split(".")[-1]) == pytest.approx(usual, rel=0.2), (
            each.name
        )
        assert lower < 0.5 * usual < 2.0 * usual < upper, each.name


def test_the_time_between_parts_is_not_guessed() -> None:
    """Joined parts are one row apart, whatever time has passed between them, so the second part of this
    warm-up starts from its own temperature reading.
    """
    whole = warmed(HEATS[0], 2, 12.0).record
    parts = [Recording(whole.rows(0, len(whole) // 3)), Recording(whole.rows(len(whole) // 2, len(whole)))]
    recording = Recording.joined(parts)
    after, _ = with_warmth(recording, AXIS, fitted(recording), TRUTH)
    lower, upper = after.intervals["temperature.time_constant_s"]
    assert lower <= HEATS[0].time_constant_s <= upper


def test_without_temperature_the_truth_is_unchanged() -> None:
    recording = warmed(HEATS[0], 0, 0.3, rests=0.0)
    columns = {name: each for name, each in recording.record.columns.items() if name != "temperature_c"}
    assert with_warmth(Recording(Record(columns)), AXIS, fitted(recording), TRUTH) == (TRUTH, None)


def test_warmth_dependent_terms_keep_their_reference() -> None:
    """The reference remains the former ambient temperature if a new one is fitted."""
    start = changed(TRUTH, temperature__friction_growth_per_k=-0.01)
    heat = HEATS[0].model_copy(update={"friction_growth_per_k": -0.01, "reference_c": 22.0})
    recording = warmed(heat, 3, 8.0)
    after, _ = with_warmth(recording, AXIS, fitted(recording), start)
    assert after.temperature.ambient_c == pytest.approx(26.0, abs=0.3)
    assert after.temperature.unchanged_c == 22.0
    lower, upper = after.intervals["temperature.resistance_k_per_w"]
    assert lower <= 3.0 <= upper
