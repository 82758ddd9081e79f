"""Recordings of a fleet: folders, globs, fsspec URLs, and the manifest that describes them.

A source is one recording of one joint that has not been read yet. Errors in a single recording are found
later, by the worker that reads it; an invalid manifest or a location without recordings is an InputError.
"""

import csv
import glob
import hashlib
import io
import os
import posixpath
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from stat import S_ISREG
from tempfile import TemporaryDirectory
from typing import Any, Final

from hdbridge import __version__
from hdbridge.errors import InputError
from hdbridge.files.csvfile import text_of
from hdbridge.files.expectation import nearest, one_line
from hdbridge.files.profile import Profile
from hdbridge.records.recording import ABOUT_NAME, CSV_NAMES, recordings_among

FLIGHT: Final = (".mcap",)
BUS_LOG: Final = (".log", ".asc", ".blf", ".trc", ".mf4")
BUS_LOGS: Final = (*BUS_LOG, *(f"{each}.gz" for each in BUS_LOG))
MANIFEST: Final[Mapping[str, str]] = {
    "path": "recording, relative to the manifest's folder, or a URL",
    "joint": "name of the joint",
    "model": "model file of the joint, relative to the same",
    "ratio": "motor turns per load turn",
    "axis": "axis file, for a bus log; name of the axis, for a flight recording",
    "gear": "gear type; joints of one type are compared; by default the ratio",
    "batch": "group of the joint",
    "cell": "group of the joint",
    "lubricant": "group of the joint",
    "hours": "operating hours at the recording",
    "date": "date, ISO 8601",
    "columns": "option of that name for a CSV file",
    "units": "option of that name for a CSV file",
    "unwrap": "option of that name for a CSV file",
}
"""Columns of a manifest. Only ``path`` is required."""
NUMBERS: Final = ("ratio", "hours")
MANIFEST_NAMES: Final = ("manifest.csv", "manifest.parquet")
"""Names of files that are manifests, not recordings."""
MARKS: Final = ("size", "ETag", "mtime", "LastModified", "created")
"""Attributes of a remote file that change with its content, as named by fsspec's file systems."""


TIMEOUT_S: Final = 20.0
"""Default time-out for a server's first response."""


@dataclass(frozen=True)
class Source:
    """One recording of one joint, with the data known before reading it."""

    path: str
    joint: str | None = None
    model: str | None = None
    ratio: float | None = None
    axis: str | None = None
    gear: str | None = None
    batch: str | None = None
    cell: str | None = None
    lubricant: str | None = None
    hours: float | None = None
    date: str | None = None
    columns: str | None = None
    units: str | None = None
    unwrap: str | None = None
    stamp: str | None = None
    """Fingerprint of files and manifest row; equal to the data set's stamp if neither has changed."""
    axes: int | None = None
    """Number of axes in a flight recording."""

    @property
    def is_flight(self) -> bool:
        """True for a flight recording, which may hold several axes."""
        return self.path.endswith(FLIGHT)

    @property
    def order(self) -> tuple[float, str, str]:
        """Sort key of a joint's recordings by time: hours, else date, else name."""
        return (self.hours if self.hours is not None else -1.0, self.date or "", self.path)


class Stored:
    """Rows of a data set without their results, used to find the recordings that need not be read again."""

    def __init__(self, rows: Iterable[Mapping[str, Any]] = ()) -> None:
        self._rows: dict[str, dict[str | None, Mapping[str, Any]]] = defaultdict(dict)
        for row in rows:
            self._rows[row["path"]][row["axis"]] = row

    def row(self, source: Source) -> Mapping[str, Any] | None:
        """Returns the stored row of a source, even if the recording has changed since; None if not stored."""
        return self._rows[source.path].get(source.axis) if source.path in self._rows else None

    def unchanged(self, sources: Sequence[Source]) -> list[Mapping[str, Any]]:
        """Returns one file's stored rows; none if the file, its manifest rows or hdbridge have changed."""
        stamps = {each.stamp for each in sources} - {None}
        rows = [
            row
            for row in self._rows.get(sources[0].path, {}).values()
            if row["stamp"] in stamps and row["version"] == __version__
        ]
        return rows if rows and len(rows) == (rows[0]["axes"] or 1) else []


NOTHING_STORED: Final = Stored()


class NotFetchedError(InputError):
    """A remote recording cannot be fetched; its content is unknown."""


def find_sources(
    given: Sequence[str],
    manifest: Path | None = None,
    stored: Stored = NOTHING_STORED,
    *,
    may_be_empty: bool = False,
    timeout_s: float = TIMEOUT_S,
    report: Callable[[str], None] = lambda _: None,
) -> list[Source]:
    """Returns all recordings at the given locations and in the manifest, without repetition, sorted by path.

    InputError for a location that does not exist or has no recording (unless it ``may_be_empty``), for an
    invalid manifest, and for a manifest that is given as a location. Recordings unchanged since they were
    ``stored`` are not opened. ``timeout_s`` limits the wait for a server's first response. Ignored parts of
    the manifest are passed to ``report``.
    """
    found = read_manifest(manifest, report) if manifest else {}
    if not found and not given and not may_be_empty:
        raise InputError(
            f"{manifest}: no row; expected one for each recording, below the names of the columns"
        )
    own = manifest and os.path.abspath(manifest)  # noqa: PTH100 - as `_listing` does
    described = {path for path, _ in found}
    marks: dict[str, str] = {}
    for place in given:
        files = _listing(place, timeout_s)
        for each in [*files]:
            if posixpath.basename(each) in MANIFEST_NAMES or each == own:
                if not manifest:
                    raise InputError(f"{place}: contains a manifest; {_advice(each)}")
                del files[each]
        marked = _recordings(files, described)
        if not marked and not may_be_empty:
            raise InputError(
                f"{place}: no recording; expected recording folders, or files that end in .csv, .csv.gz "
                "or .mcap "
                "(a bus log needs a row in the manifest)"
            )
        marks |= marked
        for path in marked:
            if path not in described:
                found[path, None] = Source(path)
    marks |= _marks_of(described - marks.keys(), timeout_s)
    sources = [
        _with_about(replace(each, stamp=_stamp(each, marks.get(each.path))), stored)
        for each in found.values()
    ]
    return sorted(sources, key=lambda each: (each.path, each.axis or ""))


def _advice(manifest: str) -> str:
    """Describes how to pass a manifest found among recordings; ``--manifest`` requires a local file."""
    if "://" not in manifest:
        return f"pass it as well: --manifest {manifest}"
    name = posixpath.basename(manifest)
    return f"copy {manifest} to this computer, with URLs as paths, and pass the copy: --manifest {name}"


def _recordings(files: Mapping[str, str], described: Collection[str]) -> dict[str, str]:
    """Returns the recordings among files, each with the marks (size and times) of its files joined."""
    found = recordings_among(files)
    found |= {each: [each] for each in files if each.endswith(FLIGHT) or each in described}
    return {path: "\n".join(f"{each} {files[each]}" for each in own) for path, own in found.items()}


def _marks_of(paths: Collection[str], timeout_s: float) -> dict[str, str]:
    """Returns the marks (size and times) of the recordings in a manifest; omits missing recordings."""
    files: dict[str, str] = {}
    for place in {posixpath.dirname(path) if "://" in path else path for path in paths}:
        with suppress(InputError):  # the worker that reads the recording reports the error
            files |= _listing(place, timeout_s) if "://" in place else dict(_local(Path(place)))
    return _recordings(files, paths)


def _listing(place: str, timeout_s: float) -> dict[str, str]:
    """Returns all files at or below a folder, glob, file or URL, each with its mark: size and times.

    InputError if no file is found.
    """
    if "://" not in place:
        place = os.path.abspath(place)  # noqa: PTH100 - workers run in another folder
        matched = sorted(glob.glob(place, recursive=True)) if glob.has_magic(place) else [place]  # noqa: PTH207
        return {file: mark for each in matched for file, mark in _local(Path(each))}
    import fsspec
    from fsspec.exceptions import FSTimeoutError

    try:
        system, root = fsspec.core.url_to_fs(place)
        host = place.rstrip("/").removesuffix(root)  # protocol and host; paths from `system` lack them
        system.invalidate_cache()
        if system.async_impl:  # the other file systems have their own time-outs (SFTP: 15 s)
            try:
                system.info(root.partition("*")[0], timeout=timeout_s)
            except FSTimeoutError:
                raise TimeoutError(
                    f"no answer in {timeout_s:g} s; is it the right server? see --timeout"
                ) from None
            except Exception:  # the listing below reports the error
                pass
        files: dict[str, Any] = {}
        for each in system.glob(root) if glob.has_magic(root) else [root]:
            found = system.find(each, detail=True)
            if not found:  # `find` hides an unreachable server; `ls` raises an error
                with suppress(FileNotFoundError):
                    system.ls(each)
            files |= found
        return {
            host + file: " ".join(str(about.get(each)) for each in MARKS) for file, about in files.items()
        }
    except Exception as problem:  # each file system raises its own exception types
        raise InputError(one_line(f"{place}: cannot be listed: {problem}")) from None


def _local(path: Path) -> Iterator[tuple[str, str]]:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected recordings")
    for each in sorted(path.rglob("*")) if path.is_dir() else [path]:
        with suppress(OSError):  # removed in the meantime
            about = each.stat()
            if S_ISREG(about.st_mode):
                yield str(each), f"{about.st_size} {about.st_mtime_ns} {about.st_ctime_ns}"


def _stamp(source: Source, mark: str | None) -> str | None:
    """Hashes the mark of a recording and its row in the manifest; None for a missing recording."""
    if mark is None:
        return None
    if source.axis and source.path.endswith(BUS_LOGS):
        with suppress(InputError, OSError):  # the worker that reads the recording reports the error
            mark += Profile.find(source.axis).axis.read_text(encoding="utf-8")
    return hashlib.sha256("\n".join([mark, repr(source)]).encode()).hexdigest()


def _with_about(source: Source, stored: Stored) -> Source:
    """Fills in joint, ratio and date from ``recording.yaml``."""
    if source.joint is not None or source.path.endswith(CSV_NAMES + FLIGHT + BUS_LOGS):
        return source
    about: Mapping[str, Any] = {}
    row = stored.row(source)
    if row is not None and row["stamp"] == source.stamp is not None:
        about = {"axis": row["joint"] or None, "ratio": row["ratio"], "date": row["date"]}
    else:
        with suppress(Exception):  # the worker that reads the recording reports the error
            import fsspec
            import yaml

            with fsspec.open(f"{source.path}/{ABOUT_NAME}", "r", encoding="utf-8") as file:
                about = yaml.load(file, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
            about = {**about, "date": str(about["date"]) if about.get("date") else None}
            about["ratio"] = float(about["ratio"]) if about.get("ratio") else None
    return replace(
        source,
        joint=about.get("axis"),
        ratio=source.ratio or about.get("ratio"),
        date=source.date or about.get("date"),
    )


def read_manifest(
    path: Path, report: Callable[[str], None] = lambda _: None
) -> dict[tuple[str, str | None], Source]:
    """Reads a manifest, CSV or Parquet; returns sources by path and axis. InputError names the invalid row.

    Other columns and repeated rows are ignored and passed to ``report``.
    """
    names, rows = _table(path)
    ignored = [name for name in names if name and name not in MANIFEST]
    for name in ignored:
        if close := nearest(name, list(MANIFEST)):
            raise InputError(
                f"{path}: unknown column '{name}' (did you mean {close}?); expected {', '.join(MANIFEST)}"
            )
    if "path" not in names:
        raise InputError(f"{path}: the column 'path' is missing; found {', '.join(names) or 'nothing'}")
    if ignored:
        report(f"{path}: ignored unknown columns: {', '.join(ignored)}")
    found: dict[tuple[str, str | None], Source] = {}
    for number, row in enumerate(rows, 2):
        if not any(row.values()):
            continue  # a blank row of a spreadsheet
        source = _described({name: row[name] for name in MANIFEST if name in row}, path, number)
        key = (source.path, source.axis if source.is_flight else None)
        before = found.setdefault(key, source)
        if before != source:
            raise InputError(
                f"{path}:{number}: {row['path']} already has a row, with other values; expected one for each "
                "recording"
            )
        if before is not source:
            report(f"{path}:{number}: repeats the row of {row['path']}, which counts once")
    return found


def _table(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """Returns the names of the columns of a CSV or Parquet file, and its rows."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a manifest, CSV or Parquet")
    try:
        if path.suffix == ".parquet":
            import pyarrow.parquet as pq

            return pq.read_schema(path).names, pq.read_table(path).to_pylist()
        lines = io.StringIO(text_of(path)[0].decode(), newline="")
        head = lines.readline()
        lines.seek(0)
        separator = max(",;\t", key=head.count)
        reader = csv.DictReader(lines, strict=True, delimiter=separator)
        rows = list(reader)
        if separator != ",":  # such files use the comma as decimal separator
            rows = [row | {name: (row.get(name) or "").replace(",", ".") for name in NUMBERS} for row in rows]
        return list(reader.fieldnames or ()), rows
    except InputError:
        raise
    except Exception as problem:  # the readers raise many types of errors
        raise InputError(f"{path}: cannot be read: {str(problem).splitlines()[0]}") from None


def _described(row: Mapping[str, Any], manifest: Path, number: int) -> Source:
    folder = manifest.absolute().parent
    values: dict[str, Any] = {}
    for name, value in row.items():
        if value is None or not str(value).strip():
            continue
        if name in NUMBERS:
            try:
                values[name] = float(value)
            except ValueError:
                raise InputError(f"{manifest}:{number}: {name}: found '{value}'; expected a number") from None
        else:
            values[name] = str(value)
    if "path" not in values:
        raise InputError(f"{manifest}:{number}: path: found nothing; expected the path of a recording")
    for name in ("path", "model"):
        if name in values:
            remote = "://" in values[name]
            values[name] = values[name].rstrip("/") if remote else os.path.abspath(folder / values[name])  # noqa: PTH100
    source = Source(**values)
    if source.axis and source.path.endswith(BUS_LOGS) and (folder / source.axis).exists():
        source = replace(source, axis=str(folder / source.axis))
    return source


def with_axes(path: str, axes: Iterable[str | None], described: Iterable[Source]) -> list[Source]:
    """Returns one source for each axis of a flight recording, with the data of its manifest rows."""
    rows = {each.axis: each for each in described}
    common = rows.get(None) or Source(path, stamp=next(iter(rows.values())).stamp)
    found = [rows.get(name) or replace(common, axis=name, joint=common.joint or name) for name in axes]
    return [replace(each, axes=len(found)) for each in found]


@contextmanager
def fetched(path: str) -> Iterator[Path]:
    """Provides a recording as a local path; a remote one is copied to a temporary folder for the block.

    NotFetchedError if it cannot be fetched.
    """
    if "://" not in path:
        yield Path(path)
        return
    import fsspec

    with TemporaryDirectory(prefix="hdbridge-fleet-") as folder:
        target = Path(folder) / posixpath.basename(path)
        try:
            system, place = fsspec.core.url_to_fs(path)
            system.get(place, str(target), recursive=system.isdir(place))
        except Exception as problem:  # each file system raises its own exception types
            raise NotFetchedError(f"{path}: cannot be fetched: {problem}") from None
        yield target
