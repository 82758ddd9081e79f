"""Atomic file writing: a file has either its old or its new content, whatever interrupts the write.

Pipes and character devices have no content to preserve. They are written directly, and are never replaced by
a file.
"""

import errno
import fcntl
import itertools
import os
import re
import shutil
import stat
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from hdbridge.errors import InputError, OutputError

_FULL = (errno.ENOSPC, errno.EDQUOT)
_STANDARD = ("/dev/stdin", "/dev/stdout", "/dev/stderr")
_DESCRIPTOR = re.compile(r"/(?:dev|proc/self)/fd/(\d+)")


def write_atomically(path: Path | str, content: str | bytes) -> None:
    """Replaces a file's content (text as UTF-8): temporary file, fsync, rename, fsync of the folder.

    After an interruption such as a power cut, the file has its old or its new content. Pipes and character
    devices are written directly. If the location cannot be written, raises `OutputError` and preserves the
    old file.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        if is_stream(path):
            _write_through(Path(path), data)
            return
        target = Path(path).resolve()  # links are resolved, because the rename would replace a link
        with _temporary(target) as descriptor:
            try:
                os.ftruncate(descriptor, 0)
                _write_all(descriptor, data)
                os.fsync(descriptor)
                _temporary_name(target).rename(target)
            except OSError:  # frees the space on a full disk
                _temporary_name(target).unlink(missing_ok=True)
                raise
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except BrokenPipeError:  # the reader closed the pipe
        raise
    except OSError as problem:
        raise OutputError(f"{path}: cannot be written: {problem.strerror}") from None


def check_writable(path: Path | str, named: Path | str = "") -> None:
    """Raises an error if a file cannot be written here; to be called before a long measurement.

    The message names ``named`` in place of the path, if given.

    It creates a temporary file, so a read-only file system or a name that is too long is also detected.
    """
    named = named or path
    try:
        if is_stream(path):
            number = descriptor_of(path)
            if (
                not os.access(path, os.W_OK)
                if number is None
                else fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
            ):
                raise InputError(f"{named}: cannot be written: no permission")
            return
        target = Path(path).resolve()
        if target.is_dir():
            raise InputError(f"{named}: cannot be written: it is a folder; expected the name of a file")
        if target.exists() and not target.is_file():
            raise InputError(
                f"{named}: cannot be written: it is neither a file nor a pipe nor a character device"
            )
        if not target.parent.is_dir():
            raise InputError(f"{named}: cannot be written: there is no folder {target.parent}")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise InputError(f"{named}: cannot be written: the folder {target.parent} does not permit it")
        _try_out(target)
    except OSError as problem:
        raise _refused(f"{named}: cannot be written", problem) from None
    except RuntimeError:  # Python 3.11 and 3.12 report a loop of symbolic links by this
        raise InputError(f"{named}: cannot be written: its symbolic links form a loop") from None


def _try_out(target: Path) -> None:
    with _temporary(target):
        _temporary_name(target).unlink()


def descriptor_of(path: Path | str) -> int | None:
    """Returns the descriptor that a path such as ``/dev/stdout`` or ``/dev/fd/3`` denotes; else None."""
    if str(path) in _STANDARD:
        return _STANDARD.index(str(path))
    found = _DESCRIPTOR.fullmatch(str(path))
    return int(found[1]) if found else None


def is_stream(path: Path | str) -> bool:
    """Returns True for a path to write directly: a pipe, a character device, or an open descriptor."""
    if descriptor_of(path) is not None:
        return True
    try:
        mode = os.stat(path).st_mode  # noqa: PTH116 - follows links such as those in /proc, which do not resolve
    except OSError:
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)


def _write_through(path: Path, data: bytes) -> None:
    number = descriptor_of(path)
    if number == 1:  # flushed first, so that printed text precedes the data
        sys.stdout.flush()
        buffer = getattr(sys.stdout, "buffer", None)
        if buffer is not None:
            buffer.write(data)
            buffer.flush()
            return
    if number is not None:
        _write_all(number, data)
        return
    descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        _write_all(descriptor, data)
    finally:
        os.close(descriptor)


def _write_all(descriptor: int, data: bytes) -> None:
    written = 0
    while written < len(data):
        written += os.write(descriptor, data[written:])


def make_folder(path: Path | str, *, new: bool = False) -> Path:
    """Creates a folder with its parents and returns it; with ``new``, raises `FileExistsError` if it exists.

    Raises `OutputError` if the disk is full, and `InputError` if the folder is not writable. A folder that
    takes no files is removed again.
    """
    folder = Path(path)
    found, doing = folder.exists(), "create"
    try:
        folder.mkdir(parents=True, exist_ok=not new)
        doing = "write into"
        _try_out(folder.resolve() / "tried")
    except OSError as problem:
        if new and isinstance(problem, FileExistsError):
            raise
        if not found:
            with suppress(OSError):
                folder.rmdir()
        raise _refused(f"{path}: cannot {doing} this folder", problem) from None
    return folder


def _refused(what: str, problem: OSError) -> InputError | OutputError:
    """Returns the error for a location that takes no file: an `OutputError` if the disk is full."""
    kind = OutputError if problem.errno in _FULL else InputError
    return kind(f"{what}: {problem.strerror}")


@contextmanager
def sole_writer(folder: Path, *, new: bool = False) -> Iterator[None]:
    """Creates a folder in which only this process may write its results; the lock ends with the process.

    Raises `InputError` at once if another process holds the lock, if the folder is not writable, or, with
    ``new``, if it is not empty.
    """
    make_folder(folder)
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as problem:
        raise InputError(f"{folder}: cannot be opened: {problem.strerror}") from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = _is_still(folder, descriptor)  # otherwise its last writer has removed it, empty
        except BlockingIOError:
            free = False
        if not free:
            raise InputError(
                f"{folder}: another hdbridge process writes to this folder; wait until it ends, or take "
                "another folder"
            )
        if new and any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty any more; expected a new or an empty folder")
        yield
    finally:
        os.close(descriptor)


def write_folder(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Writes a new folder with all of these files or none; returns the files' paths.

    Raises `InputError` if the folder is not empty or cannot be created, and `OutputError` if the files cannot
    be written, for example on a full disk. After an error nothing is left behind, not even new parent
    folders.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; expected a new folder, nothing was written")
    made = [each for each in folder.absolute().parents if not each.exists()]
    aside, place = folder.with_name(f".{folder.name}.{os.getpid()}"), folder
    try:
        aside.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            place = folder / name
            with (aside / name).open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        place = folder
        aside.rename(folder)
    except BaseException as problem:
        shutil.rmtree(aside, ignore_errors=True)
        for each in made:
            with suppress(OSError):
                each.rmdir()
        if not isinstance(problem, OSError):
            raise
        if place == folder:
            raise _refused(f"{folder}: cannot create this folder", problem) from None
        raise OutputError(f"{place}: cannot be written: {problem.strerror}") from None
    return [folder / name for name in files]


def new_folder(path: Path) -> Path:
    """Creates a new folder with this name or, if it exists, with the next free number appended.

    Concurrent processes always receive different folders.
    """
    for number in itertools.count(1):
        with suppress(FileExistsError):
            return make_folder(path if number == 1 else path.with_name(f"{path.name}-{number}"), new=True)
    raise AssertionError("numbers do not end")


def _temporary_name(target: Path) -> Path:
    return target.with_name(f".{target.name}.tmp")


@contextmanager
def _temporary(target: Path) -> Iterator[int]:
    """Yields the locked descriptor of a target's temporary file.

    The name is fixed, so a killed writer leaves a single file, which the next writer overwrites. A second
    writer waits for the lock. When it receives the lock, the first writer has renamed the file, so it opens a
    new one.
    """
    name = _temporary_name(target)
    while True:
        descriptor = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if _is_still(name, descriptor):
                yield descriptor
                return
        finally:
            os.close(descriptor)


def _is_still(name: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(name.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def open_regular(path: Path) -> BinaryIO:
    """Opens a file for reading; raises `OSError` for a named pipe, a device or a folder.

    Descriptors of this process (``/dev/stdin``, or ``/dev/fd/3`` from ``<(command)``) may be of any kind.
    """
    if descriptor_of(path) is None:
        mode = os.stat(path).st_mode  # noqa: PTH116 - follows links such as those in /proc
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
        if not stat.S_ISREG(mode):
            kind = "a named pipe" if stat.S_ISFIFO(mode) else "a device or a socket"
            raise OSError(errno.EINVAL, f"it is {kind}; expected a file", os.fspath(path))
    return path.open("rb")
