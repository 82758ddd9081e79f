"""Reading of flight recordings, finished or not, up to their last complete chunk.

The recorder may be active in the same folder. It renames a file when it is finished or kept, and removes old
files. A recording is found under its current name as long as it exists.
"""

import json
import os
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, TypeVar

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from zstandard import ZstdError

from hdbridge.daemon.recorder.flightfile import (
    EVENTS,
    KEPT,
    MACHINE_TOPIC,
    MODEL,
    PART,
    About,
    ModelUse,
    axis_topic,
)
from hdbridge.daemon.recorder.wire import AXIS, MACHINE
from hdbridge.errors import InputError
from hdbridge.files.atomic import open_regular

T = TypeVar("T")
SUFFIX: Final = ".mcap"
TRUNCATION_ERRORS: Final = (McapError, ZstdError, struct.error, ValueError, MemoryError)
"""Exceptions raised at the end of a truncated file; ValueError for a wrong checksum."""


class GoneError(InputError):
    """The recording no longer exists, because the recorder or a user has removed it."""


class LoggedEvent(NamedTuple):
    """Event of a recording."""

    time_ns: int
    """Time of day, ns."""
    name: str
    """Name of the axis or the machine."""
    kind: str
    text: str


@dataclass(eq=False)
class Flight:
    """Content of one file, or its summary."""

    path: Path
    """Current name."""
    about: About
    finished: bool
    """True if the file has its index; else it was cut off or is being written."""
    first_ns: int
    """Times of day of the first and the last message, ns."""
    last_ns: int
    size: int
    """Bytes."""
    cycles: int
    events: tuple[LoggedEvent, ...]
    axes: Mapping[str, Mapping[str, NDArray[Any]]] = field(default_factory=dict)
    """Requested sample fields as columns, by axis."""
    machine: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    models: tuple[ModelUse, ...] = ()
    """Changes of model, oldest first."""


def flight_files(paths: Sequence[Path]) -> list[Path]:
    """Returns the given files, and the recordings of each folder by date, including kept ones.

    Raises InputError for a folder without recordings.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = _inside(path)
            if not inside:
                raise InputError(f"{path}: no {SUFFIX} file in this folder; expected flight recordings")
            found += sorted(inside, key=lambda each: each.name)
        elif path.name.endswith((SUFFIX, SUFFIX + PART)):
            found.append(path)
        else:
            problem = "not a flight recording" if path.exists() else "no such file or folder"
            raise InputError(f"{path}: {problem}; expected a file that ends in {SUFFIX}, or a folder of them")
    return found


def _inside(folder: Path) -> list[Path]:
    """Returns the recordings of a folder, each once, even if files are renamed meanwhile."""
    found: dict[Path, Path] = {}
    for _ in range(2):  # a file that is renamed during the first pass may be missed by it
        for place, _, names in os.walk(folder):
            for name in names:
                if name.endswith((SUFFIX, SUFFIX + PART)):
                    path = Path(place, name)
                    found.setdefault(_places(path)[-1], path)
    return [*found.values()]


def _places(path: Path) -> tuple[Path, ...]:
    """Returns the successive names of a recording, from ``path`` on."""
    finished = path.with_name(path.name.removesuffix(PART))
    kept = finished if path.parent.name == KEPT else path.parent / KEPT / finished.name
    return (path, finished, kept)


def each_flight(paths: Sequence[Path], look: Callable[[Path], T]) -> Iterator[T]:
    """Calls ``look`` for each recording of files and folders; yields the results.

    Skips a recording that the recorder removes meanwhile; raises `GoneError` if it was named explicitly.
    """
    for path in flight_files(paths):
        try:
            yield look(path)
        except GoneError:
            if path in paths:
                raise


def records_of(file: BinaryIO, where: Path) -> Iterator[McapRecord]:
    """Yields every record up to the last complete chunk; the last is a `Footer` only in a finished file.

    Raises InputError if the file is not MCAP.
    """
    try:
        yield from StreamReader(file, validate_crcs=True).records
    except (InvalidMagic, struct.error) as problem:
        if file.tell() > 16:
            return
        raise InputError(f"{where}: is not an MCAP file; expected a flight recording") from problem
    except TRUNCATION_ERRORS:
        return


def read(path: Path, axes: tuple[str, ...] | None = None) -> Flight:
    """Reads a file; ``axes`` selects the axes whose samples are read (None for all).

    Raises InputError, which names the file.
    """
    topics: dict[int, str] = {}
    messages: dict[str, list[bytes]] = defaultdict(list)
    metadata: dict[str, Mapping[str, str]] = {}
    events: list[LoggedEvent] = []
    models: list[ModelUse] = []
    times: list[int] = []
    finished = False
    wanted = None if axes is None else {MACHINE_TOPIC, *map(axis_topic, axes)}
    path, opened = _opened(path)
    with opened as file:
        size = os.fstat(file.fileno()).st_size
        for record in records_of(file, path):
            if isinstance(record, Message):
                topic = topics.get(record.channel_id, "")
                if topic == EVENTS:
                    events.append(_logged_event(record))
                elif topic == MODEL:
                    models.append(ModelUse(**json.loads(record.data)))
                elif wanted is None or topic in wanted:
                    messages[topic].append(record.data)
                times.append(record.log_time)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                metadata[record.name] = record.metadata
            elif isinstance(record, Footer):
                finished = True
    about = About.from_metadata(metadata, path)
    try:
        chosen = [each.name for each in about.axes if axes is None or each.name in axes]
        machine = MACHINE.decode(messages[MACHINE_TOPIC])
        return Flight(
            path, about, finished, min(times, default=0), max(times, default=0), size, len(machine["cycle"]),
            tuple(events), {name: AXIS.decode(messages[axis_topic(name)]) for name in chosen}, machine,
            tuple(models),
        )  # fmt: skip
    except InputError as problem:
        raise InputError(f"{path}: {problem}") from None


def overview(path: Path) -> Flight:
    """Returns the summary of a finished file without reading its samples; reads others in full."""
    path, opened = _opened(path)
    with opened as file:
        try:
            reader = SeekingReader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise EndOfFile
            metadata = {each.name: each.metadata for each in reader.iter_metadata()}
            events = tuple(_logged_event(message) for _, _, message in reader.iter_messages(EVENTS))
        except (*TRUNCATION_ERRORS, OSError):
            return replace(read(path, ()), finished=False)
        size = os.fstat(file.fileno()).st_size
    about = About.from_metadata(metadata, path)
    counted = summary.statistics
    (machine,) = (number for number, each in summary.channels.items() if each.topic == MACHINE_TOPIC)
    cycles = counted.channel_message_counts.get(machine, 0)
    return Flight(
        path, about, True, counted.message_start_time, counted.message_end_time, size, cycles, events
    )


def _opened(path: Path) -> tuple[Path, BinaryIO]:
    """Opens a recording; returns its current name and the open file."""
    for place in _places(path):
        try:
            return place, open_regular(place)
        except FileNotFoundError:
            continue
        except OSError as problem:
            raise InputError(f"{place}: cannot be read: {problem.strerror}") from None
    raise GoneError(f"{path}: there is no such file or folder; expected a flight recording")


def _logged_event(message: Message) -> LoggedEvent:
    content = json.loads(message.data)
    return LoggedEvent(message.log_time, content["name"], content["kind"], content["text"])
