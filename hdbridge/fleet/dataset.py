"""Rows of a fleet as Parquet: written in increments during a run, and compacted at its end.

`OUT/recordings` and `OUT/findings` contain the result, sorted and partitioned by the first digit of the key,
so the same recordings always result in the same bytes. `OUT/increments` contains rows that are not compacted
yet; a killed run leaves them behind, and the next run includes them. docs/files.md describes the columns,
which are a contract.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder, sole_writer, write_atomically
from hdbridge.fleet.sources import Stored

if TYPE_CHECKING:
    import pyarrow as pa

RECORDINGS: Final = "recordings"
FINDINGS: Final = "findings"
INCREMENTS: Final = "increments"
PREFIXES: Final = "0123456789abcdef"
SCHEMA: Final = "hdbridge.fleet/1"
NESTED: Final = {
    "figures": ("name: text", "value", "half_width"),
    "limits": ("cause: text", "arcsec"),
    "orders": ("order: integer", "cos_arcsec", "sin_arcsec"),
    "parameters": ("name: text", "value", "low", "high", "unit: text"),
}
"""Fields of the list columns; numbers unless a type is given."""
COLUMNS: Final[Mapping[str, Mapping[str, tuple[str, str]]]] = {
    RECORDINGS: {
        "key": ("text", "SHA-256 as above"),
        "path": ("text", "recording: absolute path or URL"),
        "joint": ("text", "name of the joint; empty if unknown"),
        "axis": ("text", "axis of a flight recording, or axis file of a bus log"),
        "gear": ("text", "gear type of the manifest, else the ratio"),
        "batch": ("text", "from the manifest"),
        "cell": ("text", "from the manifest"),
        "lubricant": ("text", "from the manifest"),
        "hours": ("number", "operating hours, from the manifest"),
        "date": ("text", "date, ISO 8601"),
        "samples_sha256": ("text", "of time, motor angle and load angle as little-endian float64"),
        "model_sha256": ("text", "of the model without its provenance"),
        "version": ("text", "version of hdbridge"),
        "model": ("text", "model file; `models/JOINT.yaml` is in OUT"),
        "ratio": ("number", "motor turns per load turn"),
        "samples": ("integer", "rows of the recording"),
        "duration_s": ("number", "time in its parts"),
        "travel_deg": ("number", "range of the load angle"),
        "temperature_c": ("number", "mean, if the recording has the channel"),
        "rms_arcsec": ("number", "measurement minus the given model"),
        "refitted_rms_arcsec": ("number", "the same, parameters refitted"),
        "extended_rms_arcsec": ("number", "the same, with the causes found"),
        "floor_arcsec": ("number", "noise of a reading"),
        "figures": ("figures", "parameters of the extended model, with 95 % half widths"),
        "limits": ("limits", "smallest peak from which a cause would be named; no entry if not detectable"),
        "orders": ("orders", "motor orders in the samples, without a model; empty below two turns"),
        "remarks": ("texts", "restrictions of the data"),
        "reason": ("text", "reason for a missing diagnosis"),
        "duplicate_of": ("text", "path of the first recording with the same samples"),
        "stamp": (
            "text",
            "SHA-256 of size and times (or etag) of its files and of its row in the manifest; "
            "null if it could not be fetched",
        ),
        "axes": ("integer", "number of axes in a flight recording"),
        "columns": ("text", "from the manifest"),
        "units": ("text", "from the manifest"),
        "unwrap": ("text", "from the manifest"),
    },
    FINDINGS: {
        "key": ("text", "of the recording"),
        "path": ("text", "of the recording"),
        "joint": ("text", "of the recording"),
        "rank": ("integer", "1 is named first"),
        "cause": ("text", "name in the catalogue, or `unexplained`"),
        "probability": ("number", "of this cause or one of its aliases"),
        "aliases": ("texts", "causes that cannot be separated from it"),
        "peak_arcsec": ("number", "half the span of its effect"),
        "held_out_before_arcsec": ("number", "held-out rms without it; null if nothing was held out"),
        "held_out_after_arcsec": ("number", "the same with it"),
        "parameters": ("parameters", "its parameters, with 95 % intervals"),
        "lives_in": ("text", "coordinate on which `unexplained` depends"),
        "note": ("text", "restriction"),
    },
}
"""Columns of the two data sets: kind, and meaning."""
STORED: Final = [
    *("key", "path", "joint", "axis", "date", "ratio"),
    *("model_sha256", "version", "reason", "stamp", "axes"),
]
"""Columns that a run needs to decide if a recording must be read."""


def schema(name: str) -> pa.Schema:
    """Returns the Arrow schema of ``recordings`` or ``findings``."""
    import pyarrow as pa

    plain = {
        "text": pa.string(),
        "number": pa.float64(),
        "integer": pa.int64(),
        "texts": pa.list_(pa.string()),
    }

    def kind(word: str) -> pa.DataType:
        if word in plain:
            return plain[word]
        parts = [each.partition(": ") for each in NESTED[word]]
        return pa.list_(pa.struct([(part, plain[of or "number"]) for part, _, of in parts]))

    fields = [pa.field(column, kind(word)) for column, (word, _) in COLUMNS[name].items()]
    return pa.schema(fields, {"schema": SCHEMA, "dataset": name})


class Dataset:
    """Data set in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def create(self) -> None:
        """Creates the folder; InputError on failure or if the folder has other contents."""
        if self.folder.is_dir() and any(self.folder.iterdir()) and not self._is_one():
            raise InputError(
                f"{self.folder}: was not written by hdbridge fleet; expected a new folder, or one "
                "of an earlier run"
            )
        make_folder(self.folder / INCREMENTS)

    def check(self) -> None:
        """Raises InputError unless this is the folder of a run."""
        if not self._is_one():
            raise InputError(
                f"{self.folder}: no {RECORDINGS} in this folder; expected the --out of hdbridge fleet run"
            )

    def _is_one(self) -> bool:
        return any((self.folder / each).is_dir() for each in (RECORDINGS, INCREMENTS))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Creates the folder and allows one writer at a time; the lock ends with its process."""
        self.create()
        with sole_writer(self.folder):
            yield

    def stored(self) -> Stored:
        """Returns the rows of all recordings with only the columns that a run needs."""
        return Stored(self._rows(RECORDINGS, STORED))

    def renew(self, changes: Mapping[tuple[str, str], Mapping[str, Any]]) -> None:
        """Replaces columns of rows, given by key and path; the findings of the rows remain."""
        if changes:
            self.add(
                [
                    {**row, **changes[row["key"], row["path"]]}
                    for row in self.recordings()
                    if (row["key"], row["path"]) in changes
                ]
            )

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Writes rows of recordings, each with its ``findings``; after a crash, either all or none exist."""
        if not rows:
            return
        folder = self.folder / INCREMENTS
        number = (
            max((int(each.stem.partition("-")[2]) for each in folder.glob("*-*.parquet")), default=-1) + 1
        )
        findings = [
            {**each, "key": row["key"], "path": row["path"], "joint": row["joint"]}
            for row in rows
            for each in row["findings"]
        ]
        # Findings without their recording are ignored, so the recordings come last.
        write_table(folder / f"{FINDINGS}-{number:06d}.parquet", findings, schema(FINDINGS))
        write_table(folder / f"{RECORDINGS}-{number:06d}.parquet", rows, schema(RECORDINGS))

    def compact(self, present: Collection[tuple[str, str]] = ()) -> None:
        """Merges the increments into the parts, marks duplicates and sorts the rows.

        ``present`` contains key and path of each recording of the last run. Rows with the same path but a
        different key belong to an older file, model or version, and are dropped.
        """
        current: dict[str, set[str]] = defaultdict(set)
        for key, path in present:
            current[path].add(key)
        found = {
            (row["key"], row["path"]): row
            for row in self._rows(RECORDINGS)
            if row["path"] not in current or row["key"] in current[row["path"]]
        }
        rows = [found[each] for each in sorted(found)]
        _mark_duplicates(rows)
        findings = {
            (row["key"], row["path"], row["rank"]): row
            for row in self._rows(FINDINGS)
            if (row["key"], row["path"]) in found
        }
        for name, each in ((FINDINGS, [findings[key] for key in sorted(findings)]), (RECORDINGS, rows)):
            folder = make_folder(self.folder / name)
            for prefix in PREFIXES:
                part = [row for row in each if row["key"].startswith(prefix)]
                target = folder / f"part-{prefix}.parquet"
                if part:
                    write_table(target, part, schema(name))
                else:
                    target.unlink(missing_ok=True)
        for done in sorted((self.folder / INCREMENTS).glob("*.parquet"), reverse=True):  # recordings go first
            done.unlink()

    def recordings(self) -> list[dict[str, Any]]:
        """Returns the rows of all recordings, each with its ``findings`` by rank."""
        rows = {(row["key"], row["path"]): {**row, "findings": []} for row in self._rows(RECORDINGS)}
        for each in sorted(self._rows(FINDINGS), key=lambda row: row["rank"]):
            if (each["key"], each["path"]) in rows:
                rows[each["key"], each["path"]]["findings"].append(each)
        return [rows[each] for each in sorted(rows)]

    def _rows(self, name: str, columns: list[str] | None = None) -> Iterable[dict[str, Any]]:
        import pyarrow as pa
        import pyarrow.parquet as pq

        parts = sorted((self.folder / name).glob("part-*.parquet"))
        parts += sorted((self.folder / INCREMENTS).glob(f"{name}-*.parquet"))
        for path in parts:
            try:
                yield from pq.ParquetFile(path).read(columns).to_pylist()
            except (OSError, pa.ArrowException) as problem:
                raise InputError(f"{path}: cannot be read: {problem}; remove it and run again") from None


def _mark_duplicates(rows: Sequence[dict[str, Any]]) -> None:
    first: dict[str, str] = {}
    for row in sorted(rows, key=lambda row: (row["date"] or "", len(row["path"]), row["path"])):
        row["duplicate_of"] = None
        if samples := row["samples_sha256"]:
            original = first.setdefault(samples, row["path"])
            row["duplicate_of"] = original if original != row["path"] else None


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], columns: pa.Schema) -> None:
    """Writes rows as a Parquet file, atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=columns), sink)
    write_atomically(path, sink.getvalue().to_pybytes())
