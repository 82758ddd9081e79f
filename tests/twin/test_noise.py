"""The noise that a twin is held against is that of the recording in motion."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import (
    CHANNELS,
    Data,
    demand_deg,
    noise_floor,
    noise_in_motion,
    prepare,
    scales,
    traces_of,
    what_is_left,
)
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
NOISE = {FOLLOWING: 0.5, TORQUE: 0.02, LOAD: 7.0}
"""Some ten times the rounding."""


def moves(bench: Exercise) -> None:
    bench.move(400.0, 600.0, 6000.0)
    bench.hold(0.6)
    bench.move(-400.0, 600.0, 6000.0)
    bench.hold(0.6)


@cache
def recorded() -> Data:
    truth = Truth.load(DEMO)
    return prepare(Recording(record_of(truth, moves), axis="demo", ratio=50.0), AxisConfig.load(DEMO), truth)


def noisy(where: str) -> Data:
    """The recording with white noise on each channel, in motion or at rest only."""
    rng = np.random.default_rng(1)
    pieces = []
    for piece in recorded().pieces:
        rows = piece.rest == (1.0 if where == "rest" else 0.0)
        assert 0 < rows.sum() < len(rows)
        measured = {
            name: column + rows * NOISE[name] * rng.standard_normal(len(column))
            for name, column in piece.measured.items()
        }
        pieces.append(replace(piece, measured=measured))
    return replace(recorded(), pieces=tuple(pieces))


def test_a_smooth_replay_is_off_by_as_much_as_is_expected_of_a_drives_steps() -> None:
    """The torque by more than the gain alone would have it, for the motor answers."""
    data = recorded()
    (piece,), (even,), (steps,) = data.pieces, traces_of(data, data.base), traces_of(data, data.base, "loops")
    moves = np.abs(np.gradient(demand_deg(piece.commands, data.axis))) > 0.5
    assert float(np.std((steps[TORQUE] - even[TORQUE])[moves])) == pytest.approx(
        noise_floor(data)[TORQUE], rel=0.1
    )
    # By a whole step, a motor within a step of a count's edge would count against the true values.
    off_deg = float(np.std((steps[FOLLOWING] - even[FOLLOWING])[moves]))
    least = scales(data, {name: np.zeros(len(data.leg)) for name in CHANNELS})
    assert off_deg < least.deviation[FOLLOWING] < 4.0 * off_deg


def test_noise_in_motion_is_found_whatever_the_motion_is() -> None:
    found = noise_in_motion(noisy("motion"))
    for name in CHANNELS:
        assert found[name] == pytest.approx(NOISE[name], rel=0.25), name


def test_noise_at_rest_says_nothing_of_it() -> None:
    assert noise_in_motion(noisy("rest")) == pytest.approx(noise_in_motion(recorded()), rel=0.1)


def test_no_noise_is_less_than_the_rounding() -> None:
    still = [
        replace(each, measured={name: 0.0 * column for name, column in each.measured.items()})
        for each in recorded().pieces
    ]
    assert noise_in_motion(replace(recorded(), pieces=tuple(still))) == noise_floor(recorded())


def test_what_is_left_within_the_noise_of_the_motion_is_explained() -> None:
    data = noisy("motion")
    left = {
        name: np.concatenate(
            [
                (one.measured[name] - other.measured[name]) * one.counts[name]
                for one, other in zip(data.pieces, recorded().pieces, strict=True)
            ]
        )
        for name in CHANNELS
    }
    assert all(each.explained for each in what_is_left(data, left, noise_in_motion(data)))
    some = what_is_left(data, left, noise_floor(data))
    assert {each.channel for each in some if not each.explained} == set(CHANNELS)
