"""Virtual time at the pace of real time: never ahead of it; a short delay is caught up, a long one is not."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.errors import InputError
from hdbridge.sim.paced import FORGIVEN_S, PacedClock


class Real:
    """The machine's clock, which the tests move."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def sleep(self, duration_s: float) -> None:
        assert duration_s > 0.0
        self.now_s += duration_s


def paced(speed: float = 1.0) -> tuple[PacedClock, Real]:
    real = Real()
    return PacedClock(50.0, speed, lambda: real.now_s, real.sleep), real


@pytest.mark.parametrize("speed", [0.5, 1.0, 20.0])
def test_time_passes_at_its_speed(speed: float) -> None:
    clock, real = paced(speed)
    for turn in range(1, 101):
        clock.sleep_until(50.0 + 0.004 * turn)
    assert clock.now() == pytest.approx(50.4)
    assert real.now_s - 1000.0 == pytest.approx(0.4 / speed)


def test_a_short_delay_is_caught_up() -> None:
    clock, real = paced()
    clock.sleep_until(50.1)
    real.now_s += 0.5 * FORGIVEN_S
    for turn in range(1, 101):
        clock.sleep_until(50.1 + 0.004 * turn)
    assert real.now_s - 1000.0 == pytest.approx(0.5)


def test_after_a_long_stall_time_continues_without_skipping() -> None:
    clock, real = paced()
    clock.sleep_until(50.1)
    real.now_s += 3600.0
    for turn in range(1, 101):
        clock.sleep_until(50.1 + 0.004 * turn)
        assert clock.now() == pytest.approx(50.1 + 0.004 * turn)
    assert real.now_s - 4600.1 == pytest.approx(0.4, abs=0.005)


@given(st.lists(st.tuples(st.floats(0.0, 0.5), st.floats(0.001, 0.1)), max_size=50))
def test_time_is_never_ahead_of_real_time(turns: list[tuple[float, float]]) -> None:
    clock, real = paced()
    deadline_s = 50.0
    for busy_s, period_s in turns:
        real.now_s += busy_s
        deadline_s += period_s
        clock.sleep_until(deadline_s)
        assert clock.now() - 50.0 <= real.now_s - 1000.0 + 1e-9


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_speed_is_refused(speed: float) -> None:
    with pytest.raises(InputError, match="expected a finite number above 0"):
        PacedClock(0.0, speed)
