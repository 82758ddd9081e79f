"""A long part of a recording is fitted in stretches, some of each kind of motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import coarse, prepare
from hdbridge.twin.replay import stretches

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
CYCLE_S = 0.01
LEGS = (
    Segment(kind="standstill", start_s=0.0, end_s=4.0),
    Segment(kind="sweep", start_s=4.0, end_s=100.0),
    *(Segment(kind="step", start_s=100.0 + 2.0 * k, end_s=102.0 + 2.0 * k) for k in range(15)),
)


def recorded(duration_s: float = 130.0) -> Recording:
    time_s = CYCLE_S * np.arange(round(duration_s / CYCLE_S))
    motor_deg = 90.0 * np.sin(2.0 * np.pi * time_s / 40.0)
    columns = {"time_s": time_s, "motor_target_deg": motor_deg, "motor_position_deg": motor_deg}
    return Recording(Record({**columns, "load_position_deg": motor_deg / 50.0}), LEGS, ratio=50.0)


def test_stretches_are_all_rows_in_order_and_begin_with_legs() -> None:
    record = recorded().record
    cut = stretches(record, LEGS)
    assert np.array_equal(np.concatenate([each.time_s for each in cut]), record.time_s)
    assert all(5.0 <= each.time_s[-1] - each.time_s[0] + CYCLE_S <= 16.0 for each in cut)
    firsts = [float(each.time_s[0]) for each in cut]
    assert [each for each in firsts if each >= 100.0] == pytest.approx([100.0, 106.0, 112.0, 118.0, 124.0])


def test_a_short_part_stays_whole() -> None:
    record = recorded(25.0).record
    assert stretches(record, LEGS) == [record]


def test_a_fit_takes_some_of_each_kind_of_motion() -> None:
    data = prepare(recorded(), AxisConfig.load(DEMO), Truth.load(DEMO))
    taken = coarse(data, 40.0)
    assert taken.duration_s <= 40.0
    assert {"sweep", "step"} <= set(taken.kinds)
    assert data.duration_s > 130.0


def test_a_fit_takes_pieces_of_a_warm_up_at_both_its_ends() -> None:
    record = recorded().record
    warm_c = 20.0 + 0.1 * np.floor(record.time_s)
    warms = Recording(Record({**record.columns, "temperature_c": warm_c}), LEGS, ratio=50.0)
    axis, truth = AxisConfig.load(DEMO), Truth.load(DEMO)
    apart_k = {}
    for name, each in {"untold": recorded(), "told": warms}.items():
        whole, taken = prepare(each, axis, truth), coarse(prepare(each, axis, truth), 60.0)
        begun_c = [20.0 + 0.1 * float(piece.commands.time_s[0]) for piece in taken.pieces]
        apart_k[name] = max(begun_c) - min(begun_c)
        assert whole.duration_s > 130.0
    assert apart_k["untold"] < apart_k["told"]
    assert apart_k["told"] > 11.0


def test_a_stretch_that_begins_in_motion_does_not_rest_in_its_first_row() -> None:
    """This axis never stands; the zero of a command is told by where it does."""
    data = prepare(recorded(), AxisConfig.load(DEMO), Truth.load(DEMO))
    assert len(data.pieces) > 5
    assert not any(each.rest.any() for each in data.pieces)
