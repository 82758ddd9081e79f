"""Recording: a record, its segments and its provenance, as one folder or as CSV files of another program.

The folder contains ``record.csv.gz`` (several files if the record has several parts) and ``recording.yaml``.
``recording.yaml`` is written last and contains the checksums. A folder without it is therefore not a
recording, and changes of the raw data are detected.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
import platform
import posixpath
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal, Self

from pydantic import Field, model_validator

from hdbridge.axis import Identity
from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder
from hdbridge.files.yamlfile import Hex, dump_yaml, read_yaml, write_atomically, wrong
from hdbridge.records.columns import CsvColumns, Said
from hdbridge.records.record import Record, concatenate, time_shifts_s
from hdbridge.strictness import Strict

GAP_CYCLES: Final = 5
"""Maximum length of a gap, cycles, within which the motor cannot reverse and return unnoticed."""
PART_SAMPLES: Final = 50
"""Minimum number of samples in a part of a recording that is cut at its gaps; shorter parts are omitted."""
RECORD_NAME = "record.csv.gz"
ABOUT_NAME = "recording.yaml"
CSV_NAMES: Final = (".csv", ".csv.gz")
"""Suffixes of CSV file names."""
HEADER = "# What was recorded next to this file, by hdbridge. docs/files.md describes its keys.\n"
"""First line of ``recording.yaml``."""


class Segment(Strict):
    """One leg of the motion."""

    kind: str = Field(min_length=1, description="purpose: precondition, standstill, sweep, sine, step, ...")
    start_s: float = Field(description="time of its first sample")
    end_s: float = Field(description="time of its last sample")
    notes: dict[str, Any] = Field(default_factory=dict, description="free notes")

    @model_validator(mode="after")
    def _forwards(self) -> Self:
        if self.end_s < self.start_s:
            raise wrong(f"found {self.end_s:g}; expected no less than start_s, {self.start_s:g}", "end_s")
        return self


class RecordedFile(Strict):
    """A CSV file of the recording, with its checksum."""

    name: str = Field(pattern=r"^[^/\\]+$", description="file name in this folder")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="checksum")
    samples: int = Field(ge=0, description="rows")

    @classmethod
    def of(cls, path: Path, samples: int) -> Self:
        """Returns the description of a recording file on disk."""
        return cls(name=path.name, sha256=sha256_of(path), samples=samples)


class RecordingFile(Strict):
    """Content of ``recording.yaml``."""

    schema_: Literal["hdbridge.recording/1"] = Field(
        alias="schema", description="schema and version of this file"
    )
    axis: str | None = Field(None, description="name of the axis")
    ratio: float | None = Field(None, gt=0, le=1000, description="N: motor turns per load turn")
    drive: Identity | None = Field(None, description="identity of the drive")
    date: str | None = Field(None, description="date, ISO 8601")
    versions: dict[str, str] = Field(default_factory=dict, description="versions of the software")
    notes: dict[str, Any] = Field(default_factory=dict, description="seed, scheme, model, ...")
    files: tuple[RecordedFile, ...] = Field(min_length=1, description="CSV files, in order of time")
    segments: tuple[Segment, ...] = Field((), description="legs of the motion, in order of time")

    @classmethod
    def made(cls, **values: Any) -> RecordingFile:
        """Creates the content without validation, which would reject a new recording without files."""
        return cls.model_construct(schema_="hdbridge.recording/1", **values)

    def write(self, folder: Path) -> None:
        """Writes ``recording.yaml`` atomically, without empty values."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True)
        if self.drive is not None:
            data["drive"] = {name: Hex(value) for name, value in data["drive"].items()}
        data = {name: value for name, value in data.items() if value not in ({}, [])}
        write_atomically(folder / ABOUT_NAME, HEADER + dump_yaml(data))


_COMMON: Final = ("axis", "ratio", "drive", "date", "versions", "notes")
"""Attributes that a recording and its ``recording.yaml`` share."""


@dataclass(frozen=True)
class Recording:
    """A record with its segments and provenance; for a plain CSV file, only the record."""

    record: Record
    segments: tuple[Segment, ...] = ()
    axis: str | None = None
    ratio: float | None = None
    drive: Identity | None = None
    date: str | None = None
    versions: dict[str, str] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, *paths: Path | str, columns: Said = None, units: Said = None, unwrap: Said = None) -> Self:
        """Reads recording folders and CSV files as one recording, in the given order.

        ``columns``, ``units`` and ``unwrap`` apply to CSV files of other programs; see `Record.read_csv`.
        Raises `InputError` for any error in the files, and for files that have changed since they were
        recorded.
        """
        said = CsvColumns.of(columns, units, unwrap)
        return cls.joined([cls._load_one(Path(path), said) for path in paths])

    @classmethod
    def _load_one(cls, path: Path, said: CsvColumns) -> Self:
        if not path.is_dir():
            return cls(Record.of_csv(path, said))
        if said:
            raise InputError(
                f"{path}: --columns, --units and --unwrap are for CSV files, and this is a recording; read "
                "it without them"
            )
        if not (path / ABOUT_NAME).exists():
            raise InputError(
                f"{path}: no {ABOUT_NAME} in this folder; expected a recording, or name its CSV files"
            )
        document = read_yaml(path / ABOUT_NAME)
        about = document.validate(RecordingFile)
        records = []
        for number, each in enumerate(about.files):
            file = path / each.name
            with suppress(OSError):  # `Record.read_csv` reports it
                if file.is_file() and sha256_of(file) != each.sha256:
                    raise document.error(
                        ("files", number, "sha256"),
                        f"{file} has changed since it was recorded; restore it, or read it alone as a "
                        "CSV file",
                    )
            records.append(replace(Record.read_csv(file, minimum_samples=0), origin=None))
        record = records[0] if len(records) == 1 else concatenate(records)
        return cls(record, about.segments, **{name: getattr(about, name) for name in _COMMON})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Joins recordings in the given order; attributes in which they differ are left at their defaults."""
        if len(parts) == 1:
            return parts[0]
        records = [each.record for each in parts]
        shifts = time_shifts_s(records)
        segments = [
            segment.model_copy(update={"start_s": segment.start_s + shift, "end_s": segment.end_s + shift})
            for each, shift in zip(parts, shifts, strict=True)
            for segment in each.segments
        ]
        common: dict[str, Any] = {}
        for name in _COMMON:
            first, *others = (getattr(each, name) for each in parts)
            if all(each == first for each in others):
                common[name] = first
        return cls(concatenate(records), tuple(segments), **common)

    def save(self, folder: Path | str) -> None:
        """Writes the recording to a folder, with one file per part of the record.

        Raises `InputError` if the folder already contains a recording, because raw data are never replaced.
        """
        folder = Path(folder)
        if (folder / ABOUT_NAME).exists():
            raise InputError(f"{folder}: already contains a recording; expected a new folder")
        make_folder(folder)
        parts = self.record.parts()
        files = []
        for number, part in enumerate(parts, 1):
            path = folder / (RECORD_NAME if len(parts) == 1 else f"record-{number:03d}.csv.gz")
            part.write_csv(path)
            files.append(RecordedFile.of(path, len(part)))
        common = {name: getattr(self, name) for name in _COMMON}
        RecordingFile.made(files=tuple(files), segments=self.segments, **common).write(folder)

    def pieces(self, *kinds: str) -> Iterator[tuple[Segment, Record]]:
        """Yields each segment of these kinds (by default all kinds) with its samples."""
        for segment in self.segments:
            if not kinds or segment.kind in kinds:
                yield segment, self.record.between(segment.start_s, segment.end_s)


def recordings_among(files: Iterable[str]) -> dict[str, list[str]]:
    """Returns the recordings among files (paths or URLs) that `Recording.load` reads, with their files.

    A folder with ``recording.yaml`` is one recording, and each CSV file elsewhere is another. A folder with
    raw data but without ``recording.yaml``, which is written last, is still incomplete and is omitted.
    """
    folders: dict[str, list[str]] = {}
    for each in files:
        if each.endswith(CSV_NAMES) or PurePosixPath(each).name == ABOUT_NAME:
            folders.setdefault(posixpath.dirname(each) or ".", []).append(each)
    found: dict[str, list[str]] = {}
    for folder, own in folders.items():
        if any(PurePosixPath(each).name == ABOUT_NAME for each in own):
            found[folder] = own
        elif not any(_is_raw(each) for each in own):
            found |= {each: [each] for each in own}
    return found


def _is_raw(path: str) -> bool:
    """Returns True for the name of a file that `Recording.save` writes before ``recording.yaml``."""
    name = PurePosixPath(path)
    return name.name == RECORD_NAME or name.match("record-[0-9][0-9][0-9]*.csv.gz")


def versions_here() -> dict[str, str]:
    """Returns the software versions to be stored in a recording or a model of this process."""
    return dict(_versions())


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    packages = ("hdbridge", "numpy", "scipy", "python-can", "canopen")
    named = [(each, importlib.metadata.version(each)) for each in packages]
    return (*named, ("python", platform.python_version()))


def sha256_of(path: Path) -> str:
    """Returns the checksum of a file's bytes, as in ``recording.yaml``."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


Given = Record | Recording | Sequence[Record | Recording] | Mapping[Path, Recording]
"""One recording, or several in chronological order; messages name them by the keys of a mapping."""


def by_name(given: Given) -> dict[Path, Recording]:
    """Returns the recordings by their name in messages (file or number); `InputError` without a recording."""
    if isinstance(given, Mapping):
        named = dict(given)
    else:
        several = [given] if isinstance(given, Record | Recording | str | Path) else list(given)
        for each in several:
            if not isinstance(each, Record | Recording):
                raise InputError(
                    f"{each!r} is not a recording; expected a Record or Recording: Recording.load(path) "
                    "reads a folder or a CSV file"
                )
        recordings = [Recording(each) if isinstance(each, Record) else each for each in several]
        sources = [each.record.source for each in recordings]
        named = {
            Path(source if source and sources.count(source) == 1 else f"recording {number}"): each
            for number, (source, each) in enumerate(zip(sources, recordings, strict=True), 1)
        }
    if not named:
        raise InputError("no recording; give at least one Record or Recording")
    return named


def agreed_ratio(recordings: Mapping[Path, Recording], said: Iterable[tuple[str, float | None]]) -> float:
    """Returns the gear ratio on which the recordings and ``said`` (pairs of source and value) agree.

    Raises `InputError` if they disagree, if one is not positive, or if none of them states a ratio.
    """
    said = [*said, *((f"{name}", each.ratio) for name, each in recordings.items())]
    known = [(where, value) for where, value in said if value is not None]
    if not known:
        raise InputError(
            f"{next(iter(recordings))}: the ratio of the gear is unknown; state it, or name the axis (on the "
            "command line: --ratio N or --axis PROFILE)"
        )
    for where, value in known:
        if not 0.0 < value < math.inf:
            raise InputError(f"{where}: a ratio of {value:g}; expected a number above 0")
        if abs(value / known[0][1] - 1.0) > 1e-9:
            raise InputError(
                f"{known[0][0]}: a ratio of {known[0][1]:g}, but {where} has {value:g}; expected one gear: "
                "correct the wrong one, or leave out the other gear's record"
            )
    return known[0][1]
