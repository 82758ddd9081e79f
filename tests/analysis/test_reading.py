"""Resolution of an angle and its number of reversals, for records from any program."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.driving import kinematics, reversals
from hdbridge.analysis.readings import reading_of

COUNTS = [8000, 2**14, 2**17, 2**20]


def bench(rng: np.random.Generator) -> np.ndarray:
    """Sweeps, sines and small reversals with rests between them, in motor degrees at 50 Hz."""
    ramp = np.linspace(0.0, 7300.0, 1500)
    time_s = np.arange(1500) / 50.0
    sines = [a * np.sin(2.0 * np.pi * time_s / 10.0) for a in (180.0, 45.0, 5.0)]
    stairs = np.concatenate([np.linspace(0, d, 60) for d in (-4.0, 4.0, -2.0, 2.0)])
    way = np.concatenate([ramp, ramp[::-1], *sines, stairs, np.full(500, stairs[-1])])
    return way + 0.01 * rng.random()


def kept(angle: np.ndarray, digits: int) -> np.ndarray:
    """Rounds values to this number of significant digits, as in a file."""
    return np.array([float(f"{each:.{digits}g}") for each in angle.tolist()])


def turns(measured: np.ndarray, target: np.ndarray | None) -> int:
    reading = reading_of(measured)
    time_s = np.arange(len(measured)) / 50.0
    return reversals(kinematics(measured, target, time_s, reading)[0], reading.jitter_deg)


@settings(deadline=None, max_examples=25)
@given(
    counts=st.sampled_from(COUNTS),
    digits=st.integers(7, 17),
    home_deg=st.floats(-20_000.0, 20_000.0),
    noise=st.sampled_from([0.0, 0.5]),
    commanded=st.booleans(),
)
def test_reversal_count_is_independent_of_digits_counts_and_home(
    counts: int, digits: int, home_deg: float, noise: float, commanded: bool
) -> None:
    rng = np.random.default_rng(1)
    true, count = bench(rng), 360.0 / counts
    read = np.round(true / count + noise * rng.normal(size=len(true))) * count + home_deg
    target = kept(true + home_deg, digits) if commanded else None
    assert turns(kept(read, digits), target) == turns(true, None) == 24


@pytest.mark.parametrize("counts", COUNTS[:3])
@pytest.mark.parametrize("digits", [9, 10, 12, 17])
def test_encoder_count_is_found_despite_rounded_digits(counts: int, digits: int) -> None:
    count = 360.0 / counts
    read = kept(np.round(bench(np.random.default_rng(2)) / count) * count + 4321.0, digits)
    assert reading_of(read).count_deg == pytest.approx(count, rel=1e-4)


RAMPS = st.lists(st.integers(-40, 40), min_size=3, max_size=12)
"""Speeds of successive ramps, in a common unit."""


def ramps(speeds: list[int], step_deg: float, samples: int) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.repeat(speeds, samples) * step_deg)])


def trapezoids(speeds: list[int], step_deg: float, samples: int) -> np.ndarray:
    """Moves with constant acceleration between the speeds, from rest to rest."""
    changes = [np.linspace(a, b, samples) for a, b in pairwise([0, *speeds, 0])]
    return np.concatenate([[0.0], np.cumsum(np.concatenate(changes)) * step_deg])


@settings(deadline=None)
@given(
    speeds=RAMPS,
    step_deg=st.sampled_from([0.08, 7.2, 1 / 3]),
    samples=st.integers(40, 300),
    path=st.sampled_from([ramps, trapezoids]),
    digits=st.integers(8, 17),
)
def test_an_exact_path_has_no_count(
    speeds: list[int], step_deg: float, samples: int, path: Callable[..., np.ndarray], digits: int
) -> None:
    count = reading_of(kept(path(speeds, step_deg, samples), digits)).count_deg
    assert count < 2e-3  # at most the digits of the file


@settings(deadline=None)
@given(amplitude_deg=st.floats(1.0, 1000.0), period=st.integers(40, 2000), phase=st.floats(0.0, 6.0))
def test_an_exact_sine_has_no_count(amplitude_deg: float, period: int, phase: float) -> None:
    sine = amplitude_deg * np.sin(2.0 * np.pi * np.arange(4000) / period + phase)
    assert reading_of(sine).count_deg == 0.0


@settings(deadline=None)
@given(
    speeds=RAMPS,
    offset=st.floats(0.1, 0.9),
    samples=st.integers(40, 300),
    path=st.sampled_from([ramps, trapezoids]),
    counts=st.sampled_from(COUNTS[:3]),
)
def test_a_rounded_path_has_its_count(
    speeds: list[int], offset: float, samples: int, path: Callable[..., np.ndarray], counts: int
) -> None:
    """The speeds are not whole counts per sample, which would not show the size of a count."""
    count = 360.0 / counts
    true = path([speed + offset for speed in speeds], count, samples)
    assert reading_of(np.round(true / count) * count).count_deg == pytest.approx(count, rel=1e-6)


@settings(deadline=None)
@given(speed=st.integers(1, 200), rise=st.integers(60, 300), counts=st.sampled_from(COUNTS[:3]))
def test_a_sweep_at_whole_counts_per_sample_has_its_count(speed: int, rise: int, counts: int) -> None:
    """Only the beginnings and ends of the sweeps show the size of a count."""
    count = 360.0 / counts
    rising = speed * 0.5 * (1.0 - np.cos(np.pi * np.arange(rise) / rise))
    sweep = np.concatenate([rising, np.full(2000, float(speed)), rising[::-1]])
    true = np.cumsum(np.concatenate([sweep, -sweep, sweep]))
    assert reading_of(np.round(true) * count).count_deg == pytest.approx(count, rel=1e-6)


@settings(deadline=None)
@given(
    amplitude=st.floats(3.0, 3000.0),
    period=st.integers(40, 2000),
    phase=st.floats(0.0, 6.0),
    counts=st.sampled_from(COUNTS[:3]),
)
def test_a_rounded_sine_has_its_count(amplitude: float, period: int, phase: float, counts: int) -> None:
    """The sine's period is not a whole number of samples; otherwise, the same few changes would repeat."""
    count = 360.0 / counts
    sine = amplitude * np.sin(2.0 * np.pi * np.arange(4000) / (period + 0.3719) + phase)
    assert reading_of(np.round(sine) * count).count_deg == pytest.approx(count, rel=1e-6)


@pytest.mark.parametrize("noise_deg", [0.0, 0.002, 0.05])
def test_without_a_visible_count_jitter_gives_the_resolution(noise_deg: float) -> None:
    rng = np.random.default_rng(3)
    true = bench(rng)
    reading = reading_of(true + noise_deg * rng.normal(size=len(true)))
    assert reading.count_deg == 0.0
    assert reading.jitter_deg == pytest.approx(noise_deg, rel=0.15, abs=1e-4)


def test_settling_within_the_narrowest_loop_is_not_a_reversal() -> None:
    settles = np.concatenate([np.linspace(0.0, 360.0, 200), [360.07, 360.0, 360.05], np.full(20, 360.0)])
    assert reversals(settles, 0.0) == 0
    back = np.concatenate([settles, np.linspace(360.0, 359.0, 20)])
    assert reversals(back, 0.0) == 1


def test_curved_motion_between_samples_is_not_jitter() -> None:
    """Fast moves at 14 Hz, with rests in which the reading flickers by a third of a count."""
    rng = np.random.default_rng(4)
    angle = np.repeat(np.cumsum(rng.choice([-90.0, 90.0], 120)), 8) + np.tile([-50.0, *[0.0] * 7], 120)
    counted = np.round(angle / 0.018 + 0.33 * rng.normal(size=len(angle))) * 0.018
    assert reading_of(counted).jitter_deg == pytest.approx(0.018 * np.hypot(0.33, 0.29), rel=0.3)
