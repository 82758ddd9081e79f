"""What the keeper hands to the processes that it starts, and what each of them does first.

A child is a fresh interpreter, not a fork: it inherits descriptors and nothing else. One of them holds this,
pickled, in memory that nobody else can open. So all processes have read the same machine file, the ones that
are started later included.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from hdbridge.daemon.logs import LogSettings
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine

_PR_SET_PDEATHSIG: Final = 1
_PR_SET_NAME: Final = 15
_NAME_BYTES: Final = 15


@dataclass(frozen=True, slots=True)
class Simulation:
    """Simulated axes in place of the bus."""

    truths: tuple[Path, ...]
    """What each axis is like, one file per axis."""
    seed: int = 0
    speed: float = 1.0
    """Virtual seconds per second, at most."""


@dataclass(frozen=True)
class Start:
    """All that a process of the daemon is told at its start."""

    machine: Machine
    memory_fd: int
    """Descriptor of the shared memory."""
    keeper: int
    """Process number of the keeper: who finds another parent has been left alone before it could ask."""
    simulation: Simulation | None = None
    force: bool = False
    """Speak even where another master is heard. The lock of the interface is the keeper's either way."""
    socket: Path = Path()
    """Path of the Unix socket of the API."""
    socket_file: tuple[int, int] = (0, 0)
    """Device and inode that the keeper has bound there."""
    api_fds: tuple[int, ...] = ()
    """Listening sockets, the Unix one first; the service's."""
    page_token: str | None = None
    """What the page on the last of them asks for; None: no page was asked for."""
    restarts: int = 0
    """How many processes of this kind there were before."""
    log: LogSettings = LogSettings()

    def hand_over(self, **changes: object) -> int:
        """A descriptor from which a child reads it; to be closed when the child has been started."""
        told = replace(self, **changes)  # type: ignore[arg-type]
        fd = os.memfd_create("hdbridge-start", os.MFD_CLOEXEC)
        with os.fdopen(os.dup(fd), "wb") as file:
            pickle.dump(told, file)
        os.lseek(fd, 0, os.SEEK_SET)
        return fd

    @classmethod
    def inherited(cls, arguments: list[str]) -> Self:
        """What the keeper has told this process; closes the descriptor. InputError where it was no keeper."""
        try:
            (number,) = arguments
            with os.fdopen(int(number), "rb") as file:
                told = pickle.load(file)
        except (ValueError, OSError, pickle.UnpicklingError, EOFError):
            told = None
        if not isinstance(told, cls):
            raise InputError("this is a process of the daemon and not started by hand: use 'hdbridge run'")
        return told


def begin_child(start: Start, name: str) -> None:
    """The first act of a child: end with the keeper, leave Ctrl-C to it, have a name in ``top``."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    libc.prctl(_PR_SET_NAME, name.encode()[:_NAME_BYTES], 0, 0, 0)
    for each in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):  # of the terminal: the keeper sees to it
        signal.signal(each, signal.SIG_IGN)
    if os.getppid() != start.keeper:  # it died before we could ask to be told
        sys.exit(0)
