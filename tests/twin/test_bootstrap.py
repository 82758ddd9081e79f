"""What rounding does to a fit is taken off it, by simulated recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.bootstrap import unbiased, within
from hdbridge.twin.least_squares import sandwich, solve
from hdbridge.twin.misfit import prepare
from hdbridge.twin.parameters import BY_NAME, coordinates, with_values
from hdbridge.twin.replays import Replays

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS = AxisConfig.load(DEMO)
TRUTH = with_values(Truth.load(DEMO), {"command filter": 1.06})
"""At 90 motor degrees per second the motor is 4.24 counts late: its encoder says 4."""
PARAMETERS = (BY_NAME["command filter"],)


def sweeps(bench: Exercise) -> None:
    """So many whole counts per cycle that the motor's encoder errs alike in every row."""
    bench.hold(0.4)
    bench.move(200.0, 90.0, 3000.0)
    bench.move(-200.0, 90.0, 3000.0)
    bench.hold(0.2)


def test_a_bias_by_rounding_is_taken_off_and_the_truth_is_within_the_intervals() -> None:
    recording = Recording(record_of(TRUTH, sweeps), axis="demo", ratio=50.0)
    true = np.array(coordinates(TRUTH, PARAMETERS))
    with Replays(prepare(recording, AXIS, TRUTH), 1) as replays:
        fitted = solve(replays, TRUTH, PARAMETERS, true, 2)
        told = unbiased(replays, fitted)
    before, after = float(fitted.place[0] - true[0]), float(told.place[0] - true[0])
    assert before < -0.02, "as a share: what the encoder says looks like a shorter lag"
    assert abs(after) < 0.7 * abs(before)
    assert abs(after) < 1.96 * float(np.sqrt(told.covariance[0, 0]))


def test_a_step_along_a_valley_stays_on_its_line_at_a_bound() -> None:
    rng = np.random.default_rng(2)
    low, high = np.array([0.0, -np.inf, -1.0]), np.array([20.0, np.inf, 1.0])
    for _ in range(200):
        place = np.array([rng.choice([0.0, 0.1]), rng.normal(), rng.uniform(-1.0, 1.0)])
        step = rng.standard_normal(3)
        reached = within(place, step, low, high)
        share = (reached - place) / step
        assert np.ptp(share) < 1e-9
        assert np.all((low <= reached) & (reached <= high))
        room = np.concatenate([(high - place) / np.abs(step), (place - low) / np.abs(step)])
        assert abs(share[0]) >= min(1.0, float(np.min(room))) - 1e-9, "as far as one of the two ways allows"


def test_what_slopes_would_still_take_is_no_scatter_of_the_legs() -> None:
    rng = np.random.default_rng(1)
    slopes = rng.standard_normal((600, 1)) + 0.01 * rng.standard_normal((600, 3))  # a valley
    spread, legs = np.full(3, 0.7), np.repeat([0.0, 1.0], 300)
    white = rng.standard_normal(600)
    for left in (white, white + 5.0 * slopes[:, 0]):
        covariance = sandwich(slopes, left, legs, spread)
        least = np.linalg.inv(slopes.T @ slopes + np.diag(spread**-2.0))
        times = np.linalg.eigvals(covariance @ np.linalg.inv(least)).real
        assert np.all(times > 0.9), "never better than by independent residuals"
        assert np.all(times < 8.0), "nor much worse where they are"
        assert np.all(np.linalg.eigvalsh(covariance / 0.49) < 1.0 + 1e-9), "nor than before the fit"
