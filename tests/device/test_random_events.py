"""Random events on the slave: no demand outside the limits, and no motion without a request."""

import pytest
from support.slave_events import play_events


@pytest.mark.parametrize("seed", range(6))
def test_no_demand_outside_the_limits_and_no_motion_without_a_request(seed):
    seen = play_events(seed, 150)
    assert seen.enabled > 3
    assert seen.moved > 20
