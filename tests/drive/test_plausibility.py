"""Limits of the movement in one cycle, and of the following error."""

import pytest

from hdbridge.axis import AxisConfig
from hdbridge.drive.plausibility import Plausibility


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_encoder_may_move_as_far_as_the_axis_can(build_axis, direction, sign):
    """In 4 ms at 1.5 times 20 deg/s, 0.12 deg of the load; for vibration, 0.05 deg and two counts more."""
    axis = build_axis(motor_encoder__direction=direction, load_encoder__direction=direction)
    limits = Plausibility.of(axis)
    for cycles, load, motor in ((1, 400 + 2 + 960, 190), (2, 400 + 2 + 2 * 960, 324)):
        assert limits.jump(sign * motor, sign * load, cycles) is None
        assert "load encoder" in str(limits.jump(0, sign * (load + 1), cycles))
        assert "motor encoder" in str(limits.jump(sign * (motor + 1), 0, cycles))


def test_the_following_error_is_limited_in_both_directions(axis: AxisConfig) -> None:
    """5 deg of the motor at 8,000 counts per turn."""
    limits = Plausibility.of(axis)
    for sign in (1, -1):
        assert limits.lag(sign * 111) is None
        assert "allowed are 111" in str(limits.lag(sign * 112))
