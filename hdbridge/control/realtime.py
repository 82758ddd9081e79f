"""What a process can do for a punctual loop: no garbage collection, real-time priority, locked memory.

Everything is put back on the way out. What the system does not permit is reported, not insisted on: the
loop then runs with what it got, and its lateness histogram tells how well.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

_MCL_CURRENT, _MCL_FUTURE = 1, 2
PRIORITY: Final = 50
"""SCHED_FIFO priority: above all ordinary work, and level with the kernel's interrupt threads.

Linux gives threaded interrupts (under PREEMPT_RT nearly all are) SCHED_FIFO 50 as well: half of the 100, see
sched_set_fifo. Of equals on one processor the one that runs goes on until it sleeps. So neither interrupts
the other: the loop may wait for an interrupt thread, and the one that brings frames runs meanwhile.
"""

SWITCH_INTERVAL_S: Final = 0.0002


@dataclass(frozen=True, slots=True)
class Realtime:
    """What was obtained; a reason where it was not."""

    scheduling: str | None
    """None when the thread has SCHED_FIFO, else why not."""
    memory: str | None
    """None when the memory is locked, else why not."""
    affinity: str | None = None
    """None when the thread is bound to the processors that were asked for (or none were), else why not."""
    priority: int = PRIORITY
    """The SCHED_FIFO priority asked for; 0: none."""
    cpus: tuple[int, ...] = ()
    """The processors asked for; none: any."""

    def __str__(self) -> str:
        """One line for a person."""
        parts = ["garbage collection off"]
        if not self.priority:
            parts.append("ordinary priority")
        elif self.scheduling is None:
            parts.append(f"SCHED_FIFO {self.priority}")
        else:
            parts.append(f"no real-time priority ({self.scheduling})")
        parts.append("memory locked" if self.memory is None else f"memory not locked ({self.memory})")
        if self.cpus:
            cpus = ", ".join(map(str, self.cpus))
            bound = f"on processor {cpus}"
            parts.append(bound if self.affinity is None else f"not {bound} ({self.affinity})")
        return ", ".join(parts)


def _lock_memory(flags: int) -> str | None:
    libc = ctypes.CDLL(None, use_errno=True)
    done = libc.mlockall(flags) if flags else libc.munlockall()
    return None if done == 0 else os.strerror(ctypes.get_errno())


@contextmanager
def prepare_realtime(priority: int = PRIORITY, cpus: Collection[int] = ()) -> Iterator[Realtime]:
    """Make the calling thread and its process punctual for as long as the block lasts.

    ``priority`` is that of SCHED_FIFO, 1 to 99, or 0 to leave the scheduling alone; ``cpus`` are the numbers
    of the processors that the thread may run on, none for any.

    Never around a loop that does not sleep, such as a bench on a virtual clock: with SCHED_FIFO it would
    take a whole processor from everything else.
    """
    held = _Held(priority, cpus)
    with held.stack:
        realtime = held.enter()
        _held.append(held)
        try:
            yield realtime
        finally:
            _held.remove(held)


@contextmanager
def left_realtime() -> Iterator[None]:
    """Out of the block of `prepare_realtime` for as long as this one lasts: for a fit between two motions.

    With SCHED_FIFO it would keep others from the processor for minutes, and without the collector, in locked
    memory, take more of that than there is. `resumed_realtime` within goes back for a motion.
    """
    held = _held[-1] if _held else None
    if held is None or held.left:
        yield
        return
    held.leave()
    try:
        yield
    finally:
        held.enter()


@contextmanager
def resumed_realtime() -> Iterator[None]:
    """Back in, where `left_realtime` has left; else nothing."""
    held = _held[-1] if _held else None
    if held is None or not held.left:
        yield
        return
    held.enter()
    try:
        yield
    finally:
        held.leave()


class _Held:
    """The conditions of one block, entered or left for a while."""

    def __init__(self, priority: int, cpus: Collection[int]) -> None:
        self._priority, self._cpus = priority, cpus
        self.stack = ExitStack()
        self.left = True

    def enter(self) -> Realtime:
        self.left = False
        return self.stack.enter_context(_conditions(self._priority, self._cpus))

    def leave(self) -> None:
        self.left = True
        self.stack.close()


_held: Final[list[_Held]] = []
"""The blocks that this process is in; the conditions are the process's, so is this."""


@contextmanager
def _conditions(priority: int, cpus: Collection[int]) -> Iterator[Realtime]:
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    allowed = os.sched_getaffinity(0)
    collecting, switching_s = gc.isenabled(), sys.getswitchinterval()
    # Another thread (a progress bar's) gives the interpreter back within this time when the loop wakes up.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    affinity = _why_not(lambda: _bind(cpus)) if cpus else None
    scheduling = (
        _why_not(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority)))
        if priority
        else None
    )
    memory = _lock_memory(_MCL_CURRENT | _MCL_FUTURE)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield Realtime(scheduling, memory, affinity, priority, tuple(sorted(cpus)))
    finally:
        sys.setswitchinterval(switching_s)
        gc.unfreeze()
        if collecting:
            gc.enable()
        if memory is None:
            _lock_memory(0)
        if priority and scheduling is None:
            os.sched_setscheduler(0, policy, parameter)
        if cpus and affinity is None:
            os.sched_setaffinity(0, allowed)


def _why_not(attempt: Callable[[], None]) -> str | None:
    """The system's reason for refusing; None when it did not."""
    try:
        attempt()
    except OSError as error:
        return error.strerror or str(error)
    return None


def _bind(cpus: Collection[int]) -> None:
    """Linux takes those of the processors that exist and says nothing of the others."""
    here = set(range(os.cpu_count() or 1))
    if missing := set(cpus) - here:
        raise OSError(errno.EINVAL, f"there is no processor {min(missing)}, the last one is {max(here)}")
    os.sched_setaffinity(0, cpus)
