from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from support.characters import FRIENDLY, Character
from support.daemon import SteppedDaemon, stepped_daemon
from support.reliability_daemon import DaemonBench, daemon_bench

from hdbridge.daemon.loop.states import AxisState


@pytest.fixture
def daemon() -> Iterator[SteppedDaemon]:
    """Provides one axis, unverified."""
    with stepped_daemon() as made:
        yield made


@pytest.fixture
def enabled(daemon: SteppedDaemon) -> SteppedDaemon:
    """One axis, enabled at zero."""
    daemon.verify()
    daemon.enable()
    return daemon


@pytest.fixture
def pair() -> Iterator[SteppedDaemon]:
    """Two axes, enabled at zero."""
    with stepped_daemon(2) as made:
        for axis in range(2):
            made.verify(axis)
        for axis in range(2):
            made.enable(axis)
        yield made


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[Character], DaemonBench]]:
    """Reuses the previous test's bench, as a daemon continues after a fault; a new one after a failure."""
    with ExitStack() as stack:
        made: dict[Character, DaemonBench] = {}

        def bench(character: Character) -> DaemonBench:
            known = made.get(character)
            if known is None or any(state is not AxisState.ENABLED for state in known.states):
                folder = tmp_path_factory.mktemp("machine")
                made[character] = stack.enter_context(daemon_bench(folder, character))
            return made[character]

        yield bench


@pytest.fixture
def moving(benches: Callable[[Character], DaemonBench]) -> DaemonBench:
    """Two axes of a daemon with a service, at constant speed; to be left enabled."""
    made = benches(FRIENDLY)
    made.set_off()
    return made
