"""What rounding does to a fit is taken off it, by simulated recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.bootstrap import unbiased
from hdbridge.twin.least_squares import solve
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
