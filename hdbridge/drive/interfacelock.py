"""One master per CAN interface and computer: a lock that ends with the process that holds it."""

import ctypes
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final, Self
from urllib.parse import quote, unquote

from hdbridge.errors import BusError, BusInUseError
from hdbridge.files.expectation import one_line

try:
    import fcntl
    import pwd
except ImportError:  # a system without flock has no lock and no holder to report
    fcntl = None  # type: ignore[assignment]

_SHARED_BY_ALL_USERS: Final = Path("/run/lock")
_IN_ONE_PROCESS: Final = frozenset({"virtual"})
"""python-can interfaces that are confined to one process and therefore need no lock."""
_IN_CLOSE: Final = 0x18
"""inotify: a file was closed, whether it was open for writing or for reading (<sys/inotify.h>)."""


class InterfaceLock:
    """Lock on a CAN interface of this computer. Only one holder can have it at a time.

    The lock file is never removed; otherwise, the next two processes could each obtain a lock. ``folder``
    is its location, by default one shared by all users of the computer.
    """

    def __init__(self, interface: str, channel: object, folder: Path | None = None) -> None:
        self._name = f"{interface}:{channel}"
        self._path: Path | None = None
        if fcntl is not None and interface not in _IN_ONE_PROCESS:
            self._path = (folder or _folder()) / f"hdbridge-{quote(f'{interface}-{channel}', safe='')}.lock"
        self._handle: int | None = None

    @property
    def holder(self) -> int:
        """Process id of the holder; 0 if the lock is free or the system hides its holder."""
        return _holder(self._path) if self._path is not None and self._path.exists() else 0

    def acquire(self) -> None:
        """Acquires the lock; raises `BusInUseError` if another process on this computer holds it."""
        if self._path is None or self._handle is not None:
            return
        handle = _open(self._path)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            number = self.holder
            end = f"end it with 'kill {number}'" if number else "end it"
            raise BusInUseError(
                f"{self._name}: another hdbridge on this machine masters it "
                f"({process_words(number) if number else 'it'} holds {self._path}); if it is a daemon, ask "
                f"it with 'hdbridge ctl' or borrow its bus with --borrow, else {end} (--force, in the "
                "library shared=True, opens the bus anyway)"
            ) from None
        self._handle = handle

    def release(self) -> None:
        """Releases the lock if it is held."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def watch_closing(self) -> int:
        """Returns a new descriptor (inotify) that is readable once a process has closed the lock file.

        A process closes it when it releases the lock, also by ending. Raises OSError if the system has no
        descriptor to spare.
        """
        libc = ctypes.CDLL(None, use_errno=True)
        descriptor = int(libc.inotify_init1(os.O_CLOEXEC | os.O_NONBLOCK))
        if descriptor < 0 or libc.inotify_add_watch(descriptor, os.fsencode(str(self._path)), _IN_CLOSE) < 0:
            number = ctypes.get_errno()
            if descriptor >= 0:
                os.close(descriptor)
            raise OSError(number, os.strerror(number))
        return descriptor

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def holders(folder: Path | None = None) -> dict[int, str]:
    """Returns the hdbridge processes that hold an interface of this computer: process id and description."""
    found: dict[int, str] = {}
    for path in sorted((folder or _folder()).iterdir()):
        match = re.fullmatch(r"hdbridge-(.+)\.lock", path.name)
        with suppress(OSError):
            if match is not None and (number := _holder(path)):
                interface, _, channel = unquote(match[1]).partition("-")
                found[number] = f"{interface}:{channel} is held by {process_words(number)}"
    return found


def process_words(number: int) -> str:
    """Returns process id, user and command line of a process, as text."""
    user = ""
    with suppress(OSError):
        user = f" of {user_name(Path(f'/proc/{number}').stat().st_uid)}"
    return f"process {number}{user}, '{one_line(command_line(number)[:80])}'"


def command_line(number: int) -> str:
    """Returns the command line of a process; empty if the process does not exist."""
    words: list[bytes] = []
    with suppress(OSError):
        words = Path(f"/proc/{number}/cmdline").read_bytes().split(b"\0")
    return " ".join(each.decode(errors="replace") for each in words if each)


def user_name(uid: int) -> str:
    """Returns the name of a user of this computer; ``user`` and the number if unknown."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"


def _holder(path: Path) -> int:
    """Returns the id of the process that has locked ``path``; 0 if none has or the system hides it."""
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
    """Opens the lock file for reading only, because another user may own it; this suffices for locking."""
    flags = os.O_RDONLY | os.O_NOFOLLOW
    try:
        try:
            handle = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644)
            os.fchmod(handle, 0o644)  # regardless of the umask: another user may take the lock next
        except FileExistsError:
            return os.open(path, flags)
        return handle
    except OSError as error:
        raise BusError(
            f"{path}: the lock of the CAN interface cannot be opened: {error.strerror}; remove it, or give "
            "--force (in the library shared=True) to do without"
        ) from error
