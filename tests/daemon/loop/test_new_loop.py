"""The first SYNC of a new loop, or after the bus was down, activates no buffered set-point."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.characters import AWKWARD, INTERPOLATED, RESTLESS, Character, PowerCount, every_character
from support.daemon import SteppedDaemon, stepped_daemon

from hdbridge.daemon.loop.states import AxisState

AWAY_S = st.sampled_from((0.0, 0.004, 0.011, 0.016, 0.03, 0.06, 0.5, 2.0))
RESUMING = (RESTLESS, AWKWARD, INTERPOLATED)
"""Drives that resume whenever they can."""
every_drive = pytest.mark.parametrize(
    "character",
    [*RESUMING, *(pytest.param(each, marks=pytest.mark.slow) for each in every_character())],
    ids=str,
)
RUNNING_S = st.integers(0, 80).map(lambda turns: 0.004 * turns)


@contextmanager
def moving(character: Character) -> Iterator[tuple[SteppedDaemon, list[PowerCount]]]:
    """Two axes in motion."""
    with stepped_daemon(2, character=character) as daemon:
        for axis in range(2):
            daemon.verify(axis)
        for axis in range(2):
            daemon.enable(axis)
            daemon.move(300.0, axis)
        yield daemon, [PowerCount(node) for node in daemon.nodes]


def stays_without_power(daemon: SteppedDaemon, counts: list[PowerCount]) -> None:
    daemon.run(0.8)
    before = [daemon.motor_counts(axis) for axis in range(2)]
    daemon.run(0.4)
    assert [each.times for each in counts] == [0, 0], "power without a request"
    assert all(abs(daemon.motor_counts(axis) - before[axis]) <= 2 for axis in range(2))


@every_drive
@settings(max_examples=3)
@given(RUNNING_S, AWAY_S)
def test_after_another_start_of_the_control_process(
    character: Character, running_s: float, away_s: float
) -> None:
    with moving(character) as (daemon, counts):
        daemon.run(running_s)
        daemon.hang(away_s)
        daemon.begin_again()
        stays_without_power(daemon, counts)
        assert daemon.states == [AxisState.UNVERIFIED] * 2


@every_drive
@settings(max_examples=3)
@given(RUNNING_S, AWAY_S)
def test_after_the_bus_was_down(character: Character, running_s: float, away_s: float) -> None:
    with moving(character) as (daemon, counts):
        daemon.run(running_s)
        daemon.bus.down = errno.ENETDOWN
        daemon.run(0.004 + away_s)
        daemon.bus.down = None
        stays_without_power(daemon, counts)
        assert daemon.states == [AxisState.LATCHED] * 2


@every_drive
@settings(max_examples=3)
@given(RUNNING_S, st.floats(0.012, 1.0))
def test_after_the_control_process_hung(character: Character, running_s: float, away_s: float) -> None:
    with moving(character) as (daemon, counts):
        daemon.run(running_s)
        daemon.hang(away_s)
        stays_without_power(daemon, counts)
        assert not {AxisState.ENABLED, AxisState.ENABLING} & set(daemon.states)
