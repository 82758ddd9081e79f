"""Residuals of a replay by channel, and the noise that they are compared with."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from support.demo import AXIS, TRUTH
from support.exercised import record_of

from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import FOLLOWING_ERROR, LOAD_ERROR, compare
from hdbridge.twin.misfit import (
    CHANNELS,
    ChannelResidual,
    Data,
    Values,
    channel_residuals,
    has_memory,
    noise_floor,
    noise_in_motion,
    prepare,
    residuals,
    scales,
    values_of,
)
from hdbridge.twin.parameters import BY_NAME, FOLLOWING, LOAD, TORQUE, free_value, with_values
from hdbridge.twin.replay import replay

ZERO_COUNTS = 45
COUNT_DEG = 360.0 / 8000


def moves(bench: Exercise) -> None:
    for distance in (400.0, -400.0):
        bench.hold(1.2)
        bench.move(distance, 600.0, 6000.0)
    bench.hold(1.2)


@cache
def recorded() -> Recording:
    return Recording(record_of(TRUTH, moves), axis="demo", ratio=50.0)


def with_command_offset(counts: int = ZERO_COUNTS) -> Recording:
    """Returns the recording with a command from a controller whose zero differs from the drive's."""
    columns = recorded().record.columns
    offset = {"motor_target_deg": columns["motor_target_deg"] + counts * COUNT_DEG}
    return Recording(Record({**columns, **offset}), axis="demo", ratio=50.0)


def left(truth: Truth, recording: Recording | None = None) -> dict[str, float]:
    """Returns the rms of the residuals by channel."""
    found = residuals(prepare(recording or recorded(), AXIS, truth), truth)
    return {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in found.items()}


def test_a_command_offset_is_not_a_following_error() -> None:
    assert left(TRUTH, with_command_offset())[FOLLOWING] == pytest.approx(left(TRUTH)[FOLLOWING], rel=0.05)


def test_a_count_is_not_a_zero_offset() -> None:
    """A motor may come to rest one count away from its command; in motion, the same deviation is an ordinary
    following error.
    """
    data = prepare(with_command_offset(1), AXIS, TRUTH)
    assert np.median(residuals(data, TRUTH)[FOLLOWING][data.counts[FOLLOWING]]) == pytest.approx(
        COUNT_DEG, rel=0.3
    )
    # The same holds in a comparison.
    for recording in (recorded(), with_command_offset()):
        row = compare(recording.record, replay(recording, AXIS, TRUTH), (), 50.0).row(FOLLOWING_ERROR)
        assert row is not None
        assert row.difference < 0.1, "motor degrees: two counts"


def test_a_late_motor_does_not_affect_the_load_error() -> None:
    """The load follows the motor: 3 ms at 600 degrees per second are 130 arcsec of load angle."""
    late = with_values(TRUTH, {"servo dead time": 3.0})
    assert left(late)[FOLLOWING] > 10.0 * left(TRUTH)[FOLLOWING]
    assert left(late)[LOAD] < 13.0


@pytest.mark.parametrize(("name", "factor"), [("gear stiffness", 0.5), ("load inertia", 2.0)])
def test_a_wrong_spring_or_load_stays_in_the_load_error(name: str, factor: float) -> None:
    wrong = with_values(TRUTH, {name: factor * free_value(TRUTH, BY_NAME[name])})
    simulated = replay(recorded(), AXIS, wrong)
    row = compare(recorded().record, simulated, (), 50.0).row(LOAD_ERROR)
    assert row is not None
    assert left(wrong)[LOAD] > 0.7 * row.difference
    assert left(wrong)[LOAD] > 3.0 * left(TRUTH)[LOAD]


def test_rest_does_not_scale_residuals_of_motion() -> None:
    """Most of this recording is rest, with hardly any residual."""
    data = prepare(recorded(), AXIS, TRUTH)
    moving = data.moving
    assert moving.mean() < 0.5
    off = residuals(data, with_values(TRUTH, {"servo dead time": 3.0}))
    size = float(np.median(np.abs(off[FOLLOWING][moving])))
    assert scales(data, off).deviation[FOLLOWING] > 1.3 * size


def test_a_small_change_of_a_parameter_changes_the_residuals_by_as_little() -> None:
    """No encoder step interferes, so the slopes of a fit are those of the plant."""
    data = prepare(recorded(), AXIS, TRUTH)
    here = residuals(data, TRUTH)
    inertia = TRUTH.motor.inertia_kg_m2
    moved = []
    for share in (1e-5, 2e-5):
        there = residuals(data, with_values(TRUTH, {"motor inertia": (1.0 + share) * inertia}))
        moved.append(there[TORQUE] - here[TORQUE])
    assert np.linalg.norm(moved[0]) > 0.0
    assert np.linalg.norm(moved[1] - 2.0 * moved[0]) < 0.05 * np.linalg.norm(moved[1])


def test_a_resting_motor_contributes_one_load_residual_and_no_torque() -> None:
    (piece,) = prepare(recorded(), AXIS, TRUTH).pieces
    record = recorded().record
    target, motor = record.motor_target_deg, record.motor_position_deg
    assert target is not None
    rest = np.diff(target, prepend=target[0]) == 0.0
    last = len(record) - 1
    stands = rest & (np.abs(motor - motor[last]) < 0.05) & (record.time_s > record.time_s[last] - 0.9)
    assert stands.any()
    assert not piece.counts[TORQUE][stands].any()
    assert not piece.counts[FOLLOWING][stands].any()
    assert np.flatnonzero(piece.counts[LOAD][stands]).tolist() == [np.count_nonzero(stands) - 1]
    assert piece.counts[TORQUE][~rest & (np.arange(len(record)) > 0.5 * last)].all()


def test_a_motor_sets_out_from_the_torque_that_held_it() -> None:
    """The recording begins at rest, so the replay lacks the motion whose friction holds the axis."""
    stiff = with_values(TRUTH, {"Coulomb friction": 0.1})

    def forward_and_on(bench: Exercise) -> None:
        bench.move(300.0, 600.0, 6000.0)
        bench.hold(0.6)
        bench.move(300.0, 600.0, 6000.0)

    record = record_of(stiff, forward_and_on)
    target = record.motor_target_deg
    assert target is not None
    (rest,) = (row for row, after in pairwise(np.flatnonzero(np.diff(target) != 0.0)) if after - row > 100)
    columns = {name: each[rest + 30 :] for name, each in record.columns.items()}
    for name in ("motor_target_deg", "motor_position_deg"):
        columns[name] = columns[name] - 360.0
    columns["load_position_deg"] = columns["load_position_deg"] - 360.0 / 50.0
    data = prepare(Recording(Record(columns), axis="demo", ratio=50.0), AXIS, stiff)
    (piece,) = data.pieces
    first = int(np.argmin(piece.rest))
    setting_out = slice(first, first + 8)
    assert piece.counts[TORQUE][setting_out].all()
    unheld = replace(data, pieces=(replace(piece, commands=replace(piece.commands, held=())),))
    off, before = (residuals(each, stiff)[TORQUE][setting_out] for each in (data, unheld))
    assert np.max(np.abs(off)) < 0.1 * np.max(np.abs(before))


def test_without_memory_the_load_counts_at_once() -> None:
    plain = with_values(TRUTH, {})
    gear = plain.gear.model_copy(update={"hysteresis": None, "second_hysteresis": None, "backlash_arcsec": 0})
    for truth, at_once in ((TRUTH, False), (plain.model_copy(update={"gear": gear}), True)):
        assert has_memory(truth) is not at_once
        (piece,) = prepare(recorded(), AXIS, truth).pieces
        first = int(np.argmin(piece.rest))
        assert bool(piece.counts[LOAD][first]) is at_once
        assert piece.counts[LOAD][-1]


NOISE = {FOLLOWING: 0.5, TORQUE: 0.02, LOAD: 7.0}
"""About ten times the rounding error of each channel."""


@cache
def as_measured() -> Data:
    return prepare(recorded(), AXIS, TRUTH)


def noisy(where: str) -> Data:
    """Returns the recording with white noise on each channel, in motion or at rest only."""
    rng = np.random.default_rng(1)
    pieces = []
    for piece in as_measured().pieces:
        rows = piece.rest if where == "rest" else ~piece.rest
        assert 0 < rows.sum() < len(rows)
        measured = {
            name: column + rows * NOISE[name] * rng.standard_normal(len(column))
            for name, column in piece.measured.items()
        }
        pieces.append(replace(piece, measured=measured))
    return replace(as_measured(), pieces=tuple(pieces))


def test_noise_in_motion_is_estimated_for_any_motion() -> None:
    assert noise_in_motion(noisy("motion")) == pytest.approx(NOISE, rel=0.25)
    # Noise at rest gives no estimate for motion, and no estimate is below the rounding.
    assert noise_in_motion(noisy("rest")) == pytest.approx(noise_in_motion(as_measured()), rel=0.1)
    still = [
        replace(each, measured={name: 0.0 * column for name, column in each.measured.items()})
        for each in as_measured().pieces
    ]
    assert noise_in_motion(replace(as_measured(), pieces=tuple(still))) == noise_floor(as_measured())


def test_residuals_within_motion_noise_are_explained() -> None:
    data = noisy("motion")
    left = {
        name: np.concatenate(
            [
                (one.measured[name] - other.measured[name]) * one.counts[name]
                for one, other in zip(data.pieces, as_measured().pieces, strict=True)
            ]
        )
        for name in CHANNELS
    }
    every = channel_residuals(data, left, noise_in_motion(data))
    assert {each.channel for each in every if each.explained} == set(CHANNELS)
    some = channel_residuals(data, left, noise_floor(data))
    assert {each.channel for each in some if not each.explained} == set(CHANNELS)


@pytest.mark.parametrize(
    ("times_noise", "scatter", "values"),
    [
        (0.9, 1.5, Values.AXIS),
        (0.9, 16.0, Values.REPLAY),
        (0.9, math.nan, Values.REPLAY),
        (4.0, 1.5, Values.REPLAY),
    ],
)
def test_values_are_the_axis_only_if_explained_and_agreed_by_the_legs(
    times_noise: float, scatter: float, values: Values
) -> None:
    assert values_of([ChannelResidual("motor torque", 0.01, times_noise, "step")], scatter) is values
