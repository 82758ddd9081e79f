"""Columns of numbers in a CSV file: read fast, complained about exactly, written to read back the same.

A header line names the columns; one row per sample; UTF-8; gzip where the content or the name says so. A file
that numpy's own parser takes costs about two microseconds per row; anything else is read again, row by row,
to find out what is wrong with it, or to keep a column of text.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdbridge.atomic import write_atomically
from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.expectation import nearest

Column = NDArray[Any]
"""A column: float64, or text where it holds something else than numbers."""

MAXIMUM_BYTES = 2 << 30
_GZIP_MAGIC = b"\x1f\x8b"
_GZIP_LEVEL = 4  # beyond it time grows several-fold and the size hardly falls
_ROWS_AT_ONCE = 50_000


def read_columns(path: Path, required: Sequence[str], numeric: Collection[str]) -> dict[str, Column]:
    """The file's columns by name, in its order.

    ``required`` columns must be there; they and those of ``numeric`` must hold finite numbers throughout.
    Other columns are kept: as numbers where they are (an empty cell is NaN), else as text. InputError names
    the file, the line (the header is line 1) and the column.
    """
    text = _text(path)
    reader = csv.reader(io.StringIO(text, newline=""))
    names, header_lines = _header(path, reader)
    _check_header(path, header_lines, names, required)
    finite = {*required, *numeric}
    columns = _fast(text, header_lines, names)
    if columns is None:
        columns = _slow(path, reader, names, finite)
    for name in names:
        if name in finite:
            _check_finite(path, text, header_lines, name, columns[name])
    return columns


def line_of_row(path: Path, row: int) -> int:
    """The line of the file (the header is line 1) on which a row of data (the first is row 0) stands."""
    text = _text(path)
    _, header_lines = _header(path, csv.reader(io.StringIO(text, newline="")))
    return _line_of_row(text, header_lines, row)


def csv_text(columns: Mapping[str, Column]) -> Iterator[str]:
    """The file's text, piece by piece; a number has as many digits as it takes to read back the same."""
    yield ",".join(map(_cell, columns)) + "\n"
    rows = len(next(iter(columns.values()), ()))
    for first in range(0, rows, _ROWS_AT_ONCE):
        cells = [
            map(repr if column.dtype.kind == "f" else _cell, column[first : first + _ROWS_AT_ONCE].tolist())
            for column in columns.values()
        ]
        yield "\n".join(map(",".join, zip(*cells, strict=True))) + "\n"


def write_columns(path: Path, columns: Mapping[str, Column]) -> None:
    """Write the file atomically, compressed where its name ends in ``.gz``; same columns, same bytes."""
    content = io.BytesIO()
    if path.suffix == ".gz":
        with gzip.GzipFile("", "wb", _GZIP_LEVEL, content, mtime=0) as file:
            file.writelines(piece.encode() for piece in csv_text(columns))
    else:
        content.writelines(piece.encode() for piece in csv_text(columns))
    write_atomically(path, content.getvalue())


def _cell(text: str) -> str:
    quoted = any(each in text for each in ',"\r\n') or text != text.strip()
    return '"' + text.replace('"', '""') + '"' if quoted else text


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from None
    if content.startswith(_GZIP_MAGIC):
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
                content = file.read(MAXIMUM_BYTES + 1)
        except (gzip.BadGzipFile, EOFError, zlib.error) as problem:
            raise InputError(f"{path}: gzip data are damaged or cut off ({problem})") from None
    elif path.suffix == ".gz":
        raise InputError(f"{path}: not gzip data; expected a compressed file, or a name without .gz")
    if len(content) > MAXIMUM_BYTES:
        raise InputError(f"{path}: more than {MAXIMUM_BYTES >> 30} GiB; split the record")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = content.count(b"\n", 0, problem.start) + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; expected CSV in UTF-8") from None


def _header(path: Path, reader: Any) -> tuple[list[str], int]:
    """The column names, and the lines that they and what is blank before them take."""
    for row in _rows(path, reader):
        return [name.strip() for name in row], reader.line_num
    raise InputError(f"{path}: the file is empty; expected a header line and one row per sample")


def _check_header(path: Path, line: int, names: Sequence[str], required: Sequence[str]) -> None:
    where = f"{path}:{line}"
    for name in required:
        if name in names:
            continue
        if len(names) == 1 and any(each in names[0] for each in ";\t"):
            raise InputError(
                f"{where}: the columns are not separated by commas; expected comma-separated values"
            )
        if all(map(_is_number, names)):
            raise InputError(f"{where}: the first line holds numbers; expected the names of the columns")
        close = nearest(name, [each for each in names if each not in required])
        hint = f"; is '{close}' meant?" if close else ""
        raise InputError(f"{where}: column '{name}' is missing; found {', '.join(names)}{hint}")
    for place, name in enumerate(names):
        if not name:
            raise InputError(f"{where}: column {place + 1} has no name")
        if name in names[:place]:
            raise InputError(f"{where}: column '{name}' stands twice")


def _fast(text: str, header_lines: int, names: Sequence[str]) -> dict[str, Column] | None:
    """All columns by numpy's parser; None where it finds something that is not a number, or a ragged row."""
    source = io.StringIO(text)
    for _ in range(header_lines):
        source.readline()
    body = source.tell()
    if not source.readline().strip():
        return None
    source.seek(body)
    try:
        table = np.loadtxt(source, delimiter=",", comments=None, quotechar='"', ndmin=2)
    except ValueError:
        return None
    if table.shape[1] != len(names):
        return None
    return {name: np.ascontiguousarray(table[:, place]) for place, name in enumerate(names)}


def _slow(path: Path, reader: Any, names: Sequence[str], finite: Collection[str]) -> dict[str, Column]:
    """All columns, row by row; InputError at the first row that is wrong."""
    numeric = [(place, name) for place, name in enumerate(names) if name in finite]
    rows: list[list[str]] = []
    for row in _rows(path, reader):
        where = f"{path}:{reader.line_num}"
        if len(row) != len(names):
            raise InputError(f"{where}: {len(row)} values; expected {len(names)}, one for each column")
        for place, name in numeric:
            if not _is_number(row[place]):
                what = f"'{row[place].strip()}' is not a number" if row[place].strip() else "no value"
                raise InputError(f"{where}: {name}: {what}; expected a number")
        rows.append(row)
    return {name: _column([row[place] for row in rows]) for place, name in enumerate(names)}


def _rows(path: Path, reader: Any) -> Iterator[list[str]]:
    """The rows that are not blank."""
    try:
        for row in reader:
            if row and (len(row) > 1 or row[0].strip()):
                yield row
    except csv.Error as problem:
        raise InputError(f"{path}:{reader.line_num}: not CSV: {problem}") from None


def _column(cells: list[str]) -> Column:
    if all(_is_number(cell) or not cell.strip() for cell in cells):
        return np.array([float(cell) if cell.strip() else np.nan for cell in cells], dtype=np.float64)
    return np.array(cells, dtype=np.str_)


_NUMBER = re.compile(r"\s*[-+]?((\d+\.?\d*|\.\d+)(e[-+]?\d+)?|nan|inf(inity)?)\s*", re.IGNORECASE | re.ASCII)


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None


def _check_finite(path: Path, text: str, header_lines: int, name: str, column: FloatArray) -> None:
    wrong = np.flatnonzero(~np.isfinite(column))
    if len(wrong):
        line = _line_of_row(text, header_lines, int(wrong[0]))
        raise InputError(f"{path}:{line}: {name}: {column[wrong[0]]}; expected a finite number")


def _line_of_row(text: str, header_lines: int, row: int) -> int:
    source = io.StringIO(text)
    for _ in range(header_lines):
        source.readline()
    for line, content in enumerate(source, header_lines + 1):
        row -= bool(content.strip())
        if row < 0:
            return line
    return header_lines
