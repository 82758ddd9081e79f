"""Reads flight recordings, finished or not: everything up to the last whole chunk."""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from zstandard import ZstdError

from hdbridge.daemon.recorder.about import About
from hdbridge.daemon.recorder.flightfile import EVENTS, MACHINE_TOPIC, MODEL, PART, axis_topic
from hdbridge.daemon.recorder.wire import AXIS, MACHINE
from hdbridge.errors import InputError
from hdbridge.files.regular import open_regular

SUFFIX: Final = ".mcap"
TORN: Final = (McapError, ZstdError, struct.error, ValueError, MemoryError)
"""What reading the end of a file that was cut off may raise; ValueError: a checksum that is wrong."""


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


def flight_files(paths: list[Path]) -> list[Path]:
    """Files as they are; of a folder its recordings and those that are kept, by their names, which begin with
    their dates. InputError where there is none.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = [
                each for each in path.rglob(f"*{SUFFIX}*") if each.name.endswith((SUFFIX, SUFFIX + PART))
            ]
            if not inside:
                raise InputError(f"{path}: no {SUFFIX} file in this folder; expected flight recordings")
            found += sorted(inside, key=lambda each: each.name)
        elif not path.exists():
            raise InputError(f"{path}: there is no such file or folder; expected a flight recording")
        elif not (path.is_file() and path.name.endswith((SUFFIX, SUFFIX + PART))):
            raise InputError(f"{path}: is no flight recording; expected a file that ends in {SUFFIX}")
        else:
            found.append(path)
    return found


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
    with _opened(path) as file:
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
    size = path.stat().st_size
    with _opened(path) as file:
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


def _opened(path: Path) -> BinaryIO:
    try:
        return open_regular(path)
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from None


def _told(message: Message) -> Told:
    content = json.loads(message.data)
    return Told(message.log_time, content["name"], content["kind"], content["text"])
