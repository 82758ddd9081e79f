"""Comparison by channel of two records of the same commands, and the verdict on a twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.bare_axis import truth
from support.demo import TRUTH
from support.exercised import record_of

from hdbridge.errors import InputError
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Segment
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import (
    ALL,
    SETTLED_ARCSEC,
    SETTLED_NOISE,
    Comparison,
    Row,
    compare,
    overshoot_arcsec,
    scatter_s,
    settling_s,
)
from hdbridge.twin.twin import HELD_OUT, better

N = 50.0


def row_of(compared: Comparison, channel: str, kind: str = ALL) -> Row:
    """Returns the figure of a channel that both records have."""
    row = compared.row(channel, kind)
    assert row is not None
    return row


def steps_and_a_sweep(bench: Exercise) -> None:
    bench.hold(0.3)
    for distance in (400.0, -250.0, 300.0, -450.0):
        bench.move(distance, 800.0, 40_000.0)
        bench.hold(0.6)
    bench.move(360.0, 120.0, 1000.0)
    bench.hold(0.5)


def legs_of(record: Record) -> tuple[Segment, ...]:
    end = float(record.time_s[-1])
    return (
        Segment(kind="step", start_s=0.0, end_s=end - 4.1),
        Segment(kind="sweep", start_s=end - 4.0, end_s=end),
    )


@pytest.fixture(scope="module")
def measured() -> Record:
    return record_of(TRUTH, steps_and_a_sweep)


def against(measured: Record, known: Truth) -> Comparison:
    return compare(measured, record_of(known, steps_and_a_sweep, seed=1), legs_of(measured), N)


def test_the_same_axis_differs_by_its_noise(measured: Record) -> None:
    comparison = against(measured, TRUTH)
    figures = comparison.as_dict()["figures"]
    assert {each["kind"] for each in figures} == {ALL, "step", "sweep"}
    assert all(np.isfinite(each["difference"]) for each in figures)
    for channel in ("load_error", "following_error", "motor_torque"):
        for kind in (ALL, "step", "sweep"):
            row = row_of(comparison, channel, kind)
            assert row.difference <= 2.0 * row.noise
    settling = row_of(comparison, "settling_time")
    assert settling.count == 5
    assert settling.difference <= 2.0 * settling.noise
    at_rest = row_of(comparison, "noise_at_rest:load_error")
    # Noise of the load encoder (0.3 arcsec) and its count (0.45 arcsec).
    assert at_rest.measured == pytest.approx(np.hypot(0.3, 0.45 / np.sqrt(12.0)), rel=0.2)


def test_more_friction_shows_in_the_torque(measured: Record) -> None:
    comparison = against(measured, truth("demo", motor__coulomb_nm=0.068))
    row = row_of(comparison, "motor_torque")
    # 0.034 Nm in motion, and the torque of the integral at rest.
    assert 0.015 < row.difference < 0.045
    assert row.in_noise > 10.0
    assert row_of(comparison, "load_error", "sweep").difference < 1.5


def test_temperature_is_compared_if_its_resolution_allows(measured: Record) -> None:
    warm_c = 20.0 + 0.1 * np.floor(measured.time_s)
    theirs, ours = (Record({**measured.columns, "temperature_c": each}) for each in (warm_c, warm_c + 0.07))
    compared = compare(theirs, ours, legs_of(measured), N)
    row = row_of(compared, "temperature")
    assert row.noise == pytest.approx(0.1)
    assert row.difference == pytest.approx(0.07)
    assert "temperature" not in compared.spectra
    same = Record({**measured.columns, "temperature_c": np.full(len(measured), 20.0)})
    assert compare(same, ours, legs_of(measured), N).row("temperature") is None


def test_a_softer_spring_settles_later_and_beyond(measured: Record) -> None:
    comparison = against(
        measured, truth("demo", gear__stiffness_nm_per_rad=7000.0, gear__damping_nm_s_per_rad=6.0)
    )
    for name in ("settling_time", "overshoot"):
        row = row_of(comparison, name)
        assert row.simulated > 1.5 * row.measured, name
    spectrum = comparison.spectra["load_error"]
    peak_hz = spectrum.frequency_hz[np.argmax(spectrum.difference * (spectrum.frequency_hz > 10.0))]
    assert peak_hz == pytest.approx(np.sqrt(7000.0 / 0.25) / (2.0 * np.pi), rel=0.15)


@pytest.mark.parametrize("creeps_deg", [0.0, 0.3])
def test_holding_torque_is_not_a_difference(measured: Record, creeps_deg: float) -> None:
    """Friction holds the motor at any torque in a range; it depends on the past, not on later creep."""
    target, time_s = measured.motor_target_deg, measured.time_s
    assert target is not None
    moved = np.diff(target, prepend=target[0]) != 0.0
    rested_s = time_s - np.maximum.accumulate(np.where(moved, time_s, -np.inf))
    stuck, later = rested_s > 0.25, np.append(moved[1:], True)
    motor = measured.motor_position_deg + creeps_deg * (stuck & later)
    torque = measured.columns["motor_torque_nm"]
    crept = Record({**measured.columns, "motor_position_deg": motor})
    held = Record({**crept.columns, "motor_torque_nm": torque + 0.03 * stuck})
    row = row_of(compare(crept, held, (), N), "motor_torque")
    assert row.difference == 0.0
    assert 0 < row.count <= len(measured) - np.count_nonzero(stuck)


def test_different_zeros_of_parts_are_not_a_difference(measured: Record) -> None:
    twice = concatenate([measured, measured])
    load = twice.load_position_deg.copy()
    load[twice.starts[1] :] += 0.5
    shifted = Record({**twice.columns, "load_position_deg": load}, starts=twice.starts)
    assert row_of(compare(shifted, twice, (), N), "load_error").difference < 1e-6


def test_records_of_other_rows_are_refused(measured: Record) -> None:
    with pytest.raises(InputError, match="one for one"):
        compare(measured, measured.rows(0, 100), (), N)
    bare = Record({name: column for name, column in measured.columns.items() if name != "motor_target_deg"})
    with pytest.raises(InputError, match="motor_target_deg"):
        compare(bare, bare, (), N)


TIME_S = np.arange(250) * 0.004
HZ, DECAY_S = 20.0, 0.15
RINGING = 40.0 * np.exp(-TIME_S / DECAY_S) * np.cos(2.0 * np.pi * HZ * TIME_S)


def test_a_load_that_rings_has_settled_where_it_swings_by_no_more_than_the_band() -> None:
    found = settling_s(TIME_S, RINGING, 0.0, 10.0)
    assert found == pytest.approx(DECAY_S * math.log(40.0 / 10.0), abs=0.025)
    assert settling_s(TIME_S, 0.2 * RINGING, 0.0, 10.0) == 0.0


def test_noise_scatters_it_as_stated_without_bias() -> None:
    noise = 2.0
    band = max(SETTLED_ARCSEC, SETTLED_NOISE * noise)
    true = settling_s(TIME_S, RINGING, 0.0, band)
    rng = np.random.default_rng(5)
    off = [
        settling_s(TIME_S, RINGING + noise * rng.standard_normal(250), noise, band) - true for _ in range(60)
    ]
    said = scatter_s(TIME_S, RINGING, 0.0, band, (noise, 0.0))
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(said, rel=0.4)
    assert abs(np.mean(off)) < 0.6 * said
    assert scatter_s(TIME_S, RINGING, 0.0, band, (0.0, 0.0)) == 0.0


def test_overshoot_is_in_the_direction_of_the_motion() -> None:
    assert overshoot_arcsec(RINGING, 1.0) == pytest.approx(40.0, abs=0.5)
    assert overshoot_arcsec(RINGING, -1.0) == pytest.approx(40.0 * math.exp(-0.025 / DECAY_S), rel=0.05)


UNITS = {"load_error": "arcsec", "following_error": "motor deg", "motor_torque": "Nm", "temperature": "K"}


def comparison(kind: str = HELD_OUT, **differences: float) -> Comparison:
    rows = [Row(name, kind, UNITS[name], 10.0, 10.0, value, 0.1, 100) for name, value in differences.items()]
    return Comparison(tuple(rows), {}, {})


@pytest.mark.parametrize(
    ("kind", "was", "now", "kept", "says"),
    [
        (HELD_OUT, {"load_error": 4.0, "motor_torque": 1.0}, {"load_error": 1.0, "motor_torque": 1.0}, True,
         "that the fit has not seen the differences from the axis are 50 % smaller"),
        (ALL, {"load_error": 4.0}, {"load_error": 1.0}, True, "that it was fitted to"),
        (HELD_OUT, {"load_error": 4.0, "motor_torque": 1.0}, {"load_error": 1.0, "motor_torque": 1.2}, False,
         "motor torque differs by 1.2 Nm, before by 1"),
        (HELD_OUT, {"load_error": 4.0}, {"load_error": 4.0}, False, "not smaller than before"),
        # An increase below the noise is ignored.
        (HELD_OUT, {"load_error": 4.0, "motor_torque": 0.02}, {"load_error": 1.0, "motor_torque": 0.04}, True,
         "29 % smaller"),
        # A replay of the true axis has rounding errors and residuals of reversals in third differences.
        (HELD_OUT, {"motor_torque": 0.08}, {"motor_torque": 0.02}, True, "75 % smaller"),
    ],
)  # fmt: skip
def test_a_twin_is_kept_if_better_on_average_and_worse_in_nothing(
    kind: str, was: dict[str, float], now: dict[str, float], kept: bool, says: str
) -> None:
    gain = better(comparison(kind, **was), comparison(kind, **now))
    assert gain.kept is kept
    assert says in gain.text


def test_a_temperature_counts_beyond_the_step_of_its_reading() -> None:
    """Temperature differences below the reading's step of 0.1 K count as 0.1 K."""
    cold, near = comparison(load_error=4.0, temperature=0.05), comparison(load_error=1.0, temperature=0.09)
    assert "75 % smaller" in better(cold, near).text
    far = comparison(load_error=1.0, temperature=0.4)
    assert "temperature differs by 0.4 K, before by 0.05" in better(cold, far).text
    # Both fall to a quarter: the temperature difference falls from 0.4 K to below the step of 0.1 K.
    assert "75 % smaller" in better(comparison(load_error=4.0, temperature=0.4), near).text
