"""One master per CAN interface on this machine: a lock that goes with the process that holds it."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final
from urllib.parse import quote, unquote

from hdbridge.errors import BusError, BusInUseError
from hdbridge.files.expectation import one_line

try:
    import fcntl
    import pwd
except ImportError:  # a system without flock has no lock, and no holder to name
    fcntl = None  # type: ignore[assignment]

_SHARED_BY_ALL_USERS: Final = Path("/run/lock")
_IN_ONE_PROCESS: Final = frozenset({"virtual"})
"""Interfaces of python-can that end in their process."""


@contextmanager
def interface_lock(interface: str, channel: object, folder: Path | None = None) -> Iterator[None]:
    """Hold the lock of an interface; `BusInUseError` where somebody on this machine has it.

    The lock file stays: to remove it would give the next two processes a lock each. ``folder`` is where it
    lies, by default one that all users of the machine share.
    """
    if fcntl is None or interface in _IN_ONE_PROCESS:
        yield
        return
    path = (folder or _folder()) / f"hdbridge-{quote(f'{interface}-{channel}', safe='')}.lock"
    handle = _open(path)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            number = _holder(path)
            end = f"end it with 'kill {number}'" if number else "end it"
            raise BusInUseError(
                f"{interface}:{channel}: another hdbridge on this machine masters it "
                f"({process_words(number) if number else 'it'} holds {path}); ask it with 'hdbridge ctl' if "
                f"it is a daemon, or {end} (--force, in the library shared=True, opens the bus all the same)"
            ) from None
        yield
    finally:
        os.close(handle)


def holders(folder: Path | None = None) -> dict[int, str]:
    """The processes of hdbridge that master an interface of this machine: by number, what each holds."""
    found: dict[int, str] = {}
    for path in sorted((folder or _folder()).iterdir()):
        match = re.fullmatch(r"hdbridge-(.+)\.lock", path.name)
        with suppress(OSError):
            if match is not None and (number := _holder(path)):
                interface, _, channel = unquote(match[1]).partition("-")
                found[number] = f"{interface}:{channel} is held by {process_words(number)}"
    return found


def process_words(number: int) -> str:
    """Number, user and command line of a process."""
    user = ""
    with suppress(OSError):
        user = f" of {user_name(Path(f'/proc/{number}').stat().st_uid)}"
    return f"process {number}{user}, '{one_line(command_line(number)[:80])}'"


def command_line(number: int) -> str:
    """The command line of a process; empty if there is no such process."""
    words: list[bytes] = []
    with suppress(OSError):
        words = Path(f"/proc/{number}/cmdline").read_bytes().split(b"\0")
    return " ".join(each.decode(errors="replace") for each in words if each)


def user_name(uid: int) -> str:
    """The name of a user of this machine; ``user`` and the number if it has none."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"


def _holder(path: Path) -> int:
    """Number of the process that has locked a file; 0 if none has, or this system does not show it."""
    inode = path.stat().st_ino
    with suppress(OSError, ValueError):
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            _, kind, _, _, number, place, *_ = line.split()
            if kind == "FLOCK" and int(place.split(":")[2]) == inode:
                return max(int(number), 0)
    return 0


def _folder() -> Path:
    return _SHARED_BY_ALL_USERS if os.access(_SHARED_BY_ALL_USERS, os.W_OK) else Path(tempfile.gettempdir())


def _open(path: Path) -> int:
    """Open for reading, which is enough to lock it: the file may be another user's."""
    flags = os.O_RDONLY | os.O_NOFOLLOW
    try:
        try:
            handle = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644)
            os.fchmod(handle, 0o644)  # whatever the umask: the next one may be another user
        except FileExistsError:
            return os.open(path, flags)
        return handle
    except OSError as error:
        raise BusError(
            f"{path}: the lock of the CAN interface cannot be opened: {error.strerror}; remove it, or give "
            "--force (in the library shared=True) to do without"
        ) from error
