"""Reads columns of numbers from a CSV file of any program; written numbers read back identically.

A header line names the columns, and one row per sample follows. Separators, decimal commas, comments, lines
above the header, a row of units below it, the encoding and gzip are recognised and reported as remarks. A
file that numpy's parser accepts takes about two microseconds per row. Any other file is read row by row, to
locate its error or to keep a column of text.
"""

import codecs
import csv
import gzip
import io
import math
import re
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hdbridge.errors import InputError
from hdbridge.files.atomic import open_regular, write_atomically
from hdbridge.files.expectation import one_line

FloatArray = NDArray[np.float64]
Column = NDArray[Any]
"""A column: float64, or text if not all of its cells are numbers."""

MAXIMUM_BYTES = 2 << 30
_GZIP_MAGIC = b"\x1f\x8b"
_OTHER_FILES: Final = {
    b"PK\x03\x04": "a ZIP archive, such as an Excel workbook",
    b"\xd0\xcf\x11\xe0": "an Excel workbook of the old kind, .xls",
    b"PAR1": "a Parquet file",
    b"\x89HDF": "an HDF5 or MATLAB file",
    b"MATLAB": "a MATLAB file",
    b"TDSm": "a TDMS file",
    b"MDF ": "an MDF file",
    b"\x89MCAP": "an MCAP file",
}
"""Kinds of binary files, by their first bytes, as in the magic files of file(1)."""
_GZIP_LEVEL = 4  # higher levels take several times as long and hardly reduce the size
_ROWS_AT_ONCE = 50_000
_PIECE_BYTES = 1 << 20

_SEPARATORS: Final = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_HEAD_BYTES = 1 << 16
_HEAD_ROWS = 100
"""Number of initial rows that are searched for the header."""
_SAMPLED = 20
"""Number of data rows examined for decimal commas."""
_COMMENT = re.compile(rb"(?:^|(?<=[\r\n]))([ \t]*(?:#|%|//)[ \t]*)([^\r\n]*)")
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*$")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d+))?$")
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(?=[ T])")
_FRACTION = re.compile(r"(?<=:\d\d)[.,](\d+)")
_DAY_S: Final = 86_400.0
_QUOTES: Final = "expected quotes in pairs"


@dataclass(frozen=True, slots=True)
class _Layout:
    """Columns of a file, and the format of its rows."""

    names: tuple[str, ...]
    """Names of the columns in order; the name of an unnamed column is its number, counted from 1."""
    header_line: int
    """Line number of the header; 0 if the file has no header."""
    first_line: int
    """Number of lines above the first row of data."""
    separator: str
    decimal_comma: bool = False
    units: tuple[str, ...] = ()
    """Cells of the row of units, if any."""
    remarks: tuple[str, ...] = ()


class CsvFile:
    """CSV file whose layout is determined on construction; `read` returns its columns.

    ``wanted`` contains names or numbers (from 1) of columns that the caller needs. The header is the line
    that contains the names. Raises `InputError` with the file and, if known, the line.
    """

    def __init__(self, path: Path, wanted: Collection[str] = ()) -> None:
        self.path = path
        content, encoding = text_of(path)
        self._held: bytes | None = content  # kept until `read`, because a stream can be read only once
        self._layout = found = _layout(path, content, wanted)
        said = ("comments left out" if _commented(content) else "", encoding)
        self.remarks: tuple[str, ...] = (*found.remarks, *filter(None, said))
        """Assumptions about the file's format, as text; `read` may add one. Empty for plain CSV."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in the order of the file; the name of an unnamed column is its number."""
        return self._layout.names

    @property
    def header_line(self) -> int:
        """Line number of the header; 0 if the file has no header."""
        return self._layout.header_line

    @property
    def units(self) -> dict[str, str]:
        """Unit of each column, from a row of units below the header; empty without such a row."""
        return dict(zip(self.names, self._layout.units, strict=False))

    def find(self, column: str) -> str | None:
        """Returns the name of a column that is given by name or number; None for an unknown column.

        Raises `InputError` if two columns have this name.
        """
        if self.names.count(column) > 1:
            raise _wrong(
                f"{self.path}:{self.header_line}: two columns are called '{column}'; expected each name "
                f"once: name the column by its number, as in {self.names.index(column) + 1}"
            )
        if column in self.names:
            return column
        if column.isdecimal() and 1 <= int(column) <= len(self.names):
            return self.names[int(column) - 1]
        return None

    def read(self, numeric: Collection[str] = (), times: Collection[str] = ()) -> dict[str, Column]:
        """Returns the columns by name, in the order of the file.

        Columns in ``numeric`` must contain only numbers. Those in ``times`` may contain ISO times or times of
        day, which are converted to seconds since the first. Other columns are returned as numbers if possible
        (an empty cell is NaN), else as text. Of several columns with the same name, the first is returned.
        """
        content = self._text()
        self._held = None
        columns = self._fast(content)
        return self._slow(content, numeric, times) if columns is None else columns

    def line_of_row(self, row: int) -> int:
        """Returns the line number in the file (from 1) of a row of data (from 0)."""
        return self._line_of(self._text(), row)

    def _text(self) -> bytes:
        """Returns the text without comments, and with spaces between columns replaced by one tab."""
        content = text_of(self.path)[0] if self._held is None else self._held
        if _commented(content):
            content = _COMMENT.sub(b"", content)
        if self._layout.separator == " ":
            content = re.sub(rb"[ \t]+", rb"\t", content)
            content = re.sub(rb"(?:^|(?<=[\r\n]))\t|\t(?=[\r\n]|$)", b"", content)
        return content

    def _line_of(self, content: bytes, row: int) -> int:
        first = self._layout.first_line
        for line, text in enumerate(_lines(content, first), first + 1):
            row -= bool(text.strip())
            if row < 0:
                return line
        return first

    @property
    def _delimiter(self) -> str:
        return "\t" if self._layout.separator == " " else self._layout.separator

    def _fast(self, content: bytes) -> dict[str, Column] | None:
        """Reads all columns with numpy's parser; returns None for a non-numerical cell or a ragged row."""
        layout = self._layout
        if not _lines(content, layout.first_line).readline().strip():
            return None
        if layout.decimal_comma:
            if self._delimiter == ",":
                return None
            content = content.replace(b",", b".")
        try:
            table = np.loadtxt(
                _lines(content, layout.first_line),
                delimiter=self._delimiter,
                comments=None,
                quotechar='"',
                ndmin=2,
                unpack=True,
            )
        except ValueError:
            return None
        if len(table) != len(layout.names):
            return None
        return self._named([np.ascontiguousarray(column) for column in table])

    def _slow(self, content: bytes, numeric: Collection[str], times: Collection[str]) -> dict[str, Column]:
        """Reads all columns row by row; raises `InputError` at the first invalid row."""
        rows: list[list[str]] = []
        lines: list[int] = []
        for row, line in self._rows(content):
            rows.append(row)
            lines.append(line)
        count = len(self.names)
        cells = list(zip(*rows, strict=True)) if rows else [()] * count
        comma = self._layout.decimal_comma
        columns = []
        wrong: list[tuple[int, str, str]] = []
        for name, column in zip(self.names, cells, strict=True):
            made = _column(column, blanks=name not in numeric, comma=comma)
            if made.dtype.kind != "f" and name in times and (seconds := _seconds(column)) is not None:
                made = seconds
                self.remarks = (*self.remarks, f"dates or times of day in '{name}'")
            elif made.dtype.kind != "f" and name in numeric:
                row_number = next(at for at, cell in enumerate(column) if not _is_number(cell, comma))
                wrong.append((row_number, name, column[row_number].strip()))
            columns.append(made)
        if wrong:
            row_number, name, cell = min(wrong)
            what = f"'{cell}' is not a number" if cell else "no value"
            also = " or an ISO time" if name in times else ""
            raise _wrong(f"{self.path}:{lines[row_number]}: {name}: {what}; expected a number{also}")
        return self._named(columns)

    def _named(self, columns: Sequence[Column]) -> dict[str, Column]:
        named: dict[str, Column] = {}
        for name, column in zip(self.names, columns, strict=True):
            named.setdefault(name, column)
        return named

    def _rows(self, content: bytes) -> Iterator[tuple[list[str], int]]:
        """Yields each row of data, with one cell per column, and its line number."""
        layout, count = self._layout, len(self.names)
        paired = layout.decimal_comma and layout.separator == ","
        for cells, line in _parsed(self.path, content, layout.first_line, self._delimiter):
            row = cells
            if paired and len(row) == 2 * count:
                row = [f"{whole},{part}" for whole, part in zip(row[::2], row[1::2], strict=True)]
            if len(row) == count + 1 and not row[-1].strip():
                row = row[:-1]
            if len(row) != count:
                raise _wrong(f"{self.path}:{line}: {len(row)} values; expected {count}, one for each column")
            yield row, line


def csv_text(columns: Mapping[str, Column]) -> Iterator[str]:
    """Yields the text of a CSV file in pieces; numbers have enough digits to read back identically."""
    yield ",".join(map(_cell, columns)) + "\n"
    rows = len(next(iter(columns.values()), ()))
    for first in range(0, rows, _ROWS_AT_ONCE):
        cells = [
            map(repr if column.dtype.kind == "f" else _cell, column[first : first + _ROWS_AT_ONCE].tolist())
            for column in columns.values()
        ]
        yield "\n".join(map(",".join, zip(*cells, strict=True))) + "\n"


def write_columns(path: Path, columns: Mapping[str, Column]) -> None:
    """Writes a CSV file atomically, compressed if its name ends in ``.gz``; the output is deterministic."""
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


def text_of(path: Path) -> tuple[bytes, str]:
    """Returns the decompressed text as UTF-8 without byte-order mark, and a remark on any other encoding."""
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
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            return content.decode("utf-16").encode(), "UTF-16 text"
        except UnicodeError:
            raise _wrong(f"{path}: UTF-16 text that is damaged; expected CSV in UTF-8") from None
    _check_is_text(path, content)
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        content.decode()
    except UnicodeDecodeError as problem:
        try:
            return content.decode("cp1252").encode(), "Windows-1252 text"
        except UnicodeDecodeError:
            line = content.count(b"\n", 0, problem.start) + 1
            raise _wrong(
                f"{path}:{line}: neither UTF-8 nor Windows-1252 text; expected CSV in UTF-8"
            ) from None
    return content, ""


def _check_is_text(path: Path, content: bytes) -> None:
    """Raises `InputError` for a null byte, which no text contains, with the kind of file if it is known."""
    first = content.find(b"\0")
    if first < 0:
        return
    for magic, kind in _OTHER_FILES.items():
        if content.startswith(magic):
            raise _wrong(f"{path}: {kind}; expected CSV: export the samples as CSV")
    line = content.count(b"\n", 0, first) + 1
    raise _wrong(
        f"{path}:{line}: a null byte; expected CSV in UTF-8: the file is binary, or its writer lost power: "
        "then delete the lines from this one on"
    )


def _bounded(file: BinaryIO | gzip.GzipFile) -> bytes:
    """Reads at most one piece more than `MAXIMUM_BYTES`; a single `read` could need far more memory."""
    content = io.BytesIO()
    while content.tell() <= MAXIMUM_BYTES and (piece := file.read(_PIECE_BYTES)):
        content.write(piece)
    return content.getvalue()


def _commented(content: bytes) -> bool:
    return any(mark in content for mark in (b"#", b"%", b"//")) and _COMMENT.search(content) is not None


def _lines(content: bytes, skipped: int = 0) -> io.TextIOWrapper:
    """Opens the content for reading by line, after the first ``skipped`` lines; line ends are kept."""
    lines = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8", newline="")
    for _ in range(skipped):
        lines.readline()
    return lines


@dataclass(frozen=True, slots=True)
class _Line:
    """A non-blank line near the start of the file."""

    number: int
    text: str
    comment: bool

    def cells(self, separator: str) -> list[str]:
        """Returns the cells; none if a quote in the line is not closed."""
        if separator == " ":
            return self.text.split()
        try:
            reader = csv.reader([self.text], delimiter=separator, strict=True)
            return [cell.strip() for cell in next(reader, [])]
        except csv.Error:
            return []


def _head(content: bytes) -> list[_Line]:
    lines = []
    text = content[:_HEAD_BYTES].decode(errors="replace")
    for number, line in enumerate(io.StringIO(text, newline=""), 1):
        bare = line.strip("\r\n")
        comment = _COMMENT.match(bare.encode())
        bare = comment[2].decode() if comment else bare
        if bare.strip():
            lines.append(_Line(number, bare, comment is not None))
    return lines[:_HEAD_ROWS]


def _layout(path: Path, content: bytes, wanted: Collection[str]) -> _Layout:
    """Determines separator and header: the line with most ``wanted`` names, else that above the numbers."""
    head = _head(content)
    rows = [line for line in head if not line.comment]
    if not rows:
        raise _wrong(f"{path}: the file is empty; expected a header line and one row per sample")
    separator, header = _named_header(head, wanted) or _guessed_header(head)
    data = [line for line in rows if header is None or line.number > header.number]
    if header is None:  # lines above the numbers are not data
        begin = next((at for at, line in enumerate(data) if _holds_numbers(line, separator)), 0)
        for line in data[: begin + 1]:
            if not line.cells(separator):
                raise _wrong(f"{path}:{line.number}: a quote is not closed; {_QUOTES}")
        data = data[begin:]
    first = [line.cells(separator) for line in data[:_SAMPLED]]
    cells = header.cells(separator) if header else [""] * len(first[0])
    if len(cells) > 1 and not cells[-1] and all(len(row) < len(cells) or not row[-1] for row in first):
        cells = cells[:-1]  # each line ends with a separator; `CsvFile._rows` drops the empty cell
    names = tuple(cell or str(place) for place, cell in enumerate(cells, 1))
    needed = [place for place, name in enumerate(names) if name in wanted or str(place + 1) in wanted]
    needed = needed or list(range(len(names)))
    remarks = [] if separator == "," else [_SEPARATORS[separator]]
    units: tuple[str, ...] = ()
    if len(first) > 1 and _is_row_of_units(first[0], first[1], needed):
        units = tuple(first[0])
        remarks.append(f"a row of units in line {data[0].number}")
        data, first = data[1:], first[1:]
    paired = separator == "," and bool(first) and _is_paired(first[0], len(names))
    comma = paired or any(
        _DECIMAL_COMMA.match(row[place]) for row in first for place in needed if place < len(row)
    )
    if comma:
        remarks.append("decimal commas")
    if header is None:
        remarks.append("no header, so columns have numbers")
    elif header.comment:
        remarks.append(f"the header in the comment of line {header.number}")
    top = header or data[0]
    above = [line for line in rows if line.number < top.number]
    if above:
        remarks.append(f"{len(above)} line{'s' * (len(above) > 1)} above the header left out")
    return _Layout(
        names,
        header.number if header else 0,
        data[0].number - 1 if data and (units or not header) else top.number,
        separator,
        comma,
        units,
        tuple(remarks),
    )


def _named_header(head: Sequence[_Line], wanted: Collection[str]) -> tuple[str, _Line] | None:
    """Returns the separator and the line that contain most of the names; None if no line contains any."""
    found = [
        (len(set(wanted).intersection(line.cells(separator))), not line.comment, -line.number, separator)
        for line in head
        for separator in _SEPARATORS
    ]
    count, _, number, separator = max(found, key=lambda each: each[:3])
    if not count or all(name.isdecimal() for name in wanted):
        return None
    return separator, next(line for line in head if line.number == -number)


def _guessed_header(head: Sequence[_Line]) -> tuple[str, _Line | None]:
    """Returns the separator that gives most numerical cells, and the line of names above them, if any."""
    best: tuple[int, str, _Line | None] | None = None
    for separator in _SEPARATORS:
        rows = [line for line in head if not line.comment]
        first = next((line for line in rows if _holds_numbers(line, separator)), None)
        if first is None:
            continue
        count, numbers = len(first.cells(separator)), _numbers(first, separator)
        above = [
            line
            for line in head
            if line.number < first.number and len(line.cells(separator)) in {count, count // 2, count - 1}
        ][-2:]
        words = [line for line in above if not any(map(_is_number, line.cells(separator)))]
        if best is None or numbers > best[0]:
            best = numbers, separator, words[0] if words else None
    if best is not None:
        _, separator, header = best
        return separator, header
    line = next(line for line in head if not line.comment)
    return max(_SEPARATORS, key=lambda each: len(line.cells(each)) - (each == " ")), line


def _holds_numbers(line: _Line, separator: str) -> bool:
    values = _numbers(line, separator)
    return values > 0 and 2 * values >= len(line.cells(separator))


def _numbers(line: _Line, separator: str) -> int:
    """Counts the cells that are numbers or times."""
    cells = line.cells(separator)
    return sum(_is_number(cell, separator != ",") or _moment(cell) is not None for cell in cells)


def _is_row_of_units(first: Sequence[str], second: Sequence[str], needed: Sequence[int]) -> bool:
    """Returns True if ``first`` has words in the needed columns, and ``second`` has numbers or times."""
    if max(needed) >= min(len(first), len(second)):
        return False

    def is_value(cell: str) -> bool:
        return _is_number(cell) or bool(_DECIMAL_COMMA.match(cell)) or _moment(cell) is not None

    words = [first[place] for place in needed]
    return any(words) and not any(map(is_value, words)) and all(is_value(second[place]) for place in needed)


def _is_paired(cells: Sequence[str], count: int) -> bool:
    """Returns True if each value occupies two cells, because its decimal comma was taken for a separator."""
    whole, part = cells[::2], cells[1::2]
    return (
        count > 1
        and len(cells) == 2 * count
        and all(re.fullmatch(r"[+-]?\d+", each) for each in whole)
        and all(re.fullmatch(r"\d+", each) for each in part)
    )


def _parsed(path: Path, content: bytes, skipped: int, delimiter: str) -> Iterator[tuple[list[str], int]]:
    """Yields each non-blank row after the ``skipped`` lines, with the number of its first line."""
    reader = csv.reader(_lines(content, skipped), delimiter=delimiter, strict=True)
    line = skipped + 1
    try:
        for row in reader:
            if row and (len(row) > 1 or row[0].strip()):
                yield row, line
            line = skipped + reader.line_num + 1
    except csv.Error as problem:
        raise _wrong(f"{path}:{line}: not CSV: {problem}; {_QUOTES}") from None


def _column(cells: Sequence[str], *, blanks: bool, comma: bool) -> Column:
    """Returns a column of numbers if all cells are numbers (or blank, if allowed), else of text."""
    texts = (
        [cell.replace(",", ".") if _DECIMAL_COMMA.match(cell) else cell for cell in cells] if comma else cells
    )
    try:
        numbers = [float(cell) if cell or not blanks else math.nan for cell in texts]
    except ValueError:
        return np.array(cells, dtype=np.str_)
    if any("_" in cell for cell in texts):  # Python's float accepts 1_000; CSV has no such numbers
        return np.array(cells, dtype=np.str_)
    return np.array(numbers, dtype=np.float64)


def _is_number(cell: str, comma: bool = False) -> bool:
    return _column([cell], blanks=False, comma=comma).dtype.kind == "f"


def _seconds(cells: Sequence[str]) -> FloatArray | None:
    """Converts ISO times or times of day to seconds since the first; returns None if any cell is neither.

    Times of day without a date continue past midnight.
    """
    moments = [moment for cell in cells if (moment := _moment(cell)) is not None]
    if not moments or len(moments) < len(cells):
        return None
    whole = np.array([each.whole for each in moments], dtype=np.float64)
    part = np.array([each.part for each in moments], dtype=np.float64)
    seconds: FloatArray = whole - whole[0] + part
    if _CLOCK.match(cells[0].strip()):
        seconds = seconds + _DAY_S * np.cumsum(np.diff(seconds, prepend=seconds[0]) < -0.5 * _DAY_S)
    return seconds


class _Moment(NamedTuple):
    """Time as whole seconds and a fraction of a second."""

    whole: int
    part: float


def _moment(cell: str) -> _Moment | None:
    """Parses an ISO time or a time of day; returns None for any other text."""
    text = cell.strip()
    if clock := _CLOCK.match(text):
        hours, minutes, seconds = (int(each) for each in clock.groups()[:3])
        return _Moment(3600 * hours + 60 * minutes + seconds, float(f"0.{clock[4] or 0}"))
    if len(text) < len("2000-01-01"):
        return None
    fraction = _FRACTION.search(text)
    text = _DAY_FIRST.sub(
        lambda each: f"{each[3]}-{int(each[2]):02d}-{int(each[1]):02d}", _FRACTION.sub("", text)
    )
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return _Moment(round(moment.timestamp()), float(f"0.{fraction[1]}") if fraction else 0.0)
