"""The flight recorder without its thread: files, limits and retention.

Once a second, new data is written as one chunk and synced, so a kill loses at most the last second. Free
space is checked first: while the disk is full, data is dropped and counted, and the begin and end of this
are reported. A fault or a client's mark moves the files around its time aside, where the ring does not
remove them.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from hdbridge.daemon.memory import Event, EventKind, SampleArray
from hdbridge.daemon.recorder.about import About
from hdbridge.daemon.recorder.flightfile import FlightFile
from hdbridge.daemon.recorder.mend import mend_folder
from hdbridge.daemon.recorder.reading import overview
from hdbridge.daemon.recorder.store import Store
from hdbridge.errors import InputError

MESSAGE_BYTES: Final = 256
"""Maximum size of a message with its index entry, before compression."""
KEPT_FOR: Final = frozenset({EventKind.STOPPED, EventKind.BUS_DOWN, EventKind.UNDERRUN})
"""Events that count as a fault."""
MARK: Final = "MARK"
_KEPT_NAMES: Final = frozenset({each.name for each in KEPT_FOR} | {MARK})
_NS: Final = 1_000_000_000


class Batch(NamedTuple):
    """Data received from the observer at once."""

    samples: SampleArray | None
    events: tuple[Event, ...] = ()
    lost: int = 0


class ModelUse(NamedTuple):
    """Change of an axis's model."""

    axis: str
    version: str
    text: str


class Note(NamedTuple):
    """Note of another part of the daemon or a client."""

    kind: str
    text: str


Item = Batch | ModelUse | Note


@dataclass(slots=True)
class Counts:
    """Counts since the recorder began."""

    recorded: int = 0
    """Cycles on the disk."""
    lost: int = 0
    """Cycles lost because the observer was too slow."""
    dropped: int = 0
    """Cycles dropped because the recorder was too slow."""
    refused: int = 0
    """Cycles not written because the disk was full."""


class _Span(NamedTuple):
    """Time span around a fault; ns of the samples' clock."""

    begin_ns: int
    end_ns: int


class FlightLog:
    """Recorder without a thread: its owner calls `put` and, once a second, `flush`."""

    def __init__(
        self,
        store: Store,
        about: About,
        *,
        tell: Callable[[str], None] = lambda _: None,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """``tell`` reports events of the recording to the user; ``wall_ns`` returns the time of day."""
        self._store = store
        self._about = about
        self._tell = tell
        self._wall_ns = wall_ns
        self._file: FlightFile | None = None
        self._begun_ns = 0
        self._files: list[tuple[Path, int, int]] = []
        """Finished files of the ring, with their time spans, that a fault may still require."""
        self._spans: list[_Span] = []
        self._models: dict[str, ModelUse] = {}
        self._waiting: list[Item] = []
        self._newest_ns = 0
        self._trouble = ""
        self._refused_now = 0
        self._behind = 0
        """Cycles in a chunk that is not yet on the disk."""
        self.counts = Counts()
        store.folder.mkdir(parents=True, exist_ok=True)

    @property
    def folder(self) -> Path:
        """Folder of the recordings."""
        return self._store.folder

    def mend(self) -> None:
        """Mends files of a process that died, and keeps those that contain a fault."""
        for path in mend_folder(self._store.folder, self._tell):
            self._tell(f"{path.name}: was not finished; it is whole up to its last second")
            with suppress(InputError, OSError):
                if any(each.kind in _KEPT_NAMES for each in overview(path).events):
                    self._store.keep(path)
        self._store.trim(self._wall_ns())

    def put(self, item: Item) -> None:
        """Takes an item; it is on the disk after the next `flush`."""
        self._waiting.append(item)
        if isinstance(item, Batch) and item.samples is not None and len(item.samples):
            self._newest_ns = int(item.samples["time_ns"][-1])

    def flush(self) -> None:
        """Writes the items since the last flush."""
        waiting, self._waiting = self._waiting, []
        for item in waiting:  # a later file must contain the model as well
            if isinstance(item, ModelUse):
                self._models[item.axis] = item
        if not waiting and (self._file is None or not self._file.behind):
            return
        cycles = sum(
            len(each.samples) for each in waiting if isinstance(each, Batch) and each.samples is not None
        )
        size = cycles * (1 + len(self._about.axes)) * MESSAGE_BYTES
        try:
            if not self._store.room_for(size):
                raise OSError(f"less than {self._store.settings.free_mb:g} MB are free")
            if self._file is not None and self._file.behind:
                self._file.flush()
            begins = self._file is None
            file = self._file or self._begin(waiting)
            for item in waiting:
                if not (begins and isinstance(item, ModelUse)):  # a new file begins with the models
                    self._write(file, item)
            self._behind, cycles = self._behind + cycles, 0
            file.flush()
        except OSError as problem:
            self._note_spans(waiting)
            self._refuse(cycles, problem)
            return
        self._note_spans(waiting)
        self.counts.recorded += self._behind
        self._behind = 0
        self._recovered()
        self._cut()

    def close(self) -> None:
        """Writes the remaining items and finishes the file."""
        self.flush()
        self._end()

    def _begin(self, items: Sequence[Item]) -> FlightFile:
        batches = [each.samples for each in items if isinstance(each, Batch) and each.samples is not None]
        now_ns = self._wall_ns()
        self._about = replace(self._about, offset_ns=now_ns - self._newest_ns)
        file = FlightFile(self._store.new_path(self._about.machine, now_ns), self._about)
        self._file = file
        self._begun_ns = int(batches[0]["time_ns"][0]) if batches else self._newest_ns
        for each in self._models.values():
            file.add_model(self._newest_ns, each.axis, each.version, each.text)
        return file

    def _write(self, file: FlightFile, item: Item) -> None:
        match item:
            case ModelUse():
                file.add_model(self._newest_ns, item.axis, item.version, item.text)
            case Note():
                file.note(self._newest_ns, item.kind, item.text)
            case Batch():
                if item.lost:
                    self.counts.lost += item.lost
                    file.note(
                        self._newest_ns,
                        "LOST",
                        f"{item.lost} cycles were lost before they were read",
                        logging.WARNING,
                    )
                if item.samples is not None and len(item.samples):
                    file.add_samples(item.samples)
                for event in item.events:
                    file.add_event(event)

    def _refuse(self, cycles: int, problem: OSError) -> None:
        """Counts cycles that cannot be written, and reports the first failure."""
        self.counts.refused += cycles
        self._refused_now += cycles
        words = problem.strerror or str(problem)
        if not self._trouble:
            self._tell(f"{self._store.folder}: nothing is recorded: {words}; free some space")
        self._trouble = words

    def _recovered(self) -> None:
        if not self._trouble:
            return
        self._tell(
            f"{self._store.folder}: recorded again; {self._refused_now} cycles were not ({self._trouble})"
        )
        if self._file is not None:
            self._file.note(
                self._newest_ns,
                "REFUSED_BY_DISK",
                f"{self._refused_now} cycles were not recorded",
                logging.WARNING,
            )
        self._trouble, self._refused_now = "", 0

    def _note_spans(self, items: Sequence[Item]) -> None:
        """Notes the time spans to keep."""
        settings = self._store.settings
        for item in items:
            times = []
            if isinstance(item, Note) and item.kind == MARK:
                times.append(self._newest_ns)
            elif isinstance(item, Batch):
                times += [each.time_ns for each in item.events if each.kind in KEPT_FOR]
            self._spans += [
                _Span(each - int(settings.before_s * _NS), each + int(settings.after_s * _NS))
                for each in times
            ]

    def _cut(self) -> None:
        """Begins another file once this one is large or old enough, or a span to keep is over."""
        file, settings = self._file, self._store.settings
        if file is None:
            return
        old_s = (self._newest_ns - self._begun_ns) / _NS
        over = any(each.end_ns <= self._newest_ns for each in self._spans)
        if over or old_s >= settings.file_s or file.size >= settings.file_mb * 1e6:
            self._end()
        else:
            self._trim(file.size)

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
        self._keep()
        self._trim(0)

    def _keep(self) -> None:
        """Moves files aside that a fault requires, and forgets those that none can require any more."""
        horizon_ns = self._newest_ns - int(self._store.settings.before_s * _NS)
        left = []
        for path, begin_ns, end_ns in self._files:
            if any(begin_ns <= each.end_ns and end_ns >= each.begin_ns for each in self._spans):
                with suppress(FileNotFoundError):  # removed by a user
                    self._store.keep(path)
            elif end_ns >= horizon_ns:
                left.append((path, begin_ns, end_ns))
        self._files = left
        self._spans = [each for each in self._spans if each.end_ns > self._newest_ns]

    def _trim(self, writing: int) -> None:
        gone = self._store.trim(self._wall_ns(), writing)
        if gone:
            self._tell(
                f"{self._store.folder}: what is kept of faults is over {self._store.settings.kept_mb:g} MB; "
                f"removed: {', '.join(each.name for each in gone)}"
            )
