"""Folder of a flight recorder: a ring of files limited by size and age, and the files kept aside.

    FOLDER/DATE-MACHINE.mcap.part    being written
    FOLDER/DATE-MACHINE.mcap         the ring; the oldest file is removed first
    FOLDER/kept/DATE-MACHINE.mcap    kept because it contains, or is close to, a fault

Names begin with the date in UTC, so they sort by time.
"""

import contextlib
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from hdbridge.daemon.recorder.flightfile import KEPT, PART
from hdbridge.daemon.recorder.reading import SUFFIX
from hdbridge.daemon.recorder.settings import RecorderSettings

_MB: Final = 1e6
_DAY_S: Final = 86_400.0
_NS: Final = 1_000_000_000


def free_bytes(folder: Path) -> int:
    """Returns the free bytes on the disk of ``folder``."""
    return shutil.disk_usage(folder).free


@dataclass(frozen=True)
class Store:
    """Folder of the recordings and its limits."""

    folder: Path
    settings: RecorderSettings
    free: Callable[[Path], int] = free_bytes

    def new_path(self, machine: str, now_ns: int) -> Path:
        """Returns an unused name for the next file."""
        date = datetime.fromtimestamp(now_ns / _NS, UTC).strftime("%Y%m%dT%H%M%SZ")
        number, name = 1, f"{date}-{machine}{SUFFIX}"
        while any(
            (folder / each).exists()
            for folder in (self.folder, self.folder / KEPT)
            for each in (name, name + PART)
        ):
            number += 1
            name = f"{date}-{number}-{machine}{SUFFIX}"
        return self.folder / name

    def room_for(self, size: int) -> bool:
        """Returns True if ``size`` bytes can be written with the required space left free."""
        return self.free(self.folder) >= size + self.settings.free_mb * _MB

    def keep(self, path: Path) -> Path:
        """Moves a finished file aside; returns its new path."""
        kept = self.folder / KEPT
        kept.mkdir(exist_ok=True)
        target = kept / path.name
        path.rename(target)
        return target

    def trim(self, now_ns: int, writing: int = 0) -> list[Path]:
        """Removes files over the limits, oldest first; returns the kept ones that were removed.

        ``writing`` is the size of the file being written.
        """
        limits = self.settings
        _trim(self.folder, limits.size_mb * _MB - writing, now_ns / _NS - limits.age_days * _DAY_S)
        return _trim(self.folder / KEPT, limits.kept_mb * _MB, -1.0)


def _trim(folder: Path, most: float, oldest_s: float) -> list[Path]:
    """Removes files beyond ``most`` bytes in all or older than ``oldest_s``; returns them."""
    files: list[tuple[Path, os.stat_result]] = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with contextlib.suppress(FileNotFoundError):  # removed by a user
            files.append((path, path.stat()))
    left = sum(status.st_size for _, status in files)
    gone = []
    for path, status in files:
        if left <= most and status.st_mtime >= oldest_s:
            continue
        path.unlink(missing_ok=True)
        left -= status.st_size
        gone.append(path)
    return gone
