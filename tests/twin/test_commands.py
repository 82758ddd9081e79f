"""Reading of a recording before its replay: cycles, legs, and remarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.replay import counted_cycles, doubts, legs_of

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS = AxisConfig.load(DEMO)


def moves(bench: Exercise) -> None:
    for distance in (200.0, -150.0, 90.0, -140.0, 60.0):
        bench.move(distance, 600.0, 6000.0)
        bench.hold(0.4)


@pytest.fixture(scope="module")
def bare() -> Record:
    """A record without any legs, as a CSV file is."""
    return record_of(Truth.load(DEMO), moves)


def changed(record: Record, **columns: np.ndarray) -> Recording:
    return Recording(Record({**record.columns, **columns}), axis="demo", ratio=50.0)


@given(
    late=st.dictionaries(st.integers(1, 498), st.floats(0.0, 0.9), max_size=20),
    lost=st.sets(st.integers(1, 498), max_size=5),
)
def test_rows_are_counted_whatever_their_stamps_are_late_by(late: dict[int, float], lost: set[int]) -> None:
    """No stamp is earlier than the one before it, and rows that were not recorded are cycles still."""
    cycles = np.arange(500.0)
    stamps = cycles.copy()
    for row, share in late.items():
        if row + 1 not in lost and row not in lost:
            stamps[row] += min(share, 0.45)
    kept = np.array([row not in lost for row in range(500)])
    found = counted_cycles(0.004 * stamps[kept] + 7.0, 0.004)
    assert found == pytest.approx(cycles[kept])


def test_rows_that_follow_no_cycle_stay_where_they_are() -> None:
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.002, 0.006, 400))
    assert counted_cycles(time_s, 0.004) == pytest.approx((time_s - time_s[0]) / 0.004)


def test_legs_of_a_bare_record_are_cut_where_its_command_sets_out(bare: Record) -> None:
    legs = legs_of(Recording(bare, axis="demo", ratio=50.0))
    assert len(legs) == 5
    assert legs[0].start_s == bare.time_s[0]
    assert legs[-1].end_s == bare.time_s[-1]
    target = bare.motor_target_deg
    assert target is not None
    for leg in legs[1:]:
        row = int(np.searchsorted(bare.time_s, leg.start_s))
        assert target[row] == target[row - 1] != target[row + 1]


def test_a_long_standstill_belongs_to_no_leg() -> None:
    """Motion is held out, not the hour in which a gear cools down."""
    time_s = np.arange(0.0, 20.0, 0.01)
    angle = np.interp(time_s, [0.0, 1.0, 15.0, 16.0], [0.0, 90.0, 90.0, 0.0])
    record = Record({"time_s": time_s, "motor_target_deg": angle, "motor_position_deg": angle,
                     "load_position_deg": angle / 50.0})  # fmt: skip
    spans = [(leg.start_s, leg.end_s) for leg in legs_of(Recording(record, ratio=50.0))]
    assert spans == [pytest.approx((0.0, 2.0), abs=0.02), pytest.approx((15.0, 17.0), abs=0.02)]


def test_an_oscillation_without_rest_is_cut_at_its_turns() -> None:
    time_s = np.arange(0.0, 6.0, 0.004)
    angle = 20.0 * np.sin(2.0 * np.pi * 0.5 * time_s)
    record = Record({"time_s": time_s, "motor_target_deg": angle, "motor_position_deg": angle,
                     "load_position_deg": angle / 50.0})  # fmt: skip
    turns = [leg.start_s for leg in legs_of(Recording(record, ratio=50.0))[1:]]
    assert turns == pytest.approx([0.5, 1.5, 2.5, 3.5, 4.5, 5.5], abs=0.01)


def test_a_recording_in_order_raises_no_doubt(bare: Record) -> None:
    assert doubts(changed(bare), AXIS) == ()


def test_a_torque_with_the_wrong_sign_or_unit_is_noticed(bare: Record) -> None:
    torque = bare.columns["motor_torque_nm"]
    (sign,) = doubts(changed(bare, motor_torque_nm=-torque), AXIS)
    assert "change its sign" in sign
    percent = 100.0 * torque / AXIS.drive.rated_torque_nm
    (unit,) = doubts(changed(bare, motor_torque_nm=percent), AXIS)
    assert "per cent" in unit


def test_a_command_that_was_logged_late_is_noticed(bare: Record) -> None:
    target = bare.motor_target_deg
    assert target is not None
    late = np.concatenate([np.full(4, target[0]), target[:-4]])
    (said,) = doubts(changed(bare, motor_target_deg=late), AXIS)
    assert "move motor_target_deg earlier" in said
