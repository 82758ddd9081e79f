"""Time-out of tests that wait for another thread or process: a bound for hangs, not a measure of speed."""

import time
from collections.abc import Callable
from typing import Final, TypeVar

PATIENCE_S: Final = 600.0
"""A hundred times the longest wait on an idle computer."""

T = TypeVar("T")


def until(met: Callable[[], T], why: Callable[[], object] = lambda: "it did not come about") -> T:
    """Polls until ``met`` returns something true, and returns it; fails with ``why()`` after `PATIENCE_S`."""
    end_s, pause_s = time.monotonic() + PATIENCE_S, 0.01
    while not (found := met()):
        assert time.monotonic() < end_s, why()
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, 0.25)  # frequent polling would slow down the work it waits for
    return found
