"""The flight recorder without its thread: files, limits and retention.

    FOLDER/DATE-MACHINE.mcap.part    being written
    FOLDER/DATE-MACHINE.mcap         the ring, limited by size and age; the oldest file is removed first
    FOLDER/kept/DATE-MACHINE.mcap    kept because it contains, or is close to, a fault

Names begin with the date in UTC, so they sort by time.

Once a second, new data is written as one chunk and synced, so a kill loses at most the last second. Free
space is checked first. While the disk is full, data is dropped and counted, and the beginning and end of this
condition are reported. A fault or a client's mark moves the files around its time to ``kept``, which has its
own size limit.
"""

import logging
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import Final, NamedTuple

from hdbridge.daemon.machinefile import RecorderSettings
from hdbridge.daemon.memory import Event, EventKind, SampleArray
from hdbridge.daemon.recorder.flightfile import KEPT, PART, About, FlightFile, ModelUse
from hdbridge.daemon.recorder.mend import mend_folder
from hdbridge.daemon.recorder.reading import SUFFIX, overview
from hdbridge.errors import InputError

MESSAGE_BYTES: Final = 256
"""Maximum size of a message with its index entry, before compression."""
KEPT_FOR: Final = frozenset({EventKind.STOPPED, EventKind.BUS_DOWN, EventKind.UNDERRUN})
"""Events that count as a fault."""
MARK: Final = "MARK"
_KEPT_NAMES: Final = frozenset({each.name for each in KEPT_FOR} | {MARK})
_MB: Final = 1e6
_DAY_S: Final = 86_400.0
_NS: Final = 1_000_000_000


class Batch(NamedTuple):
    """Data received from the service's core in one call."""

    samples: SampleArray
    events: tuple[Event, ...] = ()
    lost: int = 0


class Note(NamedTuple):
    """Note of another part of the daemon or a client."""

    kind: str
    text: str


Item = Batch | ModelUse | Note


def free_bytes(folder: Path) -> int:
    """Returns the free bytes on the disk of ``folder``."""
    return shutil.disk_usage(folder).free


class FlightLog:
    """Recorder without a thread; its owner calls `put` and, once a second, `flush`."""

    def __init__(
        self,
        folder: Path,
        settings: RecorderSettings,
        about: About,
        *,
        notify: Callable[[str], None] = lambda _: None,
        wall_ns: Callable[[], int] = time.time_ns,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        """``notify`` reports events of the recording to the user; ``wall_ns`` returns the time of day.

        Raises OSError if the folder cannot be created.
        """
        self.folder, self._settings, self._about, self._free = folder, settings, about, free
        self._notify = notify
        self._wall_ns = wall_ns
        self._file: FlightFile | None = None
        self._begun_ns = 0
        self._files: list[tuple[Path, int, int]] = []
        """Finished files of the ring, with their time spans, that may still be kept for a fault."""
        self._spans: list[tuple[int, int]] = []
        """Time spans around faults; ns of the samples' clock."""
        self._models: dict[str, ModelUse] = {}
        self.waiting: deque[Item] = deque()
        """Items since the last flush."""
        self._newest_ns = 0
        self._write_error = ""
        self._refused_since_error = 0
        self.refused = 0
        """Cycles not written because the disk was full."""
        folder.mkdir(parents=True, exist_ok=True)

    def mend(self) -> None:
        """Repairs the files of a process that has died, and keeps those that contain a fault."""
        for path in mend_folder(self.folder, self._notify):
            self._notify(
                f"{path.name}: was unfinished; it has been repaired and is complete up to its last second"
            )
            with suppress(InputError, OSError):
                if any(each.kind in _KEPT_NAMES for each in overview(path).events):
                    self._move_to_kept(path)
        self._remove_old()

    def put(self, item: Item) -> None:
        """Takes an item, in any thread; it is on the disk after the next `flush`."""
        self.waiting.append(item)

    def flush(self) -> None:
        """Writes the items since the last flush."""
        waiting = [self.waiting.popleft() for _ in range(len(self.waiting))]
        for item in waiting:
            if isinstance(item, ModelUse):
                self._models[item.axis] = item  # a later file must contain the model as well
            elif isinstance(item, Batch) and len(item.samples):
                self._newest_ns = int(item.samples["time_ns"][-1])
        if not waiting and (self._file is None or not self._file.behind):
            return
        cycles = sum(len(each.samples) for each in waiting if isinstance(each, Batch))
        size = cycles * (1 + len(self._about.axes)) * MESSAGE_BYTES
        self._note_spans(waiting)
        try:
            free_mb, needed_mb = self._free(self.folder) / _MB, size / _MB + self._settings.free_mb
            if free_mb < needed_mb:
                raise OSError(f"{free_mb:.3g} MB are free; expected at least {needed_mb:.3g} MB (free_mb)")
            if self._file is not None and self._file.behind:
                self._file.flush()
            begins = self._file is None
            file = self._file or self._begin(waiting)
            for item in waiting:
                if not (begins and isinstance(item, ModelUse)):  # a new file begins with the models
                    self._write(file, item)
            cycles = 0  # in the file's chunk from now on, even if this flush fails
            file.flush()
        except OSError as problem:
            self._refuse(cycles, problem)
            return
        self._recovered()
        self._rotate()

    def close(self) -> None:
        """Writes the remaining items and finishes the file."""
        self.flush()
        self._end()

    def _begin(self, items: Sequence[Item]) -> FlightFile:
        batches = [each.samples for each in items if isinstance(each, Batch) and len(each.samples)]
        now_ns = self._wall_ns()
        self._about = replace(self._about, offset_ns=now_ns - self._newest_ns)
        file = FlightFile(self._new_path(now_ns), self._about)
        self._file = file
        self._begun_ns = int(batches[0]["time_ns"][0]) if batches else self._newest_ns
        for each in self._models.values():
            file.add_model(self._newest_ns, each)
        return file

    def _write(self, file: FlightFile, item: Item) -> None:
        match item:
            case ModelUse():
                file.add_model(self._newest_ns, item)
            case Note():
                file.note(self._newest_ns, item.kind, item.text)
            case Batch():
                if item.lost:
                    file.note(
                        self._newest_ns,
                        "LOST",
                        f"{item.lost} cycles were lost before they were read",
                        logging.WARNING,
                    )
                if len(item.samples):
                    file.add_samples(item.samples)
                for event in item.events:
                    file.add_event(event)

    def _refuse(self, cycles: int, problem: OSError) -> None:
        """Counts cycles that cannot be written, and reports the first failure."""
        self.refused += cycles
        self._refused_since_error += cycles
        words = problem.strerror or str(problem)
        if not self._write_error:
            self._notify(f"{self.folder}: nothing is recorded: {words}; free some space")
        self._write_error = words

    def _recovered(self) -> None:
        if not self._write_error:
            return
        self._notify(
            f"{self.folder}: recording has resumed; {self._refused_since_error} cycles were not recorded "
            f"({self._write_error})"
        )
        if self._file is not None:
            self._file.note(
                self._newest_ns,
                "REFUSED_BY_DISK",
                f"{self._refused_since_error} cycles were not recorded",
                logging.WARNING,
            )
        self._write_error, self._refused_since_error = "", 0

    def _note_spans(self, items: Sequence[Item]) -> None:
        """Notes the time spans to keep."""
        marks = [self._newest_ns for each in items if isinstance(each, Note) and each.kind == MARK]
        events = [event for each in items if isinstance(each, Batch) for event in each.events]
        faults = [each.time_ns for each in events if each.kind in KEPT_FOR]
        before_ns, after_ns = (int(each * _NS) for each in (self._settings.before_s, self._settings.after_s))
        self._spans += [(each - before_ns, each + after_ns) for each in (*marks, *faults)]

    def _rotate(self) -> None:
        """Begins a new file once this one is large or old enough, or a span to keep is over."""
        file, settings = self._file, self._settings
        if file is None:
            return
        old_s = (self._newest_ns - self._begun_ns) / _NS
        over = any(end_ns <= self._newest_ns for _, end_ns in self._spans)
        # At least two files fit into the ring, because only whole files are removed.
        largest_mb = min(settings.file_mb, 0.5 * settings.size_mb, 0.5 * settings.kept_mb)
        if over or old_s >= settings.file_s or file.size >= largest_mb * _MB:
            self._end()
        else:
            self._remove_old(file.size)

    def _end(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.finish()
        except OSError as problem:
            self._refuse(0, problem)
            return
        self._files.append((file.path, self._begun_ns, self._newest_ns))
        self._keep_faults()
        self._remove_old()

    def _keep_faults(self) -> None:
        """Moves files with a fault aside, and forgets files that can no longer contain one."""
        horizon_ns = self._newest_ns - int(self._settings.before_s * _NS)
        left = []
        for path, begin_ns, end_ns in self._files:
            if any(begin_ns <= until_ns and end_ns >= since_ns for since_ns, until_ns in self._spans):
                with suppress(FileNotFoundError):  # removed by a user
                    self._move_to_kept(path)
            elif end_ns >= horizon_ns:
                left.append((path, begin_ns, end_ns))
        self._files = left
        self._spans = [each for each in self._spans if each[1] > self._newest_ns]

    # ------------------------------------------------------------------ the folder

    def _new_path(self, now_ns: int) -> Path:
        """Returns an unused name for the next file."""
        date = datetime.fromtimestamp(now_ns / _NS, UTC).strftime("%Y%m%dT%H%M%SZ")
        folders = (self.folder, self.folder / KEPT)
        stems = chain([date], (f"{date}-{number}" for number in count(2)))
        names = (f"{stem}-{self._about.machine}{SUFFIX}" for stem in stems)
        return self.folder / next(
            name
            for name in names
            if not any((folder / each).exists() for folder in folders for each in (name, name + PART))
        )

    def _move_to_kept(self, path: Path) -> None:
        """Moves a finished file to the kept ones."""
        kept = self.folder / KEPT
        kept.mkdir(exist_ok=True)
        path.rename(kept / path.name)

    def _remove_old(self, writing: int = 0) -> None:
        """Removes files over the limits; ``writing`` is the size of the open file."""
        limits, now_s = self._settings, self._wall_ns() / _NS
        _trim(self.folder, limits.size_mb * _MB - writing, now_s - limits.age_days * _DAY_S)
        gone = _trim(self.folder / KEPT, limits.kept_mb * _MB, -1.0)
        if gone:
            self._notify(
                f"{self.folder}: the recordings of faults exceed {limits.kept_mb:g} MB; removed: "
                f"{', '.join(each.name for each in gone)}"
            )


def _trim(folder: Path, most: float, oldest_s: float) -> list[Path]:
    """Removes files beyond ``most`` bytes in total or older than ``oldest_s``, oldest first; returns them."""
    files: list[tuple[Path, os.stat_result]] = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with suppress(FileNotFoundError):  # removed by a user
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
