"""File of the flight recorder: MCAP, always complete up to its last flush.

Messages collect in a chunk in memory; `flush` writes the chunk and syncs it to the disk. An unfinished file
has all its chunks but no index; `mend` rewrites it as a finished file. Until it is finished, its name ends in
``.part`` and its writer holds a lock on it. Each file is self-contained, with the description of
the machine (`About`) and the models in use.
"""

import fcntl
import json
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from mcap.writer import CompressionType, Writer

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.channels import BY_KEY
from hdbridge.daemon.memory import Event, EventKind, SampleArray
from hdbridge.daemon.memory.layout import LEVELS
from hdbridge.daemon.recorder.wire import AXIS, MACHINE, Message, axis_messages, machine_messages
from hdbridge.errors import InputError
from hdbridge.records.recording import versions_here

FORMAT: Final = "hdbridge.flight/1"
MACHINE_NAME: Final = "hdbridge"
"""Name of the machine's metadata record; the name of an axis record is ``axis/NAME``."""
PART: Final = ".part"
KEPT: Final = "kept"
"""Subfolder for recordings that contain a fault."""
CHUNK_BYTES: Final = 64 << 20
"""Maximum size of a chunk. It exceeds a second's data, so chunks end at flushes."""
EVENTS: Final = "/events"
MODEL: Final = "/model"
MACHINE_TOPIC: Final = "/machine"
_TEXT: Final = {"type": "string"}
_NUMBER: Final = {"type": "integer"}
_EVENT_SCHEMA: Final = {
    "type": "object",
    "properties": {
        # The fields of Foxglove's log messages, so that its log panel shows the events.
        "timestamp": {"type": "object", "properties": {"sec": _NUMBER, "nsec": _NUMBER}},
        "level": _NUMBER,
        "message": _TEXT,
        "name": _TEXT,
        "file": _TEXT,
        "line": _NUMBER,
        "kind": _TEXT,
        "cycle": _NUMBER,
        "id": _NUMBER,
        "code": _NUMBER,
    },
}
_MODEL_SCHEMA: Final = {"type": "object", "properties": {"axis": _TEXT, "version": _TEXT, "text": _TEXT}}


@dataclass(frozen=True)
class AxisAbout:
    """Description of an axis."""

    name: str
    ratio: float
    text: str = ""
    """Text of its axis file."""
    identity: Identity | None = None
    """Identity that the axis file expects."""
    channels: tuple[str, ...] = ()
    """Record columns of ``reading0`` and ``reading1``."""

    @classmethod
    def of(cls, axis: AxisConfig) -> Self:
        """Returns the description from an axis file."""
        text = ""
        with suppress(OSError):  # the axis file is included for people only
            text = axis.path.read_text(encoding="utf-8")
        channels = tuple(BY_KEY[key].value for key in axis.channels)
        return cls(axis.name, axis.gear.ratio, text, axis.drive.identity, channels)

    def metadata(self, place: int) -> dict[str, str]:
        """Returns the description as an MCAP metadata record, whose values are text."""
        identity = self.identity.model_dump(exclude_none=True) if self.identity else {}
        return {
            "place": str(place),
            "ratio": repr(self.ratio),
            "channels": " ".join(self.channels),
            "axis_file": self.text,
            **{f"drive_{name}": hex(value) for name, value in identity.items()},
        }

    @classmethod
    def from_metadata(cls, name: str, data: Mapping[str, str]) -> Self:
        """Reads the result of `metadata`."""
        identity = {key[6:]: int(value, 16) for key, value in data.items() if key.startswith("drive_")}
        return cls(
            name,
            float(data["ratio"]),
            data["axis_file"],
            Identity.model_validate(identity) if identity else None,
            tuple(data["channels"].split()),
        )


@dataclass(frozen=True)
class About:
    """Description of the machine."""

    machine: str
    period_s: float
    axes: tuple[AxisAbout, ...]
    versions: Mapping[str, str] = field(default_factory=versions_here)
    offset_ns: int = 0
    """Time of day minus the clock of the samples, ns."""

    def metadata(self) -> dict[str, dict[str, str]]:
        """Returns the metadata records by name."""
        versions = {f"version_{name}": value for name, value in self.versions.items()}
        return {
            MACHINE_NAME: {
                "format": FORMAT,
                "machine": self.machine,
                "period_s": repr(self.period_s),
                "offset_ns": str(self.offset_ns),
                **versions,
            },
            **{f"axis/{each.name}": each.metadata(place) for place, each in enumerate(self.axes)},
        }

    @classmethod
    def from_metadata(cls, records: Mapping[str, Mapping[str, str]], path: Path) -> Self:
        """Reads the result of `metadata`; raises InputError if ``path`` is not an hdbridge recording."""
        machine = records.get(MACHINE_NAME, {})
        if machine.get("format") != FORMAT:
            raise InputError(
                f"{path}: found {machine.get('format', 'no format')}; expected a flight recording, {FORMAT}"
            )
        try:
            axes = sorted(
                (int(data["place"]), AxisAbout.from_metadata(name.removeprefix("axis/"), data))
                for name, data in records.items()
                if name.startswith("axis/")
            )
            return cls(
                machine["machine"],
                float(machine["period_s"]),
                tuple(each for _, each in axes),
                {name[8:]: value for name, value in machine.items() if name.startswith("version_")},
                int(machine["offset_ns"]),
            )
        except (KeyError, ValueError) as problem:
            raise InputError(f"{path}: its metadata are damaged: {problem}") from None


class ModelUse(NamedTuple):
    """Change of an axis's model."""

    axis: str
    version: str
    text: str


def axis_topic(name: str) -> str:
    """Returns the topic of an axis's samples."""
    return f"/axis/{name}/sample"


class _Stream:
    """Output stream of the MCAP writer; buffers bytes until `commit` syncs them to the disk.

    A failed commit leaves no partial data and can be repeated.
    """

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._waiting = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Does nothing, because the MCAP writer flushes at will but only `commit` may write."""

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    def commit(self) -> None:
        view = memoryview(bytes(self._waiting))
        done = 0
        try:
            while done < len(view):
                done += os.write(self.descriptor, view[done:])
            os.fsync(self.descriptor)
        except OSError:
            os.ftruncate(self.descriptor, self._written)
            os.lseek(self.descriptor, self._written, os.SEEK_SET)
            raise
        self._written += len(view)
        self._waiting.clear()


class FlightFile:
    """Writer of one file."""

    def __init__(self, path: Path, about: About) -> None:
        """``path`` is the name of the finished file. Raises OSError if it cannot be created."""
        self.path = path
        self._part = path.with_name(path.name + PART)
        self._about = about
        self._stream = _Stream(self._part)
        try:
            fcntl.flock(self._stream.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._writer = Writer(
                self._stream,  # type: ignore[arg-type]  # all that it asks of a stream
                chunk_size=CHUNK_BYTES,
                compression=CompressionType.ZSTD,
            )
            self._writer.start(library=f"hdbridge {about.versions.get('hdbridge', '')}".strip())
            for name, data in about.metadata().items():
                self._writer.add_metadata(name, data)
            self._machine = self._protobuf(MACHINE_TOPIC, self._schema(MACHINE))
            axis = self._schema(AXIS)
            self._axes = [self._protobuf(axis_topic(each.name), axis) for each in about.axes]
            self._events = self._json(EVENTS, "foxglove.Log", _EVENT_SCHEMA)
            self._models = self._json(MODEL, "hdbridge.Model", _MODEL_SCHEMA)
            self._stream.commit()
        except BaseException:
            self.abandon()
            self._part.unlink()
            raise

    @property
    def size(self) -> int:
        """Size so far, bytes."""
        return self._stream.tell()

    @property
    def behind(self) -> int:
        """Number of bytes that the last flush could not write."""
        return self._stream.waiting

    def add_samples(self, samples: SampleArray) -> None:
        """Adds one message per cycle for the machine and for each axis."""
        times = (samples["time_ns"] + self._about.offset_ns).tolist()
        numbers = (samples["sequence"] & 0xFFFFFFFF).tolist()
        self._add(self._machine, times, numbers, machine_messages(samples))
        for place, channel in enumerate(self._axes):
            self._add(channel, times, numbers, axis_messages(samples, place))

    def add_event(self, event: Event) -> None:
        axes = self._about.axes
        name = axes[event.axis].name if 0 <= event.axis < len(axes) else self._about.machine
        kind = EventKind(event.kind)
        level = max(LEVELS.get(kind, logging.INFO), logging.INFO)
        facts = {"cycle": event.cycle, "id": event.id, "code": event.code, "axis": event.axis}
        self.note(event.time_ns, kind.name, event.text, level, name, **facts)

    def note(
        self, time_ns: int, kind: str, text: str, level: int = logging.INFO, name: str = "", **facts: int
    ) -> None:
        """Adds a note of the recorder, a client or the loop; ``level`` is that of a log record.

        ``name`` is that of the axis, by default of the machine.
        """
        seconds, rest = divmod(time_ns + self._about.offset_ns, 1_000_000_000)
        content = {
            "timestamp": {"sec": seconds, "nsec": rest},
            "level": level // 10,  # Foxglove counts from DEBUG, 1
            "message": text or kind,
            "name": name or self._about.machine,
            "file": "",
            "line": 0,
            "kind": kind,
            "text": text,
        }
        self._put(self._events, time_ns, content | facts)

    def add_model(self, time_ns: int, use: ModelUse) -> None:
        """Adds the model that an axis uses from now on."""
        self._put(self._models, time_ns, use._asdict())

    def flush(self) -> None:
        """Writes new messages and syncs them to the disk. After an OSError, they wait for a retry."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.commit()

    def finish(self) -> None:
        """Writes the index and renames the file. After an OSError, it remains a part that can be repaired."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        try:
            self._stream.commit()
            self._part.rename(self.path)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Closes the file without finishing it."""
        if self._stream.descriptor >= 0:
            os.close(self._stream.descriptor)
            self._stream.descriptor = -1

    def _put(self, channel: int, time_ns: int, content: dict[str, Any]) -> None:
        at = time_ns + self._about.offset_ns
        self._writer.add_message(channel, at, json.dumps(content).encode(), at)

    def _add(
        self, channel: int, times: Sequence[int], numbers: Sequence[int], messages: Sequence[bytes]
    ) -> None:
        add = self._writer.add_message
        for time_ns, number, data in zip(times, numbers, messages, strict=True):
            add(channel, time_ns, data, time_ns, number)

    def _schema(self, message: Message) -> int:
        number: int = self._writer.register_schema(message.name, "protobuf", message.schema)
        return number

    def _protobuf(self, topic: str, schema: int) -> int:
        number: int = self._writer.register_channel(topic, "protobuf", schema)
        return number

    def _json(self, topic: str, name: str, schema: dict[str, Any]) -> int:
        number: int = self._writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
        channel: int = self._writer.register_channel(topic, "json", number)
        return channel
