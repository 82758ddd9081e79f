"""A rounded reading says that the axis was within its count, and no more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import solve
from hdbridge.twin.misfit import Replays, deviation, expected, prepare, rooted
from hdbridge.twin.parameters import BY_NAME, coordinates, with_values

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS = AxisConfig.load(DEMO)
TRUTH = with_values(Truth.load(DEMO), {"command filter": 1.06})
"""At 90 motor degrees per second the motor is 4.24 counts late: its encoder says 4."""
PARAMETERS = (BY_NAME["command filter"],)


def sweeps(bench: Exercise) -> None:
    """So many whole counts per cycle that the motor's encoder errs alike in every row."""
    bench.hold(0.4)
    for speed_deg_s in (90.0, -90.0):
        bench.lead(lambda seconds, speed=speed_deg_s: speed * seconds, 4.0)
    bench.hold(0.2)


def test_rounding_leads_a_fit_astray_that_takes_it_for_noise_and_no_other() -> None:
    recording = Recording(record_of(TRUTH, sweeps), axis="demo", ratio=50.0)
    true = np.array(coordinates(TRUTH, PARAMETERS))
    data = prepare(recording, AXIS, TRUTH)
    with Replays(data, 1) as replays:
        plain = solve(replays, TRUTH, PARAMETERS, true, 2, known=expected(data))
        fitted = solve(replays, plain.truth, PARAMETERS, true, 8)
    (astray,), (off,) = plain.place - true, fitted.place - true
    assert abs(astray) > 2.0 * float(np.sqrt(plain.covariance[0, 0]))
    assert abs(off) < 0.2 * abs(astray)
    assert abs(off) < 1.96 * float(np.sqrt(fitted.covariance[0, 0]))


@pytest.mark.parametrize("half", [0.0, 0.01, 0.3, 4.0])
@pytest.mark.parametrize("stray", [0.0, 1e-4])
def test_half_the_squares_are_the_loss_of_log_likelihood(half: float, stray: float) -> None:
    if half == 0.0:
        stray = 0.0  # without steps: least squares
    off = np.array([-7.0, -3.9, -0.2, 0.0, 0.05, 1.0, 4.1, 6.0])
    halves, strays = np.full(8, half), np.full(8, stray)

    def loss(off: np.ndarray) -> np.ndarray:
        if half == 0.0:
            return np.asarray(0.5 * off**2)
        size = np.abs(off)
        return -np.log(ndtr(half - size) - ndtr(-half - size) + stray)

    root, slope = rooted(off, halves, strays)
    assert 0.5 * root**2 == pytest.approx(loss(off) - loss(np.zeros(8)), rel=1e-6, abs=1e-9)
    assert np.all(np.sign(root) == np.sign(off))
    ahead, behind = (rooted(off + by, halves, strays)[0] for by in (1e-5, -1e-5))
    assert slope == pytest.approx((ahead - behind) / 2e-5, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("spread", [0.02, 0.1, 0.5, 2.0])
def test_readings_in_steps_show_how_far_a_simulation_is_off(spread: float) -> None:
    rng = np.random.default_rng(0)
    angle = rng.uniform(-100.0, 100.0, 4000)
    read = np.round(angle + spread * rng.standard_normal(4000))
    read[:60] += 20.0 * rng.standard_normal(60)  # some are nowhere near
    found, _ = deviation(read - angle, 1.0, 0.004)
    assert found == pytest.approx(spread, rel=0.15)


def test_what_a_reading_is_known_to_be_off_by_is_no_deviation_of_the_others() -> None:
    """A third of the readings are of a motor that sticks: where it breaks away no replay can tell."""
    rng = np.random.default_rng(3)
    spread = np.where(np.arange(6000) % 3, 0.0, rng.uniform(0.0, 0.2, 6000))
    off = rng.normal(0.0, np.hypot(0.01, spread)) + rng.uniform(-0.01, 0.01, 6000)
    alone, _ = deviation(off, 0.02, 1e-4)
    told, _ = deviation(off, 0.02, 1e-4, spread)
    assert alone > 0.015
    assert told == pytest.approx(0.01, rel=0.1)
