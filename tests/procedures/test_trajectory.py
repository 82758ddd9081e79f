"""User trajectories: refusals before any motion, and execution."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge import Bench, InputError, Trajectory, TransmissionModel, simulated
from hdbridge.axis import AxisConfig
from hdbridge.files.profile import bundled_profile
from hdbridge.motion.procedures.moves import AxisView, MotionLimits
from hdbridge.motion.procedures.rehearsal import rehearse

AXIS = AxisView(50.0, MotionLimits(-90.0, 90.0, 20.0, 200.0, 4000.0))


def rounded(time_s):
    """A jerk-limited move of ten degrees: speed 9.4 deg/s, acceleration 14.8 deg/s2."""
    share = min(time_s / 2.0, 1.0)
    return 10.0 * (share - math.sin(2.0 * math.pi * share) / (2.0 * math.pi))


def path_of(trajectory):
    moves = trajectory.moves(AXIS)
    next(moves)
    return moves.send([]).path(float(trajectory.load_deg[0]), AXIS.limits)


def test_a_function_is_followed_exactly():
    path = path_of(Trajectory.of(rounded, 2.0))
    assert path.duration_s == pytest.approx(2.0)
    at = np.linspace(0.0, 2.0, 777)
    assert np.allclose([path.at(each) for each in at], [rounded(each) for each in at], atol=1e-7)
    assert path.at(3.0) == pytest.approx(10.0)


def test_set_points_are_met():
    points = [rounded(0.02 * number) for number in range(101)]
    path = path_of(Trajectory(points, period_s=0.02))
    assert np.allclose([path.at(0.02 * number) for number in range(101)], points)


@pytest.mark.parametrize(
    ("trajectory", "complaint"),
    [
        (
            lambda: Trajectory.of(lambda t: 30.0 * rounded(t / 2.0), 4.0),
            r"needs 150 deg/s at (1.999|2) s; the axis file allows 20 .limits.velocity_deg_s.: nothing",
        ),
        (lambda: Trajectory.of(lambda t: 5.0 * t, 2.0), "limits.acceleration_deg_s2"),
        (lambda: Trajectory.of(lambda t: 10.0 * (1.0 - math.cos(t)), 6.0), "limits.(acceleration|jerk)"),
        (lambda: Trajectory.of(lambda t: 10.0 * rounded(t / 10.0), 20.0), "would move the load to 100 deg"),
        (lambda: Trajectory([0.0, math.nan, 1.0], 0.1), "nan at 0.1 s; expected finite"),
        (lambda: Trajectory([0.0], 0.1), "at least two load angles"),
        (lambda: Trajectory([0.0, 1.0], 0.0), "expected more than 0"),
        (lambda: Trajectory.of(rounded, -1.0), "duration of the trajectory is"),
    ],
)
def test_an_invalid_trajectory_is_refused_before_anything_moves(trajectory, complaint):
    with pytest.raises(InputError, match=complaint):
        rehearse(trajectory(), AXIS)


@given(st.floats(-80.0, 80.0), st.floats(-80.0, 80.0), st.floats(1.0, 1.5))
def test_a_trajectory_within_the_limits_is_accepted(start_deg, end_deg, slower):
    """Differences over a millisecond never exceed the derivatives."""
    way = abs(end_deg - start_deg) or 1.0
    # Peaks of a rounded move over travel w in time t: 2 w/t, 2 pi w/t2, 4 pi2 w/t3.
    time_s = slower * max(
        2 * way / 20.0, (2 * math.pi * way / 200.0) ** 0.5, (4 * math.pi**2 * way / 4000.0) ** (1 / 3)
    )

    def path(t):
        return start_deg + (end_deg - start_deg) * rounded(2.0 * t / time_s) / 10.0

    rehearse(Trajectory.of(path, time_s), AXIS)


def test_the_axis_follows_the_trajectory_and_reports_the_error():
    profile = bundled_profile("article")
    axis = AxisConfig.load(profile)
    with simulated(axis) as drive:
        drive.boot()
        run = Bench(drive, TransmissionModel.load(profile / "model.yaml")).run(Trajectory.of(rounded, 2.0))
    assert [each.kind for each in run.segments] == ["move", "trajectory", "settle"]
    assert run.record.load_position_deg[-1] == pytest.approx(10.0, abs=0.01)
    assert 0.0 < run.outcome.rms_arcsec < run.outcome.largest_arcsec < 1000.0
