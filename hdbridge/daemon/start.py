"""Start data that the keeper passes to its children, set-up of a child, and the runtime folder.

A child is a fresh interpreter, not a fork, and inherits only descriptors. One of them contains the pickled
start data, in memory that no other process can open. All processes, including restarted ones, therefore use
the same machine file.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import stat
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from hdbridge.client.address import session_folder
from hdbridge.daemon.logs import LogSettings
from hdbridge.errors import HdbridgeError, InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine

_PR_SET_PDEATHSIG: Final = 1
_PR_SET_NAME: Final = 15
_NAME_BYTES: Final = 15


@dataclass(frozen=True, slots=True)
class Simulation:
    """Simulated axes that replace the bus."""

    truths: tuple[Path, ...]
    """Files of the simulated axes' true parameters, one per axis."""
    seed: int = 0
    speed: float = 1.0
    """Maximum ratio of virtual to real time."""


@dataclass(frozen=True)
class Start:
    """Start data of a process of the daemon."""

    machine: Machine
    memory_fd: int
    """Descriptor of the shared memory."""
    keeper: int
    """Process id of the keeper; a child with another parent has already lost the keeper."""
    simulation: Simulation | None = None
    force: bool = False
    """If True, the daemon communicates even if another master is active, and does not lock the interface."""
    socket: Path = Path()
    """Path of the Unix socket of the API."""
    socket_file: tuple[int, int] = (0, 0)
    """Device and inode of the socket file."""
    api_fds: tuple[int, ...] = ()
    """Listening sockets for the service, the Unix one first."""
    page_token: str | None = None
    """Token of the page on the last socket; None without a page."""
    log: LogSettings = LogSettings()

    def hand_over(self, **changes: object) -> int:
        """Returns a descriptor with the data for a child, to be closed once the child runs."""
        start = replace(self, **changes)  # type: ignore[arg-type]
        fd = os.memfd_create("hdbridge-start", os.MFD_CLOEXEC)
        with os.fdopen(os.dup(fd), "wb") as file:
            pickle.dump(start, file)
        os.lseek(fd, 0, os.SEEK_SET)
        return fd

    @classmethod
    def inherited(cls, arguments: list[str]) -> Self:
        """Returns the keeper's data and closes the descriptor. Raises InputError without a keeper."""
        try:
            (number,) = arguments
            with os.fdopen(int(number), "rb") as file:
                start = pickle.load(file)
        except (ValueError, OSError, pickle.UnpicklingError, EOFError):
            start = None
        if not isinstance(start, cls):
            raise InputError("this is a process of the daemon and not started by hand: use 'hdbridge run'")
        return start


def run_child(arguments: list[str], name: str, run: Callable[[Start], None]) -> int:
    """Runs a child with the keeper's start data; prints an `HdbridgeError` and returns the exit status."""
    try:
        start = Start.inherited(arguments)
        begin_child(start, name)
        run(start)
    except HdbridgeError as error:
        print(f"hdbridge: {error}", file=sys.stderr)
        return error.exit_status
    return 0


def when_terminated() -> Callable[[], bool]:
    """Catches SIGTERM from now on; returns a function that returns True once SIGTERM was received."""
    received: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    return lambda: bool(received)


def begin_child(start: Start, name: str) -> None:
    """Prepares a child: it ends with the keeper, ignores the terminal's signals and has a name in ``top``."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    libc.prctl(_PR_SET_NAME, name.encode()[:_NAME_BYTES], 0, 0, 0)
    for each in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):  # from the terminal; the keeper handles them
        signal.signal(each, signal.SIG_IGN)
    if os.getppid() != start.keeper:  # the keeper died before prctl took effect
        sys.exit(0)


def runtime_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Returns the folder of the socket, created if necessary; raises InputError if others can access it.

    It is the service manager's folder, else the session's (``$XDG_RUNTIME_DIR/hdbridge``), else a folder of
    this user under ``/tmp``.
    """
    given = environment.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)  # created by the service manager, with the mode in its unit
    folder = session_folder(environment)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as problem:
        raise InputError(
            f"{folder}: cannot create this folder: {problem.strerror}; it holds the daemon's socket, see "
            "XDG_RUNTIME_DIR"
        ) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise InputError(
            f"{folder}: is not a folder of this user alone (mode 700); remove it, or set XDG_RUNTIME_DIR"
        )
    return folder
