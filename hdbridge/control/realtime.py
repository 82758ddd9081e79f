"""Process settings for a loop that wakes up on time: no garbage collection, real-time priority, locked
memory.

All settings are restored on exit. Settings that the system refuses are reported but not required: the loop
then runs with the granted settings, and its lateness histogram shows the result.
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
"""SCHED_FIFO priority: above all ordinary work, and equal to the kernel's interrupt threads.

Linux also runs threaded interrupts (nearly all under PREEMPT_RT) at SCHED_FIFO 50; see sched_set_fifo.
Threads of equal priority on one processor do not preempt each other, so the loop may wait for an interrupt
thread, and an interrupt thread that delivers frames can run to completion."""

SWITCH_INTERVAL_S: Final = 0.0002


@dataclass(frozen=True, slots=True)
class Realtime:
    """Granted settings, with the reason for each refused setting."""

    scheduling: str | None
    """None if the thread has SCHED_FIFO, else the reason."""
    memory: str | None
    """None if the memory is locked, else the reason."""
    affinity: str | None = None
    """None if the thread is bound to the requested processors or none were requested, else the reason."""
    priority: int = PRIORITY
    """Requested SCHED_FIFO priority; 0 for none."""
    cpus: tuple[int, ...] = ()
    """Requested processors; empty for any."""

    def __str__(self) -> str:
        """Describes the settings in one line."""
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
    """Applies the settings to the calling thread and its process within the block.

    ``priority`` is the SCHED_FIFO priority, 1 to 99, or 0 to leave the scheduling unchanged; ``cpus`` are the
    numbers of the permitted processors, empty for any.

    Not for use around a loop that does not sleep, such as a bench on a virtual clock: with SCHED_FIFO it
    would monopolise a processor.
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
def suspended_realtime() -> Iterator[None]:
    """Suspends `prepare_realtime` within the block, for example for a fit between two motions.

    A long computation with SCHED_FIFO would block other processes for minutes. Without the garbage collector,
    in locked memory, it could exhaust the memory. `resumed_realtime` within the block resumes the settings
    for a motion.
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
    """Resumes `prepare_realtime` within the block, if `suspended_realtime` has suspended it."""
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
    """Settings of one block, which can be suspended and resumed."""

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
"""Active blocks; module-level because the settings apply to the whole process."""


@contextmanager
def _conditions(priority: int, cpus: Collection[int]) -> Iterator[Realtime]:
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    allowed = os.sched_getaffinity(0)
    collecting, switching_s = gc.isenabled(), sys.getswitchinterval()
    # Another thread (a progress bar's) releases the interpreter within this time when the loop wakes up.
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
    """Returns the system's reason for refusing; None on success."""
    try:
        attempt()
    except OSError as error:
        return error.strerror or str(error)
    return None


def _bind(cpus: Collection[int]) -> None:
    """Binds the thread to processors; checks them first, because Linux silently ignores missing ones."""
    here = set(range(os.cpu_count() or 1))
    if missing := set(cpus) - here:
        raise OSError(errno.EINVAL, f"there is no processor {min(missing)}, the last one is {max(here)}")
    os.sched_setaffinity(0, cpus)
