"""Two clocks drift for a day: no set-point of the other master is lost, and each is one inner cycle late."""

from bisect import bisect_right
from collections import deque
from random import Random

import pytest

from hdbridge.daemon.loop.feeds import OuterFeed
from hdbridge.daemon.memory.layout import OuterKnot
from hdbridge.device.syncclock import SyncClock

DAY_S = 86_400.0


class Knots(deque):
    """Queue of set-points between two processes."""

    def take(self):
        return self.popleft() if self else None


@pytest.mark.parametrize(
    ("begin_s", "duration_s", "inner_s", "outer_s"),
    [
        (0.0, DAY_S, 0.9, 0.9),
        (DAY_S, 60.0, 0.004, 0.004),  # a slip of one cycle takes 20 s
        (DAY_S, 60.0, 0.004, 0.010),
        (DAY_S, 60.0, 0.004, 0.001),
    ],
    ids=["a whole day", "4 and 4 ms", "4 and 10 ms", "4 and 1 ms"],
)
@pytest.mark.parametrize("drift_ppm", [200.0, -200.0])
def test_drift_loses_no_set_point_and_delays_none(begin_s, duration_s, inner_s, outer_s, drift_ppm):
    rng, knots, sync = Random(1), Knots(), SyncClock(outer_s)
    feed = OuterFeed(knots)
    feed.begin(1, 0.1, begin_s, 0.0)
    step_s = outer_s * (1.0 + 1e-6 * drift_ppm)
    sync_s, turn_s, target, worst = begin_s, begin_s, 0.0, 0.0
    times, targets = [begin_s], [0.0]
    knots.append(OuterKnot(1, begin_s, 0.0, 0.0))
    judged = 0
    while turn_s < begin_s + duration_s:
        while sync_s <= turn_s:  # each SYNC is jittered and brings a new target
            sync.take(sync_s + rng.uniform(0.0, 0.02) * outer_s)
            target += rng.uniform(-1.0, 1.0)
            knots.append(OuterKnot(1, sync.time_s + sync.period_s, target, 0.0))
            times.append(sync_s + step_s)
            targets.append(target)
            sync_s += step_s
        place = feed.at(turn_s - inner_s)
        assert place is not None
        at_s = turn_s - inner_s
        if turn_s > begin_s + 200.0 * outer_s:  # the filter of SYNC has settled
            after = bisect_right(times, at_s)
            share = (at_s - times[after - 1]) / (times[after] - times[after - 1])
            expected = targets[after - 1] + share * (targets[after] - targets[after - 1])
            worst = max(worst, abs(place - expected))
            judged += 1
        turn_s += inner_s
    assert judged > 0.9 * (duration_s / inner_s) * (1.0 - 200.0 * outer_s / duration_s)
    # Targets differ by up to 1 in a period: a lost one would show. The rest is jitter of SYNC.
    assert worst < 0.1
