"""A recording's commands, read and replayed through the simulated drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support.demo import AXIS, DEMO, TRUTH
from support.exercised import booted, moved, record_of
from support.keys import changed

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import ChannelSource, Temperature
from hdbridge.control.bench import Bench, axis_view
from hdbridge.errors import InputError
from hdbridge.motion.procedures.moves import MoveTo
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import Replays, coarse, prepare, residuals
from hdbridge.twin.parameters import LOAD, with_load_encoder, with_values
from hdbridge.twin.replay import (
    HELD_S,
    LARGEST_UNKNOWN,
    commands_of,
    continuous,
    counted_cycles,
    doubts,
    legs_of,
    replay,
    standing,
    stretches,
    unknown_rows,
)

SENSOR = ChannelSource(index=0x2100, type="int16", via="tpdo")
CHANNELS = ("time_s", "motor_target_deg", "motor_position_deg", "load_position_deg", "motor_torque_nm")


def demo(noise_arcsec: float = 0.0, **servo: float) -> tuple[AxisConfig, Truth]:
    """Returns the demo axis, with encoders that count backwards, and its truth."""
    axis, truth = (yaml.safe_load((DEMO / name).read_text()) for name in ("axis.yaml", "truth.yaml"))
    for name in ("motor_encoder", "load_encoder"):
        axis[name]["direction"] = -1
    for each in (truth["motor"]["encoder"], truth["load"]["encoder"]):
        each["direction"] = -1
    truth["load"]["encoder"]["noise_arcsec"] = noise_arcsec
    truth["servo"].update(servo)
    return AxisConfig.from_text(yaml.safe_dump(axis), DEMO / "axis.yaml"), Truth.model_validate(truth)


def benched(axis: AxisConfig, truth: Truth, procedure: Any) -> Recording:
    with booted(axis, truth) as (drive, _):
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
    late = replay(recording, axis, changed(truth, servo__dead_time_ms=2.0))
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
    assert np.max(apart) < 0.2  # between two rows, the command is known only to some counts of 0.045 deg


def test_parts_are_replayed_one_by_one() -> None:
    axis, truth = demo()
    recordings = [benched(axis, truth, Stepping(2, start_deg=start)) for start in (0.0, -2.0)]
    joined = Recording.joined([replace(each) for each in recordings])
    assert len(joined.record.parts()) == 2
    given = replay(joined, axis, truth)
    assert np.array_equal(given.motor_position_deg, joined.record.motor_position_deg)


def test_a_part_begins_as_warm_as_it_was_recorded() -> None:
    """The axis is 20 K warmer at the second part, and its friction falls by a hundredth per kelvin."""
    axis, truth = demo()
    axis = axis.model_copy(update={"temperature": Temperature(source=SENSOR, celsius_per_count=0.1)})
    heat = {"temperature__friction_growth_per_k": -0.01, "temperature__reference_c": 22.0}
    plants = [changed(truth, temperature__start_c=warm_c, **heat) for warm_c in (22.0, 42.0)]
    joined = Recording.joined([benched(axis, each, Stepping(2, start_deg=0.0)) for each in plants])
    again = replay(joined, axis, plants[0])
    apart = {
        name: np.max(np.abs(again.columns[name] - joined.record.columns[name]))
        for name in ("motor_position_deg", "motor_torque_nm", "temperature_c")
    }
    assert apart["motor_position_deg"] < 1.5 * 360.0 / 8000.0
    assert apart["motor_torque_nm"] < 0.1 * truth.motor.coulomb_nm
    assert apart["temperature_c"] < 0.15
    remaining = [column for column in joined.record.columns if column != "temperature_c"]
    record = Record({name: joined.record.columns[name] for name in remaining}, starts=joined.record.starts)
    cold = replay(replace(joined, record=record), axis, plants[0])
    second = slice(joined.record.starts[1], None)
    torque_nm = (each.columns["motor_torque_nm"][second] for each in (cold, joined.record))
    apart = np.abs(np.subtract(*torque_nm))
    assert np.median(apart) > 0.1 * truth.motor.coulomb_nm


def test_a_recording_without_commands_is_refused() -> None:
    axis, truth = demo()
    time_s = np.arange(10) * 0.004
    record = Record({"time_s": time_s, "motor_position_deg": time_s, "load_position_deg": time_s})
    with pytest.raises(InputError, match="motor_target_deg"):
        replay(Recording(record), axis, truth)


def test_a_dead_time_delays_torque_and_motion_alike() -> None:
    axis, truth = demo()
    seen = {}
    for dead_ms in (0.0, 2.0):
        machine = Machine(changed(truth, servo__dead_time_ms=dead_ms), 0)
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
    """The recording ends in motion, between two cycles."""
    time_s = 0.01 * np.arange(60) + 0.00037 * np.arange(60)
    target_deg = 300.0 * np.maximum(time_s - 0.1, 0.0)
    used = replay(Recording(record_at(time_s, target_deg), ratio=50.0), *demo()).columns["motor_target_deg"]
    assert np.max(np.abs(used - target_deg)) < 0.06, "motor degrees: a count and its rounding"


def test_a_late_stamp_changes_no_simulated_signal() -> None:
    """Time stamps of a log are occasionally delayed; the drive's cycles are not."""
    axis, truth = demo()
    recording = benched(axis, truth, Stepping(2, start_deg=0.0))
    time_s = recording.record.time_s.copy()
    time_s[len(time_s) // 2] += 0.0015
    late = replace(recording, record=Record({**recording.record.columns, "time_s": time_s}))
    again, straight = (replay(each, axis, truth).columns for each in (late, recording))
    for name in CHANNELS[1:]:
        assert np.array_equal(again[name], straight[name]), name


def recorded() -> Recording:
    return Recording(record_of(TRUTH, moved((400.0, 600.0, 6000.0, 1.5))), axis="demo", ratio=50.0)


def test_two_threads_give_the_same_result() -> None:
    truths = [with_values(TRUTH, {"Coulomb friction": each}) for each in (0.034, 0.05)]
    data = prepare(recorded(), AXIS, TRUTH)
    with Replays(data, 1) as alone, Replays(data, 2) as together:
        for few in (False, True):
            ones, others = (each.rough(truths) if few else each(truths) for each in (alone, together))
            for one, other in zip(ones, others, strict=True):
                assert all(np.array_equal(one[name], other[name]) for name in one)


there_and_back = moved(*((each, 600.0, 6000.0, 0.4) for each in (200.0, -150.0, 90.0, -140.0, 60.0)))


@pytest.fixture(scope="module")
def bare() -> Record:
    """A record without any legs, as a CSV file is."""
    return record_of(TRUTH, there_and_back)


@given(
    late=st.dictionaries(st.integers(1, 498), st.floats(0.0, 0.9), max_size=20),
    lost=st.sets(st.integers(1, 498), max_size=5),
)
def test_rows_are_counted_whatever_their_stamps_are_late_by(late: dict[int, float], lost: set[int]) -> None:
    """Stamps never decrease, and rows that were not recorded still count as cycles."""
    cycles = np.arange(500.0)
    stamps = cycles.copy()
    for row, share in late.items():
        if row + 1 not in lost and row not in lost:
            stamps[row] += min(share, 0.45)
    kept = np.array([row not in lost for row in range(500)])
    found = counted_cycles(0.004 * stamps[kept] + 7.0, 0.004)
    assert found == pytest.approx(cycles[kept])


def test_rows_off_any_cycle_are_kept() -> None:
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.002, 0.006, 400))
    assert counted_cycles(time_s, 0.004) == pytest.approx((time_s - time_s[0]) / 0.004)


def record_at(time_s: np.ndarray, target: np.ndarray, motor: np.ndarray | None = None) -> Record:
    """Returns a record of a command, and of a motor and a load that follow it."""
    motor = target if motor is None else motor
    return Record({"time_s": time_s, "motor_target_deg": target, "motor_position_deg": motor,
                   "load_position_deg": motor / 50.0})  # fmt: skip


def test_legs_of_a_bare_record_start_with_each_move(bare: Record) -> None:
    legs = legs_of(Recording(bare, axis="demo", ratio=50.0))
    assert len(legs) == 5
    assert (legs[0].start_s, legs[-1].end_s) == (bare.time_s[0], bare.time_s[-1])
    target = bare.columns["motor_target_deg"]
    for leg in legs[1:]:
        row = int(np.searchsorted(bare.time_s, leg.start_s))
        assert target[row] == target[row - 1] != target[row + 1]


LONG_REST_S = np.arange(0.0, 20.0, 0.01)
SINE_S = np.arange(0.0, 6.0, 0.004)


@pytest.mark.parametrize(
    ("time_s", "angle", "spans"),
    [
        # Motion is held out, not the hour in which a gear cools down.
        (
            LONG_REST_S,
            np.interp(LONG_REST_S, [0.0, 1.0, 15.0, 16.0], [0.0, 90.0, 90.0, 0.0]),
            [(0.0, 2.0), (15.0, 17.0)],
        ),
        # An oscillation without rest is cut at its turning points.
        (
            SINE_S,
            20.0 * np.sin(np.pi * SINE_S),
            [(0.0, 0.5), *((0.5 + k, 1.5 + k) for k in range(5)), (5.5, 6.0)],
        ),
    ],
)
def test_a_leg_is_a_motion(time_s: np.ndarray, angle: np.ndarray, spans: list[tuple[float, float]]) -> None:
    found = [(leg.start_s, leg.end_s) for leg in legs_of(Recording(record_at(time_s, angle), ratio=50.0))]
    assert found == [pytest.approx(each, abs=0.02) for each in spans]


@pytest.mark.parametrize(
    ("name", "wrong", "says"),
    [
        ("motor_torque_nm", lambda torque: torque, None),
        ("motor_torque_nm", lambda torque: -torque, "change its sign"),
        ("motor_torque_nm", lambda torque: 100.0 * torque / AXIS.drive.rated_torque_nm, "per cent"),
        (
            "motor_target_deg",
            lambda target: np.append(np.full(4, target[0]), target[:-4]),
            "earlier by as many",
        ),
    ],
)
def test_a_wrong_torque_or_a_late_command_is_detected(
    bare: Record, name: str, wrong: Callable[[np.ndarray], np.ndarray], says: str | None
) -> None:
    recording = Recording(Record({**bare.columns, name: wrong(bare.columns[name])}), axis="demo", ratio=50.0)
    found = doubts(recording, AXIS)
    assert len(found) == (says is not None)
    assert all(str(says) in each for each in found)


CYCLE_S = 0.01
COUNT_DEG = 0.045


def moved_twice(creeps_deg: float) -> tuple[Record, np.ndarray]:
    """Returns half a second of motion, half a second of rest in which the motor creeps, and motion again."""
    target = np.concatenate([np.linspace(0.0, 20.0, 50), np.full(50, 20.0), np.linspace(20.4, 40.0, 49)])
    motor = target.copy()
    motor[60:100] += creeps_deg * np.linspace(0.0, 1.0, 40)
    moved = np.diff(target, prepend=target[0]) != 0.0
    return record_at(CYCLE_S * np.arange(len(target)), target, motor), moved


@pytest.mark.parametrize(("creeps_deg", "count"), [(COUNT_DEG, 5), (100.0 * COUNT_DEG, 1)])
def test_a_resting_motor_reports_torque_repeatedly(creeps_deg: float, count: int) -> None:
    """The integral continues meanwhile; its final value may be from after the motor broke away."""
    record, moved = moved_twice(creeps_deg)
    _, still, held = standing(record, COUNT_DEG)
    assert still[held].all()
    assert held[-1] == 99, "the last row of the rest"
    assert np.all(np.abs(np.diff(record.time_s[held[:-1]]) - HELD_S) < 1.5 * CYCLE_S)
    assert len(held) == count
    assert not moved[held].any()


def test_a_standing_motor_is_held_by_its_recorded_torque_in_the_replay_that_judges_a_twin() -> None:
    """Soft loops that have not settled would wind up, and begin the next motion with a different torque."""
    rests = record_of(TRUTH, moved((40.0, 300.0, 3000.0, 1.0), (9.0, 90.0, 900.0, 0.0)))
    soft = changed(
        TRUTH, servo__position_gain_per_s=8.0, servo__integral_of="position", servo__integral_time_ms=45.0
    )
    again = replay(Recording(rests, axis="demo", ratio=50.0), AXIS, soft)
    *_, held = standing(rests, COUNT_DEG)
    off_nm = (again.columns["motor_torque_nm"] - rests.columns["motor_torque_nm"])[held]
    assert len(held) > 5
    assert np.max(np.abs(off_nm)) < 0.1 * TRUTH.motor.coulomb_nm


def ended_in_motion(first_s: float, then_s: float) -> Record:
    """Returns a record whose first procedure ends far from where the second one begins."""
    parts = []
    for length_s, place in ((first_s, 0.0), (then_s, 7.0)):
        time_s = CYCLE_S * np.arange(round(length_s / CYCLE_S))
        parts.append(record_at(time_s, place + 5.0 * np.maximum(time_s - 0.5, 0.0)))
    return concatenate(parts)


def test_a_load_rings_as_long_after_an_unknown_stop_however_short_the_procedure_after_it() -> None:
    """A weakly damped load rings throughout a procedure of a second."""
    record = ended_in_motion(20.0, 1.2)
    unknown = unknown_rows(record, COUNT_DEG)
    assert not unknown[: record.starts[1]].any(), "it begins at rest"
    assert unknown[record.starts[1] :].all()


def test_the_unknown_start_of_a_recording_is_bounded() -> None:
    unknown = unknown_rows(ended_in_motion(1.0, 1.2), COUNT_DEG)
    assert np.mean(unknown) == pytest.approx(LARGEST_UNKNOWN, abs=0.02)


LEGS = (
    Segment(kind="standstill", start_s=0.0, end_s=4.0),
    Segment(kind="sweep", start_s=4.0, end_s=100.0),
    *(Segment(kind="step", start_s=100.0 + 2.0 * k, end_s=102.0 + 2.0 * k) for k in range(15)),
)


def swinging(duration_s: float = 130.0) -> Recording:
    time_s = CYCLE_S * np.arange(round(duration_s / CYCLE_S))
    record = record_at(time_s, 90.0 * np.sin(2.0 * np.pi * time_s / 40.0))
    return Recording(record, LEGS, ratio=50.0)


def test_stretches_are_all_rows_in_order_and_begin_with_legs() -> None:
    record = swinging().record
    cut = stretches(record, LEGS)
    assert np.array_equal(np.concatenate([each.time_s for each in cut]), record.time_s)
    assert all(5.0 <= each.time_s[-1] - each.time_s[0] + CYCLE_S <= 16.0 for each in cut)
    firsts = [float(each.time_s[0]) for each in cut]
    assert [each for each in firsts if each >= 100.0] == pytest.approx([100.0, 106.0, 112.0, 118.0, 124.0])
    short = swinging(25.0).record
    assert stretches(short, LEGS) == [short]


def test_a_fit_takes_some_of_each_kind_of_motion() -> None:
    data = prepare(swinging(), AXIS, TRUTH)
    taken = coarse(data, 40.0)
    taken_s, whole_s = (
        sum(len(each.commands.counts) * each.commands.cycle_s for each in some.pieces)
        for some in (taken, data)
    )
    assert taken_s <= 40.0
    assert {"sweep", "step"} <= set(taken.kinds)
    assert whole_s > 130.0
    # This axis is never at rest, and a stretch that begins in motion has no rest in its first row.
    assert len(data.pieces) > 5
    assert not any(each.rest.any() for each in data.pieces)


def test_a_fit_takes_pieces_of_a_warm_up_at_both_its_ends() -> None:
    record = swinging().record
    warm_c = 20.0 + 0.1 * np.floor(record.time_s)
    warms = Recording(Record({**record.columns, "temperature_c": warm_c}), LEGS, ratio=50.0)
    apart_k = []
    for each in (swinging(), warms):
        taken = coarse(prepare(each, AXIS, TRUTH), 60.0)
        apart_k.append(0.1 * np.ptp([float(piece.commands.time_s[0]) for piece in taken.pieces]))
    assert apart_k[0] < 11.0 < apart_k[1]


@cache
def two_tasks() -> Recording:
    """Two tasks of one drive; the second begins where the first has ended."""
    with booted(AXIS, TRUTH) as (drive, _):
        bench = Bench(drive)
        return Recording.joined([bench.run(Stepping(2, start_deg=0.0)) for _ in range(2)])


def delayed(recording: Recording, later_s: float) -> Recording:
    """Delays the second part, as if it were from a different recording."""
    record = recording.record
    time_s = record.time_s + later_s * (np.arange(len(record)) >= record.starts[1])
    return Recording(
        Record({**record.columns, "time_s": time_s}, record.source, record.starts), axis="demo", ratio=50.0
    )


def test_parts_soon_after_each_other_follow_and_later_ones_do_not() -> None:
    assert len(two_tasks().record.starts) == 2
    assert len(continuous(two_tasks().record)) == 1
    assert len(continuous(delayed(two_tasks(), 5.0).record)) == 2


def test_a_replay_switches_the_drive_off_between_parts_as_the_bench_does() -> None:
    """Otherwise a ringing load or a wound-up spring would restart from rest."""
    recording = two_tasks()
    again = replay(recording, AXIS, with_load_encoder(TRUTH, noise_arcsec=0.0))
    for name in ("motor_target_deg", "motor_position_deg", "motor_torque_nm"):
        assert np.array_equal(again.columns[name], recording.record.columns[name]), name


def test_a_part_that_ends_in_motion_slows_down_as_before_and_is_switched_off() -> None:
    record = two_tasks().record
    target, second = record.motor_target_deg, record.starts[1]
    assert target is not None
    moves = np.flatnonzero(np.diff(target[:second]) != 0.0)
    cut = int(moves[-1]) - 3  # the command still moves in the first of the rows that are left out
    kept = np.r_[0:cut, second : len(record)]
    columns = {name: column[kept] for name, column in record.columns.items()}
    commands = commands_of(Record(columns, starts=(0, cut)), AXIS, TRUTH)
    counts = np.array(commands.counts[commands.lead :])
    assert AXIS.motor_encoder.counts(1.0) * target[cut : cut + 2] == pytest.approx(
        counts[cut : cut + 2], abs=6
    )
    approach, off = commands.off
    assert approach.stop < commands.lead
    assert off.start == commands.lead + cut + 2
    assert off.stop == commands.lead + len(counts) - (len(record) - second) - 1


def test_the_second_part_counts_from_its_first_row_where_it_is_known_what_came_before() -> None:
    first, second = prepare(two_tasks(), AXIS, TRUTH).pieces
    judged = second.counts["following error"]
    assert judged.sum() == len(two_tasks().record) - two_tasks().record.starts[1]
    assert not judged[: -int(judged.sum())].any(), "the motion before it does not count"
    alone = prepare(delayed(two_tasks(), 5.0), AXIS, TRUTH).pieces[1]
    assert second.counts[LOAD].sum() > alone.counts[LOAD].sum() + 50
    assert first.counts[LOAD].any()


def test_the_elastic_state_is_that_of_the_part_before() -> None:
    """Replayed alone, the second part would begin with the elastic state of a drive that has just been
    switched on.
    """
    data = prepare(two_tasks(), AXIS, TRUTH)
    left = residuals(data, TRUTH)[LOAD]
    assert np.std(left[left != 0.0]) < 1.0, "arcsec: the noise and the rounding"
