"""Output of all commands: lines and tables of the result, remarks, progress, and result files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from hdbridge.files.atomic import is_stream, write_atomically
from hdbridge.files.outputs import writing
from hdbridge.units import FIGURE

if TYPE_CHECKING:
    from hdbridge.report.page import Block, Page

Cell = str | Text
NO_FIGURE = ("", "-", "not known")
"""Cells in a column of figures that are not figures."""


class _Console(Console):
    """Console that discards its output once the reader has closed the pipe (`| head`)."""

    unread = False
    """True once the reader has closed the pipe."""

    def on_broken_pipe(self) -> None:
        self.unread = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


console = _Console(highlight=False)
"""Console for results, on standard output."""
notes = _Console(stderr=True, highlight=False)
"""Console for progress and remarks, on standard error, to keep them out of a pipe."""


def say(line: str, style: str | None = None) -> None:
    """Prints a line of the result, unwrapped and without markup."""
    console.print(line, markup=False, soft_wrap=True, style=style)


def note(line: str) -> None:
    """Prints a remark, unwrapped and without markup."""
    notes.print(line, markup=False, soft_wrap=True)


def progress_bar() -> Progress:
    """Returns a progress bar with the remaining time, on standard error; plain lines without a terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        console=notes,
        refresh_per_second=4,
    )


def print_blocks(blocks: Iterable[Block], title: str = "") -> None:
    """Prints the tables and facts of a report page, the first table with a title, and no charts."""
    from hdbridge.report import page

    for block in blocks:
        if isinstance(block, page.Table):
            columns = [
                f"{each.name}\n{each.unit}".rstrip() if isinstance(each, page.Heading) else each
                for each in block.header
            ]
            print_table(columns, [[*map(page.text_of, row)] for row in block.rows], title)
            title = ""
        elif isinstance(block, page.Facts):
            for name, value in block.rows:
                say(f"{name}: {value}")


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Cell]], title: str = "") -> None:
    """Prints a table uncropped, split only on a narrow terminal. An empty row ends a section."""
    for each in tables(columns, rows, title):
        console.print(each, crop=False)


def tables(columns: Sequence[str], rows: Sequence[Sequence[Cell]], title: str = "") -> list[Table]:
    """Returns a table at its natural width; on a narrow terminal several tables, each with the first column.

    Figures are never truncated.
    """
    parts: list[Table] = []
    rest = [*range(1, len(columns))]
    widest = console.width if console.is_terminal else 10_000
    while rest or not parts:
        count = len(rest)
        while True:
            part = _table(columns, rows, title, [0, *rest[:count]])
            width = Measurement.get(console, console.options.update(width=10_000), part).maximum
            if width <= widest or count <= 1:
                break
            count -= 1
        part.width = min(width, widest)
        parts.append(part)
        rest = rest[count:]
    return parts


def _table(columns: Sequence[str], rows: Sequence[Sequence[Cell]], title: str, shown: Sequence[int]) -> Table:
    """Returns a table with the columns ``shown``."""
    table = Table(title=title or None, title_justify="left")
    for place in shown:
        cells = [str(row[place]) for row in rows if place < len(row)]
        right = (
            place > 0 and any(cells) and all(each in NO_FIGURE or FIGURE.fullmatch(each) for each in cells)
        )
        table.add_column(columns[place], justify="right" if right else "left", overflow="fold")
    for row in rows:
        if row:
            shown_cells = (row[place] for place in shown if place < len(row))
            table.add_row(*(each if isinstance(each, Text) else Text(each) for each in shown_cells))
        else:
            table.add_section()
    return table


def print_object(name: str, value: object, type_name: str) -> None:
    """Prints the value of an object of a drive; a non-negative integer also in hexadecimal."""
    whole = isinstance(value, int) and not isinstance(value, bool) and value >= 0
    also = f" ({value:#x})" if whole else ""
    say(f"{name}: {value}{also}  {type_name}")


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Writes the result as JSON, unless ``path`` is None."""
    if path is not None:
        write_result(path, json.dumps(result, indent=2, allow_nan=False) + "\n")


def write_page(path: Path, page: Page) -> None:
    """Writes a report page as one HTML file."""
    from hdbridge.report.page import render

    write_result(path, render(page))


def write_result(path: Path, text: str) -> None:
    """Writes a result file; a failure is reported after everything has been printed."""
    with writing():
        write_atomically(path, text)
        if not is_stream(path):
            note(f"wrote {path}")
