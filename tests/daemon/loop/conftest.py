from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.daemon import SteppedDaemon, stepped_daemon


@pytest.fixture
def daemon() -> Iterator[SteppedDaemon]:
    """One axis, unverified."""
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
