"""The first SYNC of a new loop, or after the bus was down, activates no buffered set-point."""

import errno
from collections.abc import Callable, Iterator
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


def started_again(daemon: SteppedDaemon, away_s: float) -> None:
    daemon.hang(away_s)
    daemon.begin_again()


def bus_down(daemon: SteppedDaemon, away_s: float) -> None:
    daemon.bus.down = errno.ENETDOWN
    daemon.run(0.004 + away_s)
    daemon.bus.down = None


def hung(daemon: SteppedDaemon, away_s: float) -> None:
    daemon.hang(0.012 + away_s)


@every_drive
@pytest.mark.parametrize(
    ("happens", "states"),
    [
        (started_again, {AxisState.UNVERIFIED}),
        (bus_down, {AxisState.LATCHED}),
        (hung, {*AxisState} - {AxisState.ENABLED, AxisState.ENABLING}),
    ],
)
@settings(max_examples=3)
@given(RUNNING_S, AWAY_S)
def test_no_drive_gets_power_without_a_request(
    character: Character,
    happens: Callable[[SteppedDaemon, float], None],
    states: set[AxisState],
    running_s: float,
    away_s: float,
) -> None:
    with moving(character) as (daemon, counts):
        daemon.run(running_s)
        happens(daemon, away_s)
        daemon.run(0.8)
        before = [daemon.motor_counts(axis) for axis in range(2)]
        daemon.run(0.4)
        assert [each.times for each in counts] == [0, 0], "power without a request"
        assert all(abs(daemon.motor_counts(axis) - before[axis]) <= 2 for axis in range(2))
        assert {*daemon.states} <= states
