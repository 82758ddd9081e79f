"""What a process can do for a punctual loop: no garbage collection, real-time priority, memory kept in RAM.

Everything is put back on the way out. What the system does not permit is reported, not insisted on: the
loop then runs with what it got, and its lateness histogram tells how well.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

_MCL_CURRENT, _MCL_FUTURE = 1, 2
PRIORITY: Final = 50
"""SCHED_FIFO priority: above ordinary work, below the kernel's own interrupt threads (50 on PREEMPT_RT)."""

SWITCH_INTERVAL_S: Final = 0.0002


@dataclass(frozen=True, slots=True)
class Realtime:
    """What was obtained; a reason where it was not."""

    scheduling: str | None
    """None when the thread has SCHED_FIFO, else why not."""
    memory: str | None
    """None when the memory is locked, else why not."""

    def __str__(self) -> str:
        """One line for a person."""
        parts = ["garbage collection off"]
        parts.append(
            "SCHED_FIFO" if self.scheduling is None else f"no real-time priority ({self.scheduling})"
        )
        parts.append("memory locked" if self.memory is None else f"memory not locked ({self.memory})")
        return ", ".join(parts)


def _lock_memory(flags: int) -> str | None:
    libc = ctypes.CDLL(None, use_errno=True)
    done = libc.mlockall(flags) if flags else libc.munlockall()
    return None if done == 0 else os.strerror(ctypes.get_errno())


@contextmanager
def prepare_realtime(priority: int = PRIORITY) -> Iterator[Realtime]:
    """Make the calling thread and its process punctual for as long as the block lasts.

    Never around a loop that does not sleep, such as a bench on a virtual clock: with SCHED_FIFO it would
    take a whole processor from everything else.
    """
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    collecting, switching_s = gc.isenabled(), sys.getswitchinterval()
    # Another thread (a progress bar's) gives the interpreter back within this time when the loop wakes up.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        scheduling = None
    except OSError as error:
        scheduling = error.strerror or str(error)
    memory = _lock_memory(_MCL_CURRENT | _MCL_FUTURE)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield Realtime(scheduling, memory)
    finally:
        sys.setswitchinterval(switching_s)
        gc.unfreeze()
        if collecting:
            gc.enable()
        if memory is None:
            _lock_memory(0)
        if scheduling is None:
            os.sched_setscheduler(0, policy, parameter)
