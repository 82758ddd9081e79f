"""Ctrl-C as a wish, not a shot: the control cycle ends its period, stops the axis, and only then gives up."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Within the block a signal to end only sets a flag, which the yielded function tells.

    So a terminal that is closed (SIGHUP) stops the axis in order, as does SIGQUIT. What is ignored from the
    start (`nohup`) stays ignored.
    """
    wishes = 0

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal wishes
        wishes += 1
        if wishes >= 3:  # somebody insists: whatever hangs shall end
            raise KeyboardInterrupt

    before = {
        each: signal.signal(each, note)
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
        if each is signal.SIGINT or signal.getsignal(each) is not signal.SIG_IGN
    }
    try:
        yield lambda: wishes > 0
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
