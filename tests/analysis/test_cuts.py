"""Concatenated records and invalid readings."""

from __future__ import annotations

import numpy as np
import pytest

from hdbridge.analysis.cuts import observed
from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.scales import Scales
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration import identify
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording

RATIO = 20.0


def sweeps(seed: int = 1, begin_deg: float = 0.0, turns: float = 3.0, offset: float = 20.0) -> Record:
    """Two sweeps each way at 100 Hz on an axis with three orders and a hysteresis loop."""
    rng = np.random.default_rng(seed)
    way = np.concatenate([np.zeros(60), np.arange(1.0, turns * 360.0, 2.0)])
    motor = begin_deg + np.concatenate([way, way[::-1], way, way[::-1]])
    radians = np.radians(motor)
    steps = np.sign(np.diff(motor, prepend=motor[0] - 1.0))
    last = np.maximum.accumulate(np.where(steps != 0, np.arange(len(steps)), 0))
    forward = steps[last] > 0
    error = 5 * np.cos(radians - 2.1) + 9 * np.cos(2 * radians) + 3 * np.cos(6 * radians + 1)
    travel = np.cumsum(np.abs(np.diff(motor, prepend=motor[0])))
    turned = np.maximum.accumulate(np.where(np.diff(forward, prepend=True), travel, -100.0))
    settled = np.where(forward, 1.0, -1.0) * (1.0 - 2.0 * np.exp(-(travel - turned) / 5.0))
    error = error + offset * settled + 0.3 * rng.normal(size=len(motor))
    time_s = 0.01 * np.arange(len(motor))
    return Record(
        {
            "time_s": time_s,
            "motor_position_deg": motor,
            "load_position_deg": motor / RATIO + error / 3600.0 + 7.0,
        }
    )


def spoilt(record: Record, row: int, **values: float) -> Record:
    columns = {name: column.copy() for name, column in record.columns.items()}
    for name, value in values.items():
        columns[name][row] = value
    return Record(columns, record.source)


@pytest.mark.parametrize("names", [["load"], ["motor"], ["load", "motor"]])
@pytest.mark.parametrize("row", [0, 700, 701, -1])
def test_zero_readings_are_dropped_and_reported(names: list[str], row: int) -> None:
    record = sweeps(begin_deg=500.0)
    bad = spoilt(record, row, **{f"{each}_position_deg": 0.0 for each in names})
    seen = observed(bad, RATIO)
    assert len(seen.record) == len(record) - 1
    assert "1 of" in seen.remarks[0]
    assert "misread" in seen.remarks[0]


def test_a_single_zero_reading_does_not_remove_an_order_from_the_fit() -> None:
    record = sweeps(begin_deg=500.0)
    clean = identify([Recording(record)], RATIO)
    found = identify([Recording(spoilt(record, 700, load_position_deg=0.0))], RATIO)
    assert {each.order.number for each in found.orders} == {each.order.number for each in clean.orders}
    assert {1, 2, 6} <= {each.order.number for each in found.orders}
    assert any("misread" in each for each in found.warnings)


@pytest.mark.parametrize("tick_s", [0.02, 0.025, 0.07])
def test_coarse_time_stamps_are_interpolated_and_reported(tick_s: float) -> None:
    record = sweeps()
    ticks = tick_s * np.floor(record.time_s / tick_s + 1e-9)
    seen = observed(Record({**record.columns, "time_s": ticks}), RATIO)
    assert np.all(np.diff(seen.record.time_s) > 0.0)
    assert np.max(np.abs(seen.record.time_s - record.time_s)) <= 0.01
    assert seen.cuts == ()
    assert "coarser" in seen.remarks[0]


def test_samples_taken_twice_stay_as_they_are() -> None:
    record = sweeps()
    twice = Record({name: np.repeat(column, 2) for name, column in record.columns.items()})
    assert observed(twice, RATIO).record is twice


def test_normal_motion_is_neither_cut_nor_dropped() -> None:
    record = sweeps()
    seen = observed(record, RATIO)
    assert seen.record is record
    assert seen.remarks == seen.cuts == ()
    # Steps of a fast axis and lost counts are real behaviour of the axis.
    steps = np.repeat(np.arange(40) * 43.56, 10)
    columns = {
        "time_s": 0.05 * np.arange(len(steps)),
        "motor_position_deg": steps,
        "load_position_deg": steps / RATIO + (np.arange(len(steps)) > 200) * 0.1,
    }
    assert observed(Record(columns), RATIO).remarks == ()


def test_an_impossible_jump_is_a_cut_not_a_reversal() -> None:
    """The joint of two one-way moves is a jump of 1,876 motor degrees in 10 ms."""
    parts = [sweeps(begin_deg=begin).rows(60, 560) for begin in (0.0, -876.0)]
    joined = concatenate(parts)
    one_file = Record(joined.columns)
    seen = observed(one_file, RATIO)
    assert seen.record.starts == (0, 500)
    assert seen.cuts == (500,)
    assert "nothing is known of the axis between" in seen.remarks[0]
    found = diagnose(one_file, TransmissionModel(RATIO, ()))
    assert any("too few reversals" in each for each in found.remarks)
    assert all(each.probability <= 0.6 for each in found.findings if each.cause != "unexplained")


def test_settling_across_files_is_not_a_reversal() -> None:
    parts = []
    for begin in (0.0, 40.0, 80.0):
        part = sweeps(begin_deg=begin).rows(0, 600)
        motor = part.motor_position_deg.copy()
        motor[-40:] = motor[-41] + 0.07 * np.exp(-np.arange(40) / 8.0) * np.cos(np.arange(40) / 3.0)
        load = part.load_position_deg.copy()
        load[-40:] = load[-41]
        parts.append(Record({**part.columns, "motor_position_deg": motor, "load_position_deg": load}))
    found = diagnose(concatenate(parts), TransmissionModel(RATIO, ()), independent_zeros=True)
    assert any("too few reversals" in each for each in found.remarks)
    most = Scales().one_way_repeated
    assert all(each.probability <= most for each in found.findings if each.cause != "unexplained")


def test_motor_and_flexspline_orders_are_aliases_on_short_travel() -> None:
    model = TransmissionModel.from_text(
        "schema: hdbridge.model/1\nratio: 20\neffects:\n  - effect: synchronous\n    parameters:\n"
        "      orders: [{order: 1, amplitude_arcsec: 5, phase_deg: -120.3}, "
        "{order: 6, amplitude_arcsec: 3, phase_deg: 57.3}]\n"
        "  - effect: hysteresis\n    parameters: {offset_arcsec: 20, width_deg: 18, exponent: 1.6}\n"
    )
    for turns, apart in ((1.5, False), (9.0, True)):  # order 2 shifts by 0.15 of a period, or by 0.9
        found = diagnose(sweeps(turns=turns), model).findings
        (order,) = (each for each in found if each.cause in ("motor_order", "flexspline_order"))
        assert ("flexspline_order" in (order.cause, *order.aliases)) != apart


def test_a_model_without_hysteresis_must_be_fitted_first() -> None:
    for offset in (30.0, -30.0):
        found = diagnose(sweeps(offset=offset, turns=2.0), TransmissionModel(RATIO, ()))
        said = next(each for each in found.remarks if "no elastic loop" in each)
        assert "fit a model first (hdbridge fit)" in said
        assert float(said.split("one of ")[1].split(" arcsec")[0]) == pytest.approx(30.0, rel=0.1)
        unknown = [each for each in found.findings if each.cause == "unexplained"]
        assert unknown
        assert all("fit a model first" in each.experiment for each in unknown)


def test_torque_beyond_the_range_of_an_effect_is_reported() -> None:
    model = TransmissionModel.from_text(
        "schema: hdbridge.model/1\nratio: 20\neffects:\n  - effect: compliance\n    parameters: "
        "{c1_arcsec_per_nm: 1, c2_arcsec_per_nm: 1, c3_arcsec_per_nm: 1, torque1_nm: 1, torque2_nm: 2, "
        "limit_nm: 50}\n"
    )
    record = sweeps()
    torque = 80.0 * np.sin(0.01 * np.arange(len(record)))
    found = diagnose(Record({**record.columns, "load_torque_nm": torque}), model)
    assert any("load_torque_nm reaches 80 Nm, beyond the limit_nm of 50" in each for each in found.remarks)


@pytest.mark.parametrize("cut", [False, True])
def test_command_worsens_nothing_if_a_record_ends_in_motion(cut: bool) -> None:
    """The motor rests, then follows its command with a lag; the record ends in motion."""
    time_s = 0.01 * np.arange(110)
    gone = np.maximum(time_s - 0.3, 0.0)
    command = 713.7 * gone**2
    motor = 713.7 * np.maximum(time_s - 0.3317, 0.0) ** 2
    error = 20.0 * np.cos(np.radians(2 * motor)) + 0.2 * np.random.default_rng(1).normal(size=len(motor))
    columns = {
        "time_s": time_s,
        "motor_position_deg": motor,
        "load_position_deg": motor / 100.0 + error / 3600.0,
    }
    record = Record(columns)
    commanded = Record({**columns, "motor_target_deg": command})
    if cut:
        record, commanded = (each.rows(0, 80) for each in (record, commanded))
    orders = TransmissionModel.from_text(
        "schema: hdbridge.model/1\nratio: 100\neffects:\n  - effect: synchronous\n    parameters:\n"
        "      orders: [{order: 2, amplitude_arcsec: 20, phase_deg: 0}]\n"
    )
    without, with_command = (diagnose(each, orders) for each in (record, commanded))
    assert with_command.baseline.rms_arcsec < 1.05 * without.baseline.rms_arcsec
    assert [each.cause for each in with_command.findings] == [each.cause for each in without.findings] == []
