"""The folder of a flight recorder: a ring of files by size and age, and those that are kept aside of it.

    FOLDER/DATE-MACHINE.mcap.part    being written
    FOLDER/DATE-MACHINE.mcap         the ring: the oldest goes first
    FOLDER/kept/DATE-MACHINE.mcap    moved here because a fault is in it, or near

The names begin with the date in UTC, so that their order is that of time.
"""

from __future__ import annotations

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
    """What is free on its disk for whoever asks."""
    return shutil.disk_usage(folder).free


@dataclass(frozen=True)
class Store:
    """The folder and its limits."""

    folder: Path
    settings: RecorderSettings
    free: Callable[[Path], int] = free_bytes

    def new_path(self, machine: str, now_ns: int) -> Path:
        """Name of the next file; no other has it."""
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
        """Whether so many bytes may be written, and what has to stay free stays so."""
        return self.free(self.folder) >= size + self.settings.free_mb * _MB

    def keep(self, path: Path) -> Path:
        """Move a finished file aside; where it then is."""
        kept = self.folder / KEPT
        kept.mkdir(exist_ok=True)
        target = kept / path.name
        path.rename(target)
        return target

    def trim(self, now_ns: int, writing: int = 0) -> list[Path]:
        """Remove what is over the limits, oldest first; what is gone of the kept ones.

        ``writing`` is the size of the file that is being written.
        """
        limits = self.settings
        _trim(self.folder, limits.size_mb * _MB - writing, now_ns / _NS - limits.age_days * _DAY_S)
        return _trim(self.folder / KEPT, limits.kept_mb * _MB, -1.0)

    def finished(self) -> list[Path]:
        """The files of the ring, oldest first."""
        return sorted(self.folder.glob(f"*{SUFFIX}"))


def _trim(folder: Path, most: float, oldest_s: float) -> list[Path]:
    """Remove files until no more than ``most`` bytes are left and none is older; which."""
    files: list[tuple[Path, os.stat_result]] = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with contextlib.suppress(FileNotFoundError):  # a person removed it
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
