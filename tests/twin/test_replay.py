"""A recording's commands, replayed through the simulated drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import ChannelSource, Temperature
from hdbridge.control.bench import Bench, axis_view
from hdbridge.drive.drive import Drive
from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import MoveTo
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from hdbridge.twin.replay import replay

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
SENSOR = ChannelSource(index=0x2100, type="int16", via="tpdo")
CHANNELS = ("time_s", "motor_target_deg", "motor_position_deg", "load_position_deg", "motor_torque_nm")


def demo(noise_arcsec: float = 0.0, **servo: float) -> tuple[AxisConfig, Truth]:
    """The demo axis with encoders that count backwards, and its truth."""
    axis, truth = (yaml.safe_load((DEMO / name).read_text()) for name in ("axis.yaml", "truth.yaml"))
    for name in ("motor_encoder", "load_encoder"):
        axis[name]["direction"] = -1
    for each in (truth["motor"]["encoder"], truth["load"]["encoder"]):
        each["direction"] = -1
    truth["load"]["encoder"]["noise_arcsec"] = noise_arcsec
    truth["servo"].update(servo)
    return AxisConfig.from_text(yaml.safe_dump(axis), DEMO / "axis.yaml"), Truth.model_validate(truth)


def benched(axis: AxisConfig, truth: Truth, procedure: Any) -> Recording:
    with (
        simulated_bench(truth, axis.eds_path, axis.drive.node_id) as (bus, clock, _),
        Drive(bus, axis, clock) as drive,
    ):
        drive.boot()
        return Bench(drive).run(procedure)


@pytest.mark.parametrize(("dead_time_ms", "torque_percent"), [(0.0, 100.0), (1.3, 100.0), (0.0, 20.0)])
def test_the_replay_on_the_true_axis_is_its_recording_over_frames(
    dead_time_ms: float, torque_percent: float
) -> None:
    axis, truth = demo(dead_time_ms=dead_time_ms)
    limits = axis.limits.model_copy(update={"torque_percent": torque_percent})
    axis = axis.model_copy(update={"limits": limits})
    recording = benched(axis, truth, Stepping(2, start_deg=0.0))
    again = replay(recording, axis, truth)
    for name in CHANNELS:
        assert np.array_equal(again.columns[name], recording.record.columns[name]), name


def test_a_replay_begins_where_the_recording_does_and_shows_what_the_drive_is() -> None:
    axis, truth = demo()
    recording = benched(axis, truth, Stepping(2, start_deg=3.0))
    slower = truth.servo.model_copy(update={"dead_time_ms": 2.0})
    late = replay(recording, axis, truth.model_copy(update={"servo": slower}))
    same = replay(recording, axis, truth)
    record = recording.record
    assert np.array_equal(same.motor_position_deg[0], record.motor_position_deg[0])
    # At a constant speed v, 2 ms of dead time are v * 2 ms behind.
    speed = np.gradient(record.columns["motor_target_deg"], record.time_s)
    steady = np.abs(speed) > 0.8 * np.max(np.abs(speed))
    behind = (same.motor_position_deg - late.motor_position_deg)[steady] / speed[steady]
    assert np.median(behind) == pytest.approx(2e-3, abs=2e-4)


def test_rows_off_the_cycle_are_interpolated() -> None:
    axis, truth = demo()
    record = benched(axis, truth, Stepping(2)).record
    whole = replay(Recording(record), axis, truth)
    some = np.sort(np.random.default_rng(0).choice(len(record), len(record) - 100, replace=False))
    some[0] = 0
    fewer = Record({name: column[some] for name, column in record.columns.items()})
    given = replay(Recording(fewer), axis, truth)
    assert np.array_equal(given.time_s, fewer.time_s)
    apart = np.abs(given.motor_position_deg - whole.motor_position_deg[some])
    assert np.max(apart) < 0.2  # the command between two rows is a guess, to some counts of 0.045 deg


def test_parts_are_replayed_one_by_one() -> None:
    axis, truth = demo()
    recordings = [benched(axis, truth, Stepping(2, start_deg=start)) for start in (0.0, -2.0)]
    joined = Recording.joined([replace(each) for each in recordings])
    assert len(joined.record.parts()) == 2
    given = replay(joined, axis, truth)
    assert np.array_equal(given.motor_position_deg, joined.record.motor_position_deg)


def test_a_part_begins_as_warm_as_it_was_recorded() -> None:
    """An axis whose friction falls by a hundredth per kelvin, and which is 20 K warmer at the second part."""
    axis, truth = demo()
    axis = axis.model_copy(update={"temperature": Temperature(source=SENSOR, celsius_per_count=0.1)})
    heat = truth.temperature.model_copy(update={"friction_growth_per_k": -0.01, "reference_c": 22.0})
    plants = [
        truth.model_copy(update={"temperature": heat.model_copy(update={"start_c": warm_c})})
        for warm_c in (22.0, 42.0)
    ]
    joined = Recording.joined([benched(axis, each, Stepping(2, start_deg=0.0)) for each in plants])
    again = replay(joined, axis, plants[0])
    apart = {
        name: np.max(np.abs(again.columns[name] - joined.record.columns[name]))
        for name in ("motor_position_deg", "motor_torque_nm", "temperature_c")
    }
    assert apart["motor_position_deg"] < 1.5 * 360.0 / 8000.0
    assert apart["motor_torque_nm"] < 0.1 * truth.motor.coulomb_nm
    assert apart["temperature_c"] < 0.15
    untold = [column for column in joined.record.columns if column != "temperature_c"]
    record = Record({name: joined.record.columns[name] for name in untold}, starts=joined.record.starts)
    cold = replay(replace(joined, record=record), axis, plants[0])
    second = slice(joined.record.starts[1], None)
    torque_nm = (each.columns["motor_torque_nm"][second] for each in (cold, joined.record))
    apart = np.abs(np.subtract(*torque_nm))
    assert np.median(apart) > 0.1 * truth.motor.coulomb_nm


def test_without_a_command_there_is_nothing_to_replay() -> None:
    axis, truth = demo()
    time_s = np.arange(10) * 0.004
    record = Record({"time_s": time_s, "motor_position_deg": time_s, "load_position_deg": time_s})
    with pytest.raises(InputError, match="motor_target_deg"):
        replay(Recording(record), axis, truth)


def test_a_dead_time_delays_torque_and_motion_alike() -> None:
    axis, truth = demo()
    seen = {}
    for dead_ms in (0.0, 2.0):
        servo = truth.servo.model_copy(update={"dead_time_ms": dead_ms})
        machine = Machine(truth.model_copy(update={"servo": servo}), 0)
        path = MoveTo(5.0).path(0.0, axis_view(axis).limits)
        demand, rows = 0.0, []
        for number in range(600):
            goal = -round(path.at(number * 0.0005) * 50 * 8000 / 360)
            machine.follow(demand, goal, 1)
            demand = goal
            rows.append((machine.motor_counts, machine.torque_nm))
        seen[dead_ms] = np.array(rows)
    shift = round(0.002 / truth.substep_s)
    assert np.allclose(seen[2.0][shift:], seen[0.0][:-shift], atol=1e-3)


def test_commands_at_uneven_times_are_met_to_the_last_row() -> None:
    """A recording that ends in motion, between two cycles."""
    axis, truth = demo()
    time_s = 0.01 * np.arange(60) + 0.00037 * np.arange(60)
    target_deg = 300.0 * np.maximum(time_s - 0.1, 0.0)
    columns = {"time_s": time_s, "motor_target_deg": target_deg}
    record = Record(columns | {"motor_position_deg": target_deg, "load_position_deg": target_deg / 50.0})
    told = replay(Recording(record, ratio=50.0), axis, truth).motor_target_deg
    assert told is not None
    assert np.max(np.abs(told - target_deg)) < 0.06, "motor degrees: a count and its rounding"


def test_a_late_stamp_changes_no_simulated_signal() -> None:
    """The clock of a log is late now and then; the drive's cycles are not."""
    axis, truth = demo()
    recording = benched(axis, truth, Stepping(2, start_deg=0.0))
    time_s = recording.record.time_s.copy()
    time_s[len(time_s) // 2] += 0.0015
    late = replace(recording, record=Record({**recording.record.columns, "time_s": time_s}))
    again, straight = (replay(each, axis, truth).columns for each in (late, recording))
    for name in CHANNELS[1:]:
        assert np.array_equal(again[name], straight[name]), name
