"""Tests of the limits of a record: undetermined terms are reported, not invented."""

from dataclasses import replace

import numpy as np
import pytest
from support.legs import Leg, fit
from typer.testing import CliRunner

from hdbridge.analysis.identification import FitOptions
from hdbridge.axis.effects import Compliance, Hysteresis
from hdbridge.cli import app
from hdbridge.errors import InputError


def test_without_a_reversal_hysteresis_is_left_out(bench):
    axis = bench.axis()
    plan = [("standstill", np.zeros(300)), ("sweep", bench.ramp(0.0, 3600.0, 200.3))]
    result = fit(axis.record(plan), axis.ratio, bench.options)
    assert [each.name for each in result.model.effects] == ["synchronous"]
    assert any("hysteresis: left out" in each and "both directions" in each for each in result.warnings)
    found = {each.order.number: each.amplitude_arcsec for each in result.orders}
    assert found == pytest.approx({1: 5.0, 2: 9.0, 6: 3.0}, abs=0.15)


def test_a_stepping_test_determines_the_offset_but_not_the_shape(bench):
    axis = bench.axis(noise=1.0)
    plan = []
    places = [*range(1, 61), *range(59, -1, -1)]
    for before, index in zip([0, *places[:-1]], places, strict=True):
        plan += [
            ("step", bench.ramp(before * 43.56, index * 43.56, 600.0)),
            ("settle", np.full(25, index * 43.56)),
        ]
    held = Hysteresis(offset_arcsec=1.0, width_deg=25.0, exponent=1.5)
    result = fit(axis.record(plan), axis.ratio, replace(bench.options, effects=(held,)))
    assert any("cannot be identified" in each and "nested reversals" in each for each in result.warnings)
    width = result.interval("hysteresis", "width_deg")
    assert (width.value, width.identifiable) == (25.0, False)
    assert width.low <= 0.5
    assert width.high >= 120.0
    assert result.interval("hysteresis", "offset_arcsec").value == pytest.approx(40.0, rel=0.02)


def test_one_speed_does_not_determine_a_delay(bench):
    axis = bench.axis()
    plan = [("sweep", bench.ramp(0.0, 3600.0, 200.3)), ("sweep", bench.ramp(3600.0, 0.0, 200.3))]
    result = fit(axis.record(plan), axis.ratio, bench.options)
    assert any("one millisecond would be" in each and "second speed" in each for each in result.warnings)
    assert not any(each.name == "delay_ms" for each in result.nuisances)


def test_a_short_record_reports_the_missing_load_turn(bench):
    axis = bench.axis()
    result = fit(axis.record(bench.plan(turns=8.0)), axis.ratio, bench.options)
    assert any("0.4" in each and "load turns" in each for each in result.warnings)


def test_an_effect_without_its_channel_is_omitted_with_a_note(bench):
    axis = bench.axis()
    effects = (*bench.options.effects, Compliance.candidate(axis.ratio))
    result = fit(axis.record(bench.plan(turns=8.0)), axis.ratio, replace(bench.options, effects=effects))
    assert any("compliance: not fitted, the record has no load_torque_nm" in each for each in result.warnings)


@pytest.mark.parametrize(
    ("servo_deg", "oscillates"),
    [
        (lambda time_s: 0.6 * np.sin(np.pi * 60.0 * time_s), True),
        (lambda time_s: 0.2 * np.sin(np.pi * 24.0 * time_s) * (np.sin(time_s) > -0.5), True),
        (lambda time_s: np.where(np.cos(0.25 * time_s) > 0.0, -0.4, 0.4), False),
        (lambda time_s: 0.02 * np.random.default_rng(3).normal(size=len(time_s)), False),
    ],
    ids=["oscillating", "most of the time", "lagging", "flickering"],
)
def test_a_motor_that_oscillates_about_its_command_is_reported(tmp_path, servo_deg, oscillates):
    time_s, count_deg = np.arange(4_000) / 200.0, 360.0 / 10_000
    target_deg = 400.0 * np.sin(0.25 * time_s)
    motor_deg = target_deg + servo_deg(time_s)
    error_deg = (8.0 * np.cos(np.deg2rad(2.0 * motor_deg)) + 20.0 * np.sign(np.cos(0.25 * time_s))) / 3600.0
    columns = {
        "time_s": time_s,
        "motor_position_deg": np.round(motor_deg / count_deg) * count_deg,
        "load_position_deg": motor_deg / 100.0 + error_deg,
        "motor_target_deg": target_deg,
    }
    rows = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=",".join(columns), comments="", fmt="%.7f")
    done = CliRunner().invoke(app, ["fit", str(tmp_path / "a.csv"), "--ratio", "100"])
    assert done.exit_code == 0, done.output
    assert ("oscillates about its command" in " ".join(done.output.split())) == oscillates


def test_noise_alone_yields_no_order(bench):
    axis = bench.axis(orders={}, offset=0.0, noise=2.0)
    axis.error = lambda motor, state=1.0: np.zeros(len(motor))
    result = fit(axis.record(bench.plan(turns=8.0)), axis.ratio, bench.options)
    assert result.orders == ()
    assert not result.held_out.improves


def test_an_insignificant_order_is_not_included(bench):
    axis = bench.axis(orders={1: (5.0, 0.0), 4: (0.05, 0.0)}, noise=0.2)
    result = fit(axis.record(bench.plan()), axis.ratio, bench.options)
    assert [each.order.number for each in result.orders] == [1]


def segment(**changes):
    time = np.arange(400) / 50.0
    motor = 100.0 * time
    whole = {
        "time_s": time,
        "motor_deg": motor,
        "load_deg": motor / 20.0,
        "kind": "sweep",
    }
    return Leg(**(whole | changes))


@pytest.mark.parametrize(
    ("make", "ratio", "complaint"),
    [
        (
            lambda: segment(load_deg=np.full(400, np.nan)),
            20.0,
            r"a\.csv: sample 0: load_position_deg: nan; expected a finite number",
        ),
        (
            lambda: segment(time_s=np.arange(400)[::-1] / 50.0),
            20.0,
            r"a\.csv: sample 1: time_s: .* expected times that do not decrease",
        ),
        (segment, 21.0, r"a\.csv: the motor makes 20 turns per turn of the load .*; expected a ratio of 21"),
        (segment, -20.0, "ratio"),
        (lambda: segment(load_deg=-np.arange(400) / 10.0), 20.0, "reverse the direction of one encoder"),
    ],
)
def test_bad_input_is_refused_in_one_line(make, ratio, complaint):
    with pytest.raises(InputError, match=complaint) as caught:
        fit([make()], ratio, name="a.csv")
    assert "\n" not in str(caught.value)


def test_a_record_of_nothing_but_fast_moves_is_refused():
    time = np.arange(400) / 50.0
    with pytest.raises(InputError, match="slow enough to be used"):
        fit([segment(kind="step", time_s=time)], 20.0, FitOptions())


def test_hardly_any_samples_are_refused():
    few = {name: np.arange(4) / 50.0 for name in ("time_s", "motor_deg", "load_deg")}
    with pytest.raises(InputError, match="expected at least"):
        fit([segment(**few)], 20.0)


@pytest.mark.parametrize(("unit_deg", "turns"), [(57.29578, 10.0), (360.0, 4.0)])
def test_a_wrong_unit_of_both_angles_shows_in_the_travel(bench, unit_deg, turns):
    axis = bench.axis()
    record = [
        replace(each, motor_deg=each.motor_deg / unit_deg, load_deg=each.load_deg / unit_deg)
        for each in axis.record(bench.plan(turns=turns))
    ]
    try:
        said = " ".join(fit(record, axis.ratio, bench.options).warnings)
    except InputError as problem:
        said = str(problem)
    assert "both angles are in radians or turns: convert them to degrees" in said
