"""Files that are either the old one or the new one, whatever happens while they are written."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hdbridge.errors import InputError


def write_atomically(path: Path | str, content: str | bytes) -> None:
    """Replace the file's content, text as UTF-8: temporary file beside it, fsync, rename, fsync the folder.

    A reader, or a power cut, finds the old content or the new one. InputError when the folder cannot be
    written; the old file then stands.
    """
    data = content.encode() if isinstance(content, str) else content
    target = Path(path).resolve()  # through a link, or the rename would replace the link
    try:
        with _temporary(target) as descriptor:
            try:
                os.ftruncate(descriptor, 0)
                written = 0
                while written < len(data):
                    written += os.write(descriptor, data[written:])
                os.fsync(descriptor)
                _temporary_name(target).rename(target)
            except OSError:  # a full disk needs its space back
                _temporary_name(target).unlink(missing_ok=True)
                raise
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as problem:
        raise InputError(f"{path}: cannot be written: {problem.strerror}") from None


def check_writable(path: Path | str) -> None:
    """InputError unless a file may be written there: for before a long measurement, instead of after it."""
    target = Path(path).resolve()
    if target.is_dir():
        raise InputError(f"{path}: cannot be written: it is a folder; expected the name of a file")
    if not target.parent.is_dir():
        raise InputError(f"{path}: cannot be written: there is no folder {target.parent}")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written: the folder {target.parent} does not permit it")


def make_folder(path: Path | str) -> None:
    """The folder, with its parents where they are missing. InputError where it cannot be made or written."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise InputError(f"{path}: cannot make this folder: {problem.strerror}") from None
    check_writable(folder / "a file")


def _temporary_name(target: Path) -> Path:
    return target.with_name(f".{target.name}.tmp")


@contextmanager
def _temporary(target: Path) -> Iterator[int]:
    """The one temporary file of a target, locked.

    Its name is fixed, so that a killed writer leaves nothing behind but what the next one overwrites. Of two
    writers the second waits for the lock; by then the first has renamed the file, so it looks again.
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
