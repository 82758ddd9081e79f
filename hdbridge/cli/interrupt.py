"""Ctrl-C requests a controlled stop: the control cycle ends its period and stops the axis first."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defers signals to end: within the block they only set a flag, which the yielded function reports.

    A closed terminal (SIGHUP) or SIGQUIT thus also stops the axis in an orderly way. A signal that was
    ignored from the start (`nohup`) stays ignored. The third signal interrupts at once.
    """
    wishes = 0

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal wishes
        wishes += 1
        if wishes >= 3:  # the user insists: end even if something hangs
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
