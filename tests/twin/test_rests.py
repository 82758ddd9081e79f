"""Where an axis stands in a recording, and what the recording tells of it there."""

from __future__ import annotations

import numpy as np

from hdbridge.records.record import Record
from hdbridge.twin.rests import HELD_S, held_rows, stands

CYCLE_S = 0.01
COUNT_DEG = 0.045


def moved_twice(creeps_deg: float) -> tuple[Record, np.ndarray]:
    """Half a second of motion, as much of rest in which the motor creeps, and motion again."""
    target = np.concatenate([np.linspace(0.0, 20.0, 50), np.full(50, 20.0), np.linspace(20.4, 40.0, 49)])
    motor = target.copy()
    motor[60:100] += creeps_deg * np.linspace(0.0, 1.0, 40)
    time_s = CYCLE_S * np.arange(len(target))
    columns = {"time_s": time_s, "motor_target_deg": target, "motor_position_deg": motor}
    moved = np.diff(target, prepend=target[0]) != 0.0
    return Record(columns | {"load_position_deg": motor / 50.0}), moved


def test_a_standing_motor_tells_its_torque_again_and_again_and_at_last() -> None:
    """The integral goes on meanwhile: what it comes to at the end may be after the motor broke away."""
    record, moved = moved_twice(COUNT_DEG)
    held = held_rows(record, moved, stands(moved, record.motor_position_deg, 1.5 * COUNT_DEG))
    assert held[-1] == 99, "the last row of the rest"
    assert np.all(np.abs(np.diff(record.time_s[held[:-1]]) - HELD_S) < 1.5 * CYCLE_S)
    assert len(held) == 5
    assert not moved[held].any()


def test_a_motor_that_is_still_under_way_tells_none() -> None:
    record, moved = moved_twice(100.0 * COUNT_DEG)
    held = held_rows(record, moved, stands(moved, record.motor_position_deg, 1.5 * COUNT_DEG))
    assert held.tolist() == [99]
