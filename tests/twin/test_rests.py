"""Rests of an axis in a recording, and the values that they give."""

from __future__ import annotations

import numpy as np
import pytest

from hdbridge.records.record import Record, concatenate
from hdbridge.twin.replay import HELD_S, LARGEST_UNKNOWN, held_rows, stands, unknown_rows

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


def ended_in_motion(first_s: float, then_s: float) -> Record:
    """A procedure that ends far from where the next one begins."""
    parts = []
    for length_s, place in ((first_s, 0.0), (then_s, 7.0)):
        time_s = CYCLE_S * np.arange(round(length_s / CYCLE_S))
        target = place + 5.0 * np.maximum(time_s - 0.5, 0.0)
        columns = {"time_s": time_s, "motor_target_deg": target, "motor_position_deg": target}
        parts.append(Record(columns | {"load_position_deg": target / 50.0}))
    return concatenate(parts)


def test_a_load_rings_as_long_after_an_unknown_stop_however_short_the_procedure_after_it() -> None:
    """A hardly damped one rings on in all of a procedure of a second."""
    record = ended_in_motion(20.0, 1.2)
    unknown = unknown_rows(record, COUNT_DEG)
    assert not unknown[: record.starts[1]].any(), "it begins at rest"
    assert unknown[record.starts[1] :].all()


def test_no_more_of_a_recording_is_unknown_than_it_can_do_without() -> None:
    unknown = unknown_rows(ended_in_motion(1.0, 1.2), COUNT_DEG)
    assert np.mean(unknown) == pytest.approx(LARGEST_UNKNOWN, abs=0.02)
