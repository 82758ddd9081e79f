"""Columns of numbers in a CSV file: read fast, complained about exactly, written to read back the same.

A header line names the columns; one row per sample; UTF-8; gzip where the content or the name says so. A file
that numpy's own parser takes costs about two microseconds per row; anything else is read again, row by row,
to find out what is wrong with it, or to keep a column of text.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import math
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from hdbridge.errors import InputError
from hdbridge.files.atomic import write_atomically
from hdbridge.files.expectation import nearest, one_line
from hdbridge.files.regular import open_regular

FloatArray = NDArray[np.float64]
Column = NDArray[Any]
"""A column: float64, or text where it holds something else than numbers."""

MAXIMUM_BYTES = 2 << 30
_GZIP_MAGIC = b"\x1f\x8b"
_GZIP_LEVEL = 4  # beyond it time grows several-fold and the size hardly falls
_ROWS_AT_ONCE = 50_000
_PIECE_BYTES = 1 << 20


def read_columns(path: Path, required: Sequence[str], numeric: Collection[str]) -> dict[str, Column]:
    """The file's columns by name, in its order.

    ``required`` columns must be there; they and those of ``numeric`` must hold finite numbers throughout.
    Other columns are kept: as numbers where they are (an empty cell is NaN), else as text. InputError names
    the file, the line (the header is line 1) and the column.
    """
    content = _content(path)
    reader = csv.reader(_lines(content))
    names, header_lines = _header(path, reader)
    _check_header(path, header_lines, names, required)
    finite = {*required, *numeric}
    columns = _fast(content, header_lines, names)
    if columns is None:
        columns = _slow(path, reader, names, finite)
    for name in names:
        if name in finite:
            _check_finite(path, content, header_lines, name, columns[name])
    return columns


def line_of_row(path: Path, row: int) -> int:
    """The line of the file (the header is line 1) on which a row of data (the first is row 0) stands."""
    content = _content(path)
    _, header_lines = _header(path, csv.reader(_lines(content)))
    return _line_of_row(content, header_lines, row)


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


def _wrong(text: str) -> InputError:
    return InputError(one_line(text))


def _content(path: Path) -> bytes:
    """The file's bytes, decompressed: UTF-8 without a byte-order mark."""
    try:
        with open_regular(path) as plain:
            content = _bounded(plain)
    except FileNotFoundError:
        raise _wrong(f"{path}: no such file") from None
    except OSError as problem:
        raise _wrong(f"{path}: cannot be read: {problem.strerror}") from None
    if content.startswith(_GZIP_MAGIC):
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
                content = _bounded(file)
        except (gzip.BadGzipFile, EOFError, zlib.error) as problem:
            raise _wrong(f"{path}: gzip data are damaged or cut off ({problem})") from None
    elif path.suffix == ".gz":
        raise _wrong(f"{path}: not gzip data; expected a compressed file, or a name without .gz")
    if len(content) > MAXIMUM_BYTES:
        raise _wrong(f"{path}: more than {MAXIMUM_BYTES >> 30} GiB; split the record")
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        content.decode()
    except UnicodeDecodeError as problem:
        line = content.count(b"\n", 0, problem.start) + 1
        raise _wrong(f"{path}:{line}: not UTF-8 text; expected CSV in UTF-8") from None
    return content


def _bounded(file: BinaryIO | gzip.GzipFile) -> bytes:
    """All of it, or a piece more than is allowed; `read` in one go would take the memory that it may need."""
    content = io.BytesIO()
    while content.tell() <= MAXIMUM_BYTES and (piece := file.read(_PIECE_BYTES)):
        content.write(piece)
    return content.getvalue()


def _lines(content: bytes, skipped: int = 0) -> io.TextIOWrapper:
    """The lines of the file, ends and all, but for the first few."""
    lines = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8", newline="")
    for _ in range(skipped):
        lines.readline()
    return lines


def _header(path: Path, reader: Any) -> tuple[list[str], int]:
    """The column names, and the lines that they and what is blank before them take."""
    for row in _rows(path, reader):
        return [name.strip() for name in row], reader.line_num
    raise _wrong(f"{path}: the file is empty; expected a header line and one row per sample")


def _check_header(path: Path, line: int, names: Sequence[str], required: Sequence[str]) -> None:
    where = f"{path}:{line}"
    for name in required:
        if name in names:
            continue
        if len(names) == 1 and any(each in names[0] for each in ";\t"):
            raise _wrong(f"{where}: the columns are not separated by commas; expected comma-separated values")
        if all(map(_is_number, names)):
            raise _wrong(f"{where}: the first line holds numbers; expected the names of the columns")
        close = nearest(name, [each for each in names if each not in required])
        hint = f"; is '{close}' meant?" if close else ""
        raise _wrong(f"{where}: column '{name}' is missing; found {', '.join(names)}{hint}")
    for place, name in enumerate(names):
        if not name:
            raise _wrong(f"{where}: column {place + 1} has no name")
        if name in names[:place]:
            raise _wrong(f"{where}: column '{name}' stands twice")


def _fast(content: bytes, header_lines: int, names: Sequence[str]) -> dict[str, Column] | None:
    """All columns by numpy's parser; None where it finds something that is not a number, or a ragged row."""
    if not _lines(content, header_lines).readline().strip():
        return None
    try:
        table = np.loadtxt(
            _lines(content, header_lines), delimiter=",", comments=None, quotechar='"', ndmin=2
        )
    except ValueError:
        return None
    if table.shape[1] != len(names):
        return None
    return {name: np.ascontiguousarray(table[:, place]) for place, name in enumerate(names)}


def _slow(path: Path, reader: Any, names: Sequence[str], finite: Collection[str]) -> dict[str, Column]:
    """All columns, row by row; InputError at the first row that is wrong."""
    rows: list[list[str]] = []
    lines: list[int] = []
    for row in _rows(path, reader):
        if len(row) != len(names):
            hint = "; decimal commas? write 0.5, not 0,5" if len(row) == 2 * len(names) else ""
            raise _wrong(
                f"{path}:{reader.line_num}: {len(row)} values; expected {len(names)}, one for each "
                f"column{hint}"
            )
        rows.append(row)
        lines.append(reader.line_num)
    cells = dict(zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True))
    columns = {name: _column(cells[name], blanks=name not in finite) for name in names}
    wrong = [
        (_first_wrong(cells[name]), name)
        for name in names
        if name in finite and columns[name].dtype.kind != "f"
    ]
    if wrong:
        row_number, name = min(wrong)
        cell = cells[name][row_number].strip()
        what = f"'{cell}' is not a number" if cell else "no value"
        raise _wrong(f"{path}:{lines[row_number]}: {name}: {what}; expected a number")
    return columns


def _rows(path: Path, reader: Any) -> Iterator[list[str]]:
    """The rows that are not blank."""
    try:
        for row in reader:
            if row and (len(row) > 1 or row[0].strip()):
                yield row
    except csv.Error as problem:
        raise _wrong(f"{path}:{reader.line_num}: not CSV: {problem}") from None


def _column(cells: Sequence[str], *, blanks: bool) -> Column:
    """Numbers, if all cells are (blank ones are NaN, if that is allowed), else text."""
    try:
        numbers = [float(cell) if cell or not blanks else math.nan for cell in cells]
    except ValueError:
        return np.array(cells, dtype=np.str_)
    if any("_" in cell for cell in cells):  # Python's float takes 1_000; CSV has no such numbers
        return np.array(cells, dtype=np.str_)
    return np.array(numbers, dtype=np.float64)


def _is_number(cell: str) -> bool:
    return _column([cell], blanks=False).dtype.kind == "f"


def _first_wrong(cells: Sequence[str]) -> int:
    return next(row for row, cell in enumerate(cells) if not _is_number(cell))


def _check_finite(path: Path, content: bytes, header_lines: int, name: str, column: FloatArray) -> None:
    wrong = np.flatnonzero(~np.isfinite(column))
    if len(wrong):
        line = _line_of_row(content, header_lines, int(wrong[0]))
        raise _wrong(f"{path}:{line}: {name}: {column[wrong[0]]}; expected a finite number")


def _line_of_row(content: bytes, header_lines: int, row: int) -> int:
    for line, text in enumerate(_lines(content, header_lines), header_lines + 1):
        row -= bool(text.strip())
        if row < 0:
            return line
    return header_lines
