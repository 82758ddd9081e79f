"""Reads flight recordings, finished or not: everything up to the last whole chunk.

The recorder may be at work in the same folder: a file is renamed when it is finished and when it is kept, and
removed when the folder is full. A recording is found under its present name as long as it exists.
"""

from __future__ import annotations

import json
import os
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, TypeVar

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from zstandard import ZstdError

from hdbridge.daemon.recorder.about import About
from hdbridge.daemon.recorder.flightfile import EVENTS, KEPT, MACHINE_TOPIC, MODEL, PART, axis_topic
from hdbridge.daemon.recorder.wire import AXIS, MACHINE
from hdbridge.errors import InputError
from hdbridge.files.regular import open_regular

T = TypeVar("T")
SUFFIX: Final = ".mcap"
TORN: Final = (McapError, ZstdError, struct.error, ValueError, MemoryError)
"""What reading the end of a file that was cut off may raise; ValueError: a checksum that is wrong."""


class GoneError(InputError):
    """The recording does not exist any more: the recorder, or a person, has removed it."""


class Told(NamedTuple):
    """An event of a recording."""

    time_ns: int
    """Time of day."""
    name: str
    """Of the axis, or of the machine."""
    kind: str
    text: str


class ModelUsed(NamedTuple):
    """The model that an axis used from a time on."""

    time_ns: int
    axis: str
    version: str
    text: str


@dataclass(eq=False)
class Flight:
    """What one file holds."""

    path: Path
    about: About
    finished: bool
    """Whether it has its index; else it was cut off, or is being written."""
    first_ns: int
    """Time of day of the first message, and of the last."""
    last_ns: int
    axes: Mapping[str, Mapping[str, NDArray[Any]]] = field(default_factory=dict)
    """By axis: a column for each field of a sample, as far as they were asked for."""
    machine: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    events: tuple[Told, ...] = ()
    models: tuple[ModelUsed, ...] = ()


def flight_files(paths: Sequence[Path]) -> list[Path]:
    """Files as they are; for a folder its recordings, kept ones included, in the order of their dates.

    InputError if a folder has none.
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
    """The recordings of a folder, each once, whatever is renamed meanwhile."""
    found: dict[Path, Path] = {}
    for _ in range(2):  # a file that is renamed during the first look may be missing from it
        for place, _, names in os.walk(folder):
            for name in names:
                if name.endswith((SUFFIX, SUFFIX + PART)):
                    path = Path(place, name)
                    found.setdefault(_places(path)[-1], path)
    return [*found.values()]


def _places(path: Path) -> tuple[Path, ...]:
    """The names that a recording has one after the other, from ``path`` on."""
    finished = path.with_name(path.name.removesuffix(PART))
    kept = finished if path.parent.name == KEPT else path.parent / KEPT / finished.name
    return (path, finished, kept)


def each_flight(paths: Sequence[Path], look: Callable[[Path], T]) -> Iterator[T]:
    """``look`` at each recording of files and folders.

    One that the recorder removes meanwhile is left out; `GoneError` if it was named itself.
    """
    for path in flight_files(paths):
        try:
            yield look(path)
        except GoneError:
            if path in paths:
                raise


def records_of(file: BinaryIO, where: Path) -> Iterator[McapRecord]:
    """Every record up to the last whole chunk; the last one is a `Footer` only of a finished file.

    InputError where it is no MCAP file at all.
    """
    try:
        yield from StreamReader(file, validate_crcs=True).records
    except (InvalidMagic, struct.error) as problem:
        if file.tell() > 16:
            return
        raise InputError(f"{where}: is no MCAP file; expected a flight recording") from problem
    except TORN:
        return


def read(path: Path, axes: tuple[str, ...] | None = None) -> Flight:
    """All of a file; ``axes`` names those whose samples are wanted (None: all). InputError names the file."""
    topics: dict[int, str] = {}
    messages: dict[str, list[bytes]] = defaultdict(list)
    metadata: dict[str, Mapping[str, str]] = {}
    events: list[Told] = []
    models: list[ModelUsed] = []
    times: list[int] = []
    finished = False
    wanted = None if axes is None else {MACHINE_TOPIC, *map(axis_topic, axes)}
    path, opened = _opened(path)
    with opened as file:
        for record in records_of(file, path):
            if isinstance(record, Message):
                topic = topics.get(record.channel_id, "")
                if topic == EVENTS:
                    events.append(_told(record))
                elif topic == MODEL:
                    models.append(ModelUsed(record.log_time, **json.loads(record.data)))
                elif wanted is None or topic in wanted:
                    messages[topic].append(record.data)
                times.append(record.log_time)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                metadata[record.name] = record.metadata
            elif isinstance(record, Footer):
                finished = True
    try:
        about = About.from_metadata(metadata)
        chosen = [each.name for each in about.axes if axes is None or each.name in axes]
        return Flight(
            path, about, finished, min(times, default=0), max(times, default=0),
            {name: AXIS.decode(messages[axis_topic(name)]) for name in chosen},
            MACHINE.decode(messages[MACHINE_TOPIC]), tuple(events), tuple(models),
        )  # fmt: skip
    except InputError as problem:
        raise InputError(f"{path}: {problem}") from None


class Overview(NamedTuple):
    """What the index of a file says."""

    path: Path
    about: About
    finished: bool
    first_ns: int
    last_ns: int
    size: int
    events: tuple[Told, ...]
    cycles: int


def overview(path: Path) -> Overview:
    """Of a finished file from its index, without reading its samples."""
    path, opened = _opened(path)
    with opened as file:
        size = os.fstat(file.fileno()).st_size
        try:
            reader = SeekingReader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise EndOfFile
            metadata = {each.name: each.metadata for each in reader.iter_metadata()}
            events = tuple(_told(message) for _, _, message in reader.iter_messages(EVENTS))
            counted = summary.statistics
            cycles = sum(
                counted.channel_message_counts.get(number, 0)
                for number, each in summary.channels.items()
                if each.topic == MACHINE_TOPIC
            )
        except (*TORN, OSError):
            flight = read(path, ())
            cycles = len(flight.machine["cycle"])
            return Overview(
                path, flight.about, False, flight.first_ns, flight.last_ns, size, flight.events, cycles
            )  # fmt: skip
    try:
        about = About.from_metadata(metadata)
    except InputError as problem:
        raise InputError(f"{path}: {problem}") from None
    return Overview(
        path, about, True, counted.message_start_time, counted.message_end_time, size, events, cycles
    )


def _opened(path: Path) -> tuple[Path, BinaryIO]:
    """The recording under its present name, opened."""
    for place in _places(path):
        try:
            return place, open_regular(place)
        except FileNotFoundError:
            continue
        except OSError as problem:
            raise InputError(f"{place}: cannot be read: {problem.strerror}") from None
    raise GoneError(f"{path}: there is no such file or folder; expected a flight recording")


def _told(message: Message) -> Told:
    content = json.loads(message.data)
    return Told(message.log_time, content["name"], content["kind"], content["text"])
