"""Tests that fits recover the parameters of synthetic axes, with the right uncertainty."""

from dataclasses import replace

import numpy as np
import pytest
from support.legs import Leg, fit

from hdbridge.analysis.identification import FitOptions
from hdbridge.axis.effects import Start
from hdbridge.axis.model import TransmissionModel


def off(result, effect, parameter, true):
    """Returns the error of a fitted parameter in half widths of its interval."""
    found = result.interval(effect, parameter)
    return abs(found.value - true) / found.half_width


def test_every_parameter_of_an_axis_is_found_within_its_interval(standard, bench):
    axis = bench.axis()
    assert {each.order.number for each in standard.orders} == set(axis.orders)
    assert off(standard, "hysteresis", "offset_arcsec", axis.offset) < 2.0
    assert off(standard, "hysteresis", "width_deg", axis.width) < 2.0
    assert off(standard, "hysteresis", "exponent", axis.exponent) < 2.0
    for order, (amplitude, phase) in axis.orders.items():
        assert off(standard, "synchronous", f"orders[{order}].amplitude_arcsec", amplitude) < 2.0
        assert off(standard, "synchronous", f"orders[{order}].phase_deg", phase) < 2.0


def test_intervals_are_narrow_enough_to_be_useful(standard):
    assert standard.interval("hysteresis", "offset_arcsec").half_width < 0.4
    assert standard.interval("hysteresis", "width_deg").half_width < 0.04 * 18.0
    assert standard.interval("hysteresis", "exponent").half_width < 0.04
    assert standard.interval("synchronous", "orders[6].amplitude_arcsec").half_width < 0.1


def test_the_residual_is_the_noise_and_no_more(standard):
    assert standard.noise.residual_arcsec == pytest.approx(0.5, rel=0.05)
    assert standard.noise.standing_arcsec == pytest.approx(0.5, rel=0.1)
    assert standard.residual_tests
    assert all(each.passed for each in standard.residual_tests), standard.residual_tests


def test_the_fitted_model_goes_through_its_file_with_its_uncertainty(standard):
    again = TransmissionModel.from_text(standard.model.dump())
    assert again.effects == standard.model.effects
    assert again.uncertainty == standard.model.uncertainty
    orders = again.uncertainty["synchronous"]["orders"]
    assert [each["order"] for each in orders] == [1, 2, 6]
    assert all(0.0 < each["amplitude_arcsec"] < 0.2 for each in orders)


def test_held_out_data_speak_for_the_new_model_against_none(standard):
    assert standard.held_out.improves
    assert standard.held_out.gain.before_arcsec > 20.0
    assert standard.held_out.gain.after_arcsec == pytest.approx(0.5, rel=0.1)


def test_sines_without_names_are_divided_between_the_folds(bench):
    end = 360.0 * 50.0
    rest = np.zeros(50)
    legs = [rest, bench.ramp(0.0, end, 617.3), end + rest, bench.ramp(end, 0.0, 617.3), rest]
    for amplitude in (5.0, 15.0, 40.0, 120.0):
        legs += [amplitude * np.sin(0.2 * np.pi * np.arange(1000) / bench.rate_hz), rest]
    motor = np.concatenate(legs)
    loop = np.full(len(motor), -1.0)
    for at, step in enumerate(np.diff(motor), 1):  # exponential approach, which the model's law lacks
        loop[at] = (
            np.sign(step) - (np.sign(step) - loop[at - 1]) * np.exp(-abs(step) / 8.0)
            if step
            else loop[at - 1]
        )
    noise = np.random.default_rng(1).normal(0.0, 0.4, len(motor))
    error = 14.0 * np.cos(np.deg2rad(2.0 * motor)) + 30.0 * loop + noise
    leg = Leg(np.arange(len(motor)) / bench.rate_hz, motor, motor / 50.0 + error / 3600.0)
    result = fit([leg], 50.0)
    assert result.held_out.improves, result.held_out.text


def test_an_unchanged_axis_gets_no_new_model(bench):
    axis = bench.axis(motor_counts=8000.0, behind_counts=0.15)
    first = fit(axis.record(bench.plan(turns=6.0)), axis.ratio, bench.options)
    again = fit(
        axis.record(bench.plan(turns=6.0), seed=1), axis.ratio, replace(bench.options, active=first.model)
    )
    assert not again.held_out.improves, again.held_out.text


@pytest.mark.parametrize(
    ("width", "exponent"),
    [
        (7.0, 2.0),
        pytest.param(35.0, 2.6, marks=pytest.mark.slow),
        pytest.param(30.0, 1.25, marks=pytest.mark.slow),
    ],
)
def test_shapes_far_from_a_typical_one_are_found(bench, width, exponent):
    axis = bench.axis(width=width, exponent=exponent)
    result = fit(axis.record(bench.plan(turns=8.0)), axis.ratio, bench.options)
    assert result.interval("hysteresis", "width_deg").value == pytest.approx(width, rel=0.04)
    assert result.interval("hysteresis", "exponent").value == pytest.approx(exponent, abs=0.05)
    assert result.interval("hysteresis", "offset_arcsec").value == pytest.approx(40.0, rel=0.01)


def test_an_unknown_elastic_state_is_estimated(bench):
    plan = [
        ("reversal", bench.ramp(0.0, 6.0, 3.0)),
        ("standstill", np.full(200, 6.0)),
        *bench.plan(turns=3.0),
    ]
    segments = bench.axis(noise=0.5).record(plan, state=-1.0)
    known, found = (
        fit(segments, 20.0, replace(bench.options, start=start)).noise.residual_arcsec
        for start in (Start.BACKWARD, None)
    )
    assert known == pytest.approx(0.5, rel=0.1)
    assert found == pytest.approx(known, rel=1e-3)


def test_a_load_order_biases_nothing_and_is_reported(bench):
    axis = bench.axis(load_first=15.0)
    result = fit(axis.record(bench.plan(turns=40.0)), axis.ratio, bench.options)
    assert off(result, "hysteresis", "offset_arcsec", axis.offset) < 2.0
    load = next(each for each in result.nuisances if each.name == "load order 1")
    assert load.value == pytest.approx(15.0, abs=0.3)
    assert any("load order 1 is visible" in each for each in result.warnings)


def test_recordings_with_zeros_of_their_own(bench):
    axis = bench.axis()
    one = axis.record(bench.plan(turns=5.0), seed=1)
    other = bench.axis(zero_arcsec=-300.0).record(bench.plan(turns=5.0), seed=2)
    other = [replace(each, zero=1, time_s=each.time_s + 1000.0) for each in other]
    result = fit([*one, *other], axis.ratio, replace(bench.options, start=None))
    assert len(result.zeros_arcsec) == 2
    assert off(result, "hysteresis", "offset_arcsec", axis.offset) < 2.0
    assert result.noise.residual_arcsec == pytest.approx(0.5, rel=0.1)


def test_a_measured_motor_angle_that_chatters_does_as_well(bench):
    axis = bench.axis(motor_counts=8000.0)
    rng = np.random.default_rng(3)
    segments = []
    for each in axis.record(bench.plan(turns=8.0)):
        flutter = rng.choice([-1.0, 0.0, 1.0], len(each), p=[0.05, 0.9, 0.05]) * 360.0 / 8000.0
        segments.append(Leg(each.time_s, each.motor_deg + flutter, each.load_deg, each.kind, commanded=False))
    result = fit(segments, axis.ratio, bench.options)
    assert result.interval("hysteresis", "offset_arcsec").value == pytest.approx(40.0, rel=0.03)
    assert result.interval("hysteresis", "width_deg").value == pytest.approx(18.0, rel=0.06)


def test_spikes_are_left_out_and_counted(standard, bench):
    axis = bench.axis()
    rng = np.random.default_rng(4)
    segments = []
    for each in axis.record(bench.plan()):
        spikes = (rng.random(len(each)) < 0.005) * rng.choice([-60.0, 90.0], len(each))
        segments.append(replace(each, load_deg=each.load_deg + spikes / 3600.0))
    result = fit(segments, axis.ratio, bench.options)
    total = sum(len(each) for each in segments)
    assert result.outliers.samples == pytest.approx(0.005 * total, rel=0.4)
    assert any("stand out" in each for each in result.warnings)
    drawn = result.traces
    assert np.max(np.abs(drawn.error_arcsec - drawn.predicted_arcsec)) < 20.0  # traces omit outliers
    for name in ("offset_arcsec", "width_deg", "exponent"):
        clean, spiked = standard.interval("hysteresis", name), result.interval("hysteresis", name)
        assert abs(spiked.value - clean.value) < clean.half_width
        assert spiked.half_width < 1.5 * clean.half_width


def test_encoder_delay_is_separated_from_the_offset(bench):
    axis = bench.axis()
    segments = axis.record(bench.plan())
    motor = np.concatenate([each.motor_deg for each in segments])
    time = np.concatenate([each.time_s for each in segments])
    late = np.interp(time - 0.002, time, motor)
    error = axis.error(late) + np.random.default_rng(5).normal(size=len(motor)) * 0.5
    load, at, delayed = late / axis.ratio + error / 3600.0, 0, []
    for each in segments:
        delayed.append(replace(each, load_deg=load[at : at + len(each)]))
        at += len(each)
    result = fit(delayed, axis.ratio, bench.options)
    delay = next(each for each in result.nuisances if each.name == "delay_ms")
    assert delay.value == pytest.approx(2.0, abs=0.05)
    assert result.interval("hysteresis", "offset_arcsec").value == pytest.approx(40.0, rel=0.01)


def test_a_load_that_cannot_follow_a_reversal_biases_no_loop(bench):
    """Just after each reversal, the hysteresis changes faster than a compliant load can follow."""
    axis = bench.axis(noise=0.2)
    segments = []
    for each in axis.record(bench.plan()):
        motor = each.motor_deg
        first = np.argmax(motor != motor[0])
        behind = -2.0 * np.sign(motor[first] - motor[0]) * (np.arange(len(motor)) < 0.08 * bench.rate_hz)
        segments.append(replace(each, load_deg=each.load_deg + behind * (each.kind == "reversal") / 3600.0))
    result = fit(segments, axis.ratio, bench.options)
    assert off(result, "hysteresis", "offset_arcsec", axis.offset) < 1.5
    assert off(result, "hysteresis", "width_deg", axis.width) < 1.5
    assert off(result, "hysteresis", "exponent", axis.exponent) < 1.5


def test_a_load_that_swings_raises_and_shifts_no_orders(bench):
    """In sweeps at two speeds, each order is amplified and delayed as by a damped resonance at 16 Hz."""
    axis = bench.axis(orders={1: (5.0, -120.0), 6: (8.0, 100.0)}, noise=0.2)
    segments = []
    for each in axis.record(
        [
            *bench.plan(turns=20.0, speed=100.7),
            ("sweep", bench.ramp(0.0, 1800.0, 40.3)),
            ("sweep", bench.ramp(1800.0, 0.0, 40.3)),
        ]
    ):
        if each.kind not in {"sweep", "sine"}:
            segments.append(each)
            continue
        rate = np.gradient(np.deg2rad(each.motor_deg), each.time_s)
        swing = np.zeros(len(each))
        for order, (amplitude, phase) in axis.orders.items():
            angle, share = (
                order * np.deg2rad(each.motor_deg) + np.deg2rad(phase),
                order * rate / (32.0 * np.pi),
            )
            swing += amplitude * (share**2 * np.cos(angle) + 2.0 * 0.2 * share**3 * np.sin(angle))
        segments.append(replace(each, load_deg=each.load_deg + swing / 3600.0))
    result = fit(segments, axis.ratio, bench.options)
    found = {each.order.number: each.amplitude_arcsec for each in result.orders}
    assert found == pytest.approx({1: 5.0, 6: 8.0}, abs=0.03)
    natural_ms2 = 1e6 / (2.0 * np.pi * 16.0) ** 2
    swing = next(each for each in result.nuisances if each.name == "swing_ms2")
    assert swing.value == pytest.approx(natural_ms2, rel=0.2)
    for order, (amplitude, phase) in axis.orders.items():
        assert off(result, "synchronous", f"orders[{order}].amplitude_arcsec", amplitude) < 1.5
        assert off(result, "synchronous", f"orders[{order}].phase_deg", phase) < 1.5


def test_default_options_suit_a_bare_record(bench):
    axis = bench.axis()
    parts = axis.record(bench.plan(turns=8.0))
    whole = Leg(
        np.concatenate([each.time_s for each in parts]),
        np.concatenate([each.motor_deg for each in parts]),
        np.concatenate([each.load_deg for each in parts]),
    )
    result = fit([whole], axis.ratio, FitOptions())
    assert result.interval("hysteresis", "offset_arcsec").value == pytest.approx(40.0, rel=0.01)
    assert result.interval("hysteresis", "width_deg").value == pytest.approx(18.0, rel=0.04)
    assert {each.order.number for each in result.orders} == {1, 2, 6}


def test_a_load_that_lags_is_fitted_as_well_as_one_that_leads(bench):
    """With friction at the load, the hysteresis loop is that of an elastic gear with the opposite sign."""
    axis = bench.axis(offset=-30.0)
    found = fit(axis.record(bench.plan(turns=8.0)), axis.ratio, bench.options)
    assert off(found, "hysteresis", "offset_arcsec", -30.0) < 2.0
    assert off(found, "hysteresis", "width_deg", axis.width) < 2.0
    assert {each.order.number for each in found.orders} == set(axis.orders)
    assert found.interval("synchronous", "orders[6].amplitude_arcsec").half_width < 0.2
    assert found.noise.residual_arcsec == pytest.approx(0.5, rel=0.1)


def test_reversals_between_two_samples_bias_no_parameter_of_the_loop(bench):
    """If every fifth point of the path is sampled, a reversal may lie 0.4 deg beyond the nearest sample."""
    axis, every = bench.axis(width=10.0, noise=0.1, motor_counts=3e6), 5
    legs = [
        ("sweep", bench.ramp(0.0, 1440.0, 200.3 / every)),
        ("sweep", bench.ramp(1440.0, 0.0, 200.3 / every)),
    ]
    for depth in (3.0, 5.0, 8.0, 12.0, 16.0):
        for begin, to in ((0.0, -60.0), (-60.0, 0.0), (0.0, -depth), (-depth, -depth / 2), (-depth / 2, 0.0)):
            legs.append(("reversal", bench.ramp(begin, to, 40.3 / every)))
    segments, at = [], 0
    for each in axis.record(legs):
        kept = slice(-at % every, None, every)
        time_s, motor_deg, load_deg = each.time_s[kept] / every, each.motor_deg[kept], each.load_deg[kept]
        segments.append(Leg(time_s, motor_deg, load_deg, each.kind))
        at += len(each)
    result = fit(segments, axis.ratio, bench.options)
    assert off(result, "hysteresis", "offset_arcsec", axis.offset) < 2.0
    assert off(result, "hysteresis", "width_deg", axis.width) < 2.0
    assert off(result, "hysteresis", "exponent", axis.exponent) < 2.0
    assert result.interval("hysteresis", "width_deg").half_width < 0.3


def test_a_lag_of_counts_that_varies_with_speed_biases_no_parameter_of_the_loop(bench):
    """The motor lags its reading by up to a quarter of a count, periodically over speed (200 counts/s)."""
    axis, count = bench.axis(motor_counts=8000.0), 360.0 / 8000.0
    plan = [*bench.plan(turns=8.0), *bench.plan(turns=8.0, speed=61.7)[1:3]]
    speed = np.gradient(np.concatenate([each for _, each in plan])) * bench.rate_hz
    behind = 0.25 * count * np.sin(2 * np.pi * np.abs(speed) / count / 200.0) * np.sign(speed)
    segments, at = [], 0
    for each in axis.record(plan):
        lag, at = behind[at : at + len(each)], at + len(each)
        segments.append(replace(each, load_deg=each.load_deg - lag / axis.ratio))
    result = fit(segments, axis.ratio, bench.options)
    assert off(result, "hysteresis", "offset_arcsec", axis.offset) < 1.2
    assert off(result, "hysteresis", "width_deg", axis.width) < 1.2
    assert off(result, "hysteresis", "exponent", axis.exponent) < 1.2
