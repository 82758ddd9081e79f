"""Waits of tests for other threads and processes, with a time-out that detects hangs, not slowness."""

import time
from collections.abc import Callable
from typing import Final, TypeVar

PATIENCE_S: Final = 600.0
"""Time-out, s: a hundred times the longest wait on an idle computer."""

T = TypeVar("T")


def until(met: Callable[[], T], why: Callable[[], object] = lambda: "it did not come about") -> T:
    """Polls ``met`` until it returns a true value, and returns it; fails with ``why()`` on a time-out."""
    end_s, pause_s = time.monotonic() + PATIENCE_S, 0.01
    while not (found := met()):
        assert time.monotonic() < end_s, why()
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, 0.25)  # frequent polling would slow down the work that is waited for
    return found
