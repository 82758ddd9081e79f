"""The clock of a service with simulated drives, and the service on a computer that is busy."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.daemon.service.timing import CREDIT_S, HANG_S, STEP_S, SimulatedClock

PERIOD_S = 0.004


class Computer:
    """Real time, and a loop that runs a cycle whenever it is given processor time."""

    def __init__(self):
        self.real_s, self.turns = 1000.0, 7
        self.clock = SimulatedClock(lambda: self.turns, PERIOD_S, lambda: self.real_s)

    def go_on(self, duration_s, turns):
        self.real_s += duration_s
        self.turns += turns
        return self.clock.now()


@given(st.lists(st.tuples(st.floats(0.0, 0.05), st.integers(0, 20)), max_size=200))
def test_clock_is_no_faster_than_the_loop_or_real_time(steps):
    computer = Computer()
    begin_s, last_s, real_s, loop_s, idle_s = 1000.0, 1000.0, 1000.0, 0.0, 0.0
    for duration_s, turns in steps:
        now_s = computer.go_on(duration_s, turns)
        real_s, loop_s = real_s + duration_s, loop_s + turns * PERIOD_S
        idle_s = 0.0 if turns else idle_s + duration_s
        assert last_s <= now_s <= real_s + 1e-9
        if idle_s < HANG_S:
            assert now_s - begin_s <= loop_s + CREDIT_S + 1e-9
        last_s = now_s


@pytest.mark.parametrize(("share", "expected_s"), [(0.1, 6.0), (1.0, 60.0), (10.0, 60.0)])
def test_clock_keeps_up_with_the_slower_of_loop_and_real_time(share, expected_s):
    computer = Computer()
    for step in range(15_000):
        now_s = computer.go_on(0.004, int((step + 1) * share) - int(step * share))
    assert now_s - 1000.0 == pytest.approx(expected_s, abs=CREDIT_S + PERIOD_S)


def test_a_hanging_loop_lets_real_time_pass():
    computer = Computer()
    for _ in range(int(HANG_S / 0.05) + 200):
        now_s = computer.go_on(0.05, 0)
    assert now_s - 1000.0 == pytest.approx(10.0 + CREDIT_S, abs=0.1)


def test_a_stalled_service_advances_by_one_step():
    computer = Computer()
    assert computer.go_on(3600.0, 0) - 1000.0 == pytest.approx(STEP_S)
