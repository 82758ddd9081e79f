"""Tests of coloured noise: banded and dense algebra agree, and the parameters of the noise are found."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.legs import Leg, measured

from hdbridge.analysis.blocks import make_blocks
from hdbridge.analysis.identification import outlying, standing_arcsec, usable_samples
from hdbridge.analysis.noise import LOOP_LENGTH, NoiseModel, Precision, fit_noise


def blocks_of(count, rng, motor=None, error=None, kind="sweep"):
    time = np.cumsum(rng.uniform(0.3, 1.0, count))  # longer than a block, so each sample is a block
    motor = np.cumsum(rng.uniform(5.0, 30.0, count)) if motor is None else motor
    error = np.zeros(count) if error is None else error
    segment = Leg(time, motor, motor / 50.0 + error / 3600.0, kind)
    samples = usable_samples(measured([segment]), 50.0, slow_deg_s=1e9)
    return make_blocks(samples), samples


def mixed_blocks(rng, locked):
    """Returns forty blocks on several legs with random reading errors and travels since the last reversal,
    and the travels in loop widths.
    """
    blocks, _ = blocks_of(40, rng)
    legs = np.sort(rng.integers(0, 5, 40))
    crossed = np.sort(rng.uniform(0.0, 3.0, 40))
    locked_arcsec = locked * rng.uniform(size=40)
    return replace(blocks, leg=legs, locked_arcsec=locked_arcsec, since_turn_deg=20.0 * crossed), crossed


@settings(deadline=None, max_examples=15)
@given(
    st.floats(0.2, 3.0), st.floats(0.0, 2.0), st.floats(0.5, 50.0), st.floats(0.0, 2.0), st.floats(1.0, 50.0),
    st.sampled_from([0.0, 0.3]), st.sampled_from([0.0, 2.0]), st.integers(0, 1000),
)  # fmt: skip
def test_the_banded_inverse_is_the_dense_one(white, slow, slow_s, place, place_deg, locked, loop, seed):
    rng = np.random.default_rng(seed)
    blocks, crossed = mixed_blocks(rng, locked)
    legs = blocks.leg
    noise = NoiseModel(white, white, slow, slow_s, place, place_deg, loop, 20.0)
    dense = np.diag(noise.white_variance(blocks))
    for size, length, at in ((slow, slow_s, blocks.time_s), (place, place_deg, blocks.travel_deg)):
        dense += size**2 * np.exp(-np.abs(at[:, np.newaxis] - at) / length)
    dense += np.outer(blocks.locked_arcsec, blocks.locked_arcsec) * (legs[:, np.newaxis] == legs)
    fading = loop / (1.0 + crossed**2)
    dense += (
        np.outer(fading, fading)
        * np.exp(-np.abs(crossed[:, np.newaxis] - crossed) / LOOP_LENGTH)
        * (legs[:, np.newaxis] == legs)
    )
    columns = rng.normal(size=(40, 3))
    precision = Precision(noise, blocks)
    assert precision.apply(columns) == pytest.approx(np.linalg.solve(dense, columns), rel=1e-5, abs=1e-6)
    expected = -0.5 * (np.linalg.slogdet(dense)[1] + columns[:, 0] @ np.linalg.solve(dense, columns[:, 0]))
    assert precision.log_likelihood(columns[:, 0]) == pytest.approx(expected, rel=1e-5, abs=1e-5)


@settings(deadline=None, max_examples=15)
@given(
    st.lists(st.floats(0.2, 3.0), min_size=8, max_size=8), st.sampled_from([0.0, 0.3]), st.booleans(),
    st.integers(0, 1000),
)  # fmt: skip
def test_the_score_is_the_derivative_of_the_likelihood(values, locked, branches, seed):
    rng = np.random.default_rng(seed)
    blocks = replace(mixed_blocks(rng, locked)[0], moving=rng.random(40) < 0.6, blur=0.1 * rng.random(40))
    out, residual = rng.random(40) < 0.2, 2.0 * rng.normal(size=40)
    scale = np.array([1.0, 1.0, 1.0, 5.0, 1.0, 10.0, float(branches), 10.0])

    def precision(logarithms):
        return Precision(NoiseModel(*(scale * np.exp(logarithms)).tolist()), blocks, out)

    at, step = np.log(values), 1e-3 * np.eye(8)
    likelihoods = [[precision(at + s * e).log_likelihood(residual) for s in (1, -1)] for e in step]
    expected = -np.diff(likelihoods)[:, 0] / 2e-3
    assert precision(at).score(residual) == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_excluded_blocks_have_no_influence():
    rng = np.random.default_rng(1)
    blocks, _ = blocks_of(30, rng)
    out = np.zeros(30, dtype=bool)
    out[10:20] = True
    noise = NoiseModel(1.0, 1.0, 0.8, 5.0)
    weighted = Precision(noise, blocks, out).apply(np.where(out, 1e6, 1.0))
    assert weighted[out] == pytest.approx(np.zeros(10))
    assert weighted == pytest.approx(Precision(noise, blocks, out).apply(np.ones(30)))


def test_a_wander_is_found_next_to_white_noise():
    rng = np.random.default_rng(2)
    blocks, samples = blocks_of(6000, rng)
    wander = np.zeros(6000)
    for index in range(1, 6000):
        keep = np.exp(-(samples.time_s[index] - samples.time_s[index - 1]) / 8.0)
        wander[index] = keep * wander[index - 1] + rng.normal() * np.sqrt(1.0 - keep**2)
    noise = fit_noise(wander + 0.5 * rng.normal(size=6000), blocks, 1)
    assert noise.slow_arcsec == pytest.approx(1.0, rel=0.15)
    assert noise.slow_s == pytest.approx(8.0, rel=0.35)
    # Noise with a correlation time shorter than a step is not separable from white noise.
    assert np.hypot(noise.moving_arcsec, noise.place_arcsec) == pytest.approx(0.5, rel=0.15)


def test_a_spike_is_an_outlier_and_a_step_that_stays_is_not():
    rng = np.random.default_rng(4)
    residual = rng.normal(size=5000)
    residual[2500:] += 40.0
    residual[[100, 900, 901]] += 30.0
    calm = np.zeros(5000, dtype=bool)
    weight, outliers = outlying(residual, calm)
    assert set(np.flatnonzero(weight == 0.0)) == {100, 900, 901}
    assert (outliers.samples, outliers.swinging, outliers.longest_run) == (3, 0, 2)
    calm[895:905] = True  # an acceleration
    assert (outlying(residual, calm)[1].swinging, outlying(residual, calm)[1].longest_run) == (2, 1)


def test_blocks_average_a_column_exactly():
    rng = np.random.default_rng(5)
    time = np.arange(4000) / 250.0
    motor = np.concatenate([np.linspace(0.0, 300.0, 2000), np.linspace(300.0, 0.0, 2000)])
    samples = usable_samples(measured([Leg(time, motor, motor / 50.0, "sweep")]), 50.0)
    blocks = make_blocks(samples)
    values = rng.normal(size=4000)
    assert blocks.count @ blocks.mean(values) == pytest.approx(np.sum(values[samples.usable]))
    assert len(blocks) < 1500
    near = (blocks.motor_deg > 292.0) & (blocks.heading < 0)
    assert np.max(blocks.extent_deg[near]) < 0.5 < np.max(blocks.extent_deg)


def test_settling_after_a_reversal_is_excluded_but_not_most_of_the_travel():
    time = np.arange(4000) / 250.0
    up, down = np.linspace(0.0, 60.0, 1600), np.linspace(60.0, 40.0, 1600)
    motor = np.concatenate([up, down, np.tile([38.0, 40.0], 20).repeat(20)])  # then a reversal every 0.08 s
    samples = usable_samples(measured([Leg(time, motor, motor / 50.0, "sweep")]), 50.0, slow_deg_s=1e9)
    assert samples.usable[:1600].all()
    assert np.flatnonzero(~samples.usable[1600:3200]) == pytest.approx(np.arange(1, 26))
    assert np.mean(samples.usable[3200:]) > 0.6


def test_constants_over_a_leg_are_not_motion():
    """A constant reading error of less than a count in each leg shifts a mean by no more than its error."""
    rng = np.random.default_rng(7)
    motor = np.round(np.concatenate([rng.uniform(5.0, 30.0, 50).cumsum() * s for s in (1, -1, 1, -1)]) / 0.09)
    blocks, _ = blocks_of(200, rng, motor * 0.09)
    assert np.all(blocks.locked_arcsec > 0.0)
    ones = np.ones(len(blocks))
    free = Precision(NoiseModel(0.1, 0.1), replace(blocks, locked_arcsec=0.0 * ones))
    assert ones @ Precision(NoiseModel(0.1, 0.1), blocks).apply(ones) < 0.5 * (ones @ free.apply(ones))


def test_a_motor_between_two_counts_is_neither_noise_at_rest_nor_an_outlier():
    rng = np.random.default_rng(6)
    time, count, noise = np.arange(5000) / 250.0, 0.09, 0.5
    position = np.where(rng.random(5000) < 0.05, count, 0.0)  # 6.5 arcsec at the load
    load = rng.normal(size=5000) * noise / 3600.0
    leg = Leg(time, np.zeros(5000), load, "standstill", position_deg=position)
    samples = usable_samples(measured([leg]), 50.0, slow_deg_s=1e9)
    assert samples.count_deg == pytest.approx(count)
    assert standing_arcsec(samples) == pytest.approx(noise, rel=0.05)
    error = samples.error_arcsec
    calm = np.zeros(len(error), dtype=bool)
    assert outlying(error, calm)[1].samples > 100  # as for an encoder of infinite resolution
    assert outlying(error, calm, count / 50.0 * 3600.0)[1].samples == 0


def test_slow_or_unseen_motion_is_not_rest():
    rng = np.random.default_rng(7)
    still = rng.normal(size=(3, 1000)) * 0.5 / 3600.0
    time = np.arange(1000) / 250.0
    creep = np.linspace(0.0, 0.02, 1000)  # a fifth of a count in four seconds, as when a sine reverses
    segments = [
        Leg(time, np.zeros(1000), still[0], "standstill"),
        Leg(time + 60.0, np.full(1000, 90.0), 90.0 / 50.0 + still[1], "standstill"),
        Leg(time + 64.0, 90.0 + creep, (90.0 + creep) / 50.0 + still[2], "sine"),
    ]
    found = standing_arcsec(usable_samples(measured(segments), 50.0, slow_deg_s=1e9))
    assert found == pytest.approx(0.5, rel=0.06)
    rests = standing_arcsec(usable_samples(measured(segments[:2]), 50.0, slow_deg_s=1e9))
    assert found == pytest.approx(rests, rel=1e-9)  # does not contain the creep
