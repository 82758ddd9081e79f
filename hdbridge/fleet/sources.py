"""The recordings of a fleet: folders, globs, fsspec URLs, and the manifest that describes them.

A source is one recording of one joint that has not been read yet. Errors in a single recording are found
later, by the worker that reads it; a wrong manifest or a place without recordings is an InputError.
"""

from __future__ import annotations

import csv
import glob
import posixpath
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest
from hdbridge.records.recording import ABOUT_NAME

CSV: Final = (".csv", ".csv.gz")
FLIGHT: Final = (".mcap",)
BUS_LOG: Final = (".log", ".asc", ".blf", ".trc", ".mf4")
BUS_LOGS: Final = (*BUS_LOG, *(f"{each}.gz" for each in BUS_LOG))
MANIFEST: Final[Mapping[str, str]] = {
    "path": "recording, relative to the manifest's folder; or a URL",
    "joint": "name of the joint; the same in each of its recordings",
    "model": "model file of the joint, relative to the manifest's folder",
    "ratio": "motor turns per load turn",
    "axis": "axis file, for a bus log; name of the axis, for a flight recording",
    "gear": "type of the gear; joints of one type are compared. Without it: the ratio",
    "batch": "production batch",
    "cell": "place of work",
    "lubricant": "lubricant",
    "hours": "operating hours of the joint at the recording",
    "date": "when it was recorded, ISO 8601",
    "columns": "`--columns` of a CSV file",
    "units": "`--units` of a CSV file",
    "unwrap": "`--unwrap` of a CSV file",
}
"""Columns of a manifest. Only ``path`` is required."""


@dataclass(frozen=True)
class Source:
    """One recording of one joint, with the data known before it is read."""

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

    @property
    def is_flight(self) -> bool:
        """True for a flight recording, which may hold several axes."""
        return self.path.endswith(FLIGHT)

    @property
    def order(self) -> tuple[float, str, str]:
        """Sort key of a joint's recordings by time: hours, else date, else name."""
        return (self.hours if self.hours is not None else -1.0, self.date or "", self.path)


def find_sources(given: Sequence[str], manifest: Path | None = None) -> list[Source]:
    """Returns all recordings at the given places and in the manifest, each once, sorted by path.

    InputError for a place that does not exist or holds no recording, and for a wrong manifest.
    """
    described = read_manifest(manifest) if manifest else {}
    known = {path for path, _ in described}
    found: dict[tuple[str, str | None], Source] = dict(described)
    for place in given:
        paths = list(_recordings(place, known))
        if not paths:
            raise InputError(
                f"{place}: no recording; expected recording folders, or files that end in .csv, .csv.gz "
                "or .mcap "
                "(a bus log needs a row in the manifest)"
            )
        for path in paths:
            if path not in known:
                found.setdefault((path, None), _about(path))
    return sorted(found.values(), key=lambda each: (each.path, each.axis or ""))


def _recordings(place: str, described: Iterable[str]) -> Iterator[str]:
    """Yields the recordings at one place: a folder, a glob, a file or a URL."""
    if "://" not in place:
        matched = sorted(glob.glob(place, recursive=True)) if glob.has_magic(place) else [place]  # noqa: PTH207
        files = [file for each in matched for file in _local(Path(each))]
    else:
        import fsspec

        try:
            system, root = fsspec.core.url_to_fs(place)
            host = place.rstrip("/").removesuffix(root)  # protocol and host, which `system` paths lack
            matched = system.glob(root) if glob.has_magic(root) else [root]
            files = [
                host + file
                for each in matched
                for file in (system.find(each) if system.isdir(each) else [each])
            ]
        except (OSError, ValueError, ImportError) as problem:
            raise InputError(f"{place}: cannot be listed: {problem}") from None
    folders = {posixpath.dirname(each) for each in files if posixpath.basename(each) == ABOUT_NAME}
    logs = set(described)
    yield from folders
    for each in files:
        if posixpath.dirname(each) not in folders and (each.endswith(CSV + FLIGHT) or each in logs):
            yield each


def _local(path: Path) -> list[str]:
    if path.is_dir():
        return [str(each) for each in sorted(path.rglob("*")) if each.is_file()]
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected recordings")
    return [str(path)]


def _about(path: str) -> Source:
    """Returns the source of a path that no manifest describes; joint and date come from recording.yaml."""
    source = Source(path)
    if path.endswith(CSV + FLIGHT + BUS_LOGS):
        return source
    with suppress(Exception):  # the worker that reads the recording reports the error
        import fsspec
        import yaml

        with fsspec.open(f"{path}/{ABOUT_NAME}", "r", encoding="utf-8") as file:
            about = yaml.load(file, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        ratio, date = about.get("ratio"), about.get("date")
        return replace(
            source,
            joint=about.get("axis"),
            ratio=float(ratio) if ratio else None,
            date=str(date) if date else None,
        )
    return source


def read_manifest(path: Path) -> dict[tuple[str, str | None], Source]:
    """Reads a manifest, CSV or Parquet; sources by path and axis. InputError names the wrong row."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a manifest, CSV or Parquet")
    try:
        if path.suffix == ".parquet":
            import pyarrow.parquet as pq

            names, rows = pq.read_schema(path).names, pq.read_table(path).to_pylist()
        else:
            with path.open(encoding="utf-8-sig", newline="") as file:
                reader = csv.DictReader(file, strict=True)
                names, rows = list(reader.fieldnames or ()), list(reader)
    except Exception as problem:  # the readers raise many types of errors
        raise InputError(f"{path}: cannot be read: {str(problem).splitlines()[0]}") from None
    for name in names:
        if name not in MANIFEST:
            close = nearest(name, list(MANIFEST))
            hint = f" (did you mean {close}?)" if close else ""
            raise InputError(f"{path}: unknown column '{name}'{hint}; expected {', '.join(MANIFEST)}")
    if "path" not in names:
        raise InputError(f"{path}: the column 'path' is missing; found {', '.join(names) or 'nothing'}")
    found: dict[tuple[str, str | None], Source] = {}
    for number, row in enumerate(rows, 2):
        source = _described(row, path, number)
        key = (source.path, source.axis if source.is_flight else None)
        if key in found:
            raise InputError(
                f"{path}:{number}: {row['path']} has a row already; expected one for each recording"
            )
        found[key] = source
    return found


def _described(row: Mapping[str, Any], manifest: Path, number: int) -> Source:
    values: dict[str, Any] = {}
    for name, value in row.items():
        if name is None or (isinstance(value, str) and not value.strip()) or value is None:
            continue
        if name in {"ratio", "hours"}:
            try:
                values[name] = float(value)
            except ValueError:
                raise InputError(f"{manifest}:{number}: {name}: found '{value}'; expected a number") from None
        else:
            values[name] = str(value)
    if "path" not in values:
        raise InputError(f"{manifest}:{number}: path: found nothing; expected the path of a recording")
    for name in ("path", "model"):
        if name in values and "://" not in values[name]:
            values[name] = str(manifest.parent / values[name])
    source = Source(**values)
    if source.axis and source.path.endswith(BUS_LOGS) and (manifest.parent / source.axis).exists():
        source = replace(source, axis=str(manifest.parent / source.axis))
    if source.joint is None and not source.is_flight:
        about = _about(source.path)
        source = replace(
            source,
            joint=about.joint,
            ratio=source.ratio or about.ratio,
            date=source.date or about.date,
        )
    return source


def with_axes(path: str, axes: Iterable[str], described: Iterable[Source]) -> list[Source]:
    """Returns one source for each axis of a flight recording; rows of the manifest describe some of them."""
    rows = {each.axis: each for each in described}
    common = rows.get(None, Source(path))
    return [rows.get(name) or replace(common, axis=name, joint=common.joint or name) for name in axes]


@contextmanager
def fetched(path: str) -> Iterator[Path]:
    """Provides a recording as a local path; a remote one is copied to a temporary folder for the block.

    InputError if it cannot be fetched.
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
        except Exception as problem:  # each file system raises its own
            raise InputError(f"{path}: cannot be fetched: {problem}") from None
        yield target
