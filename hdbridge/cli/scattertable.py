"""Table of stepping tests: scatter and mean of the load error at rest, each way and pooled."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.table import Table

from hdbridge.cli.options import print_table

if TYPE_CHECKING:
    from hdbridge.commissioning.evaluation.stepping import Scatter


def print_scatter(
    title: str, first: str, rows: Iterable[tuple[str, tuple[Scatter, Scatter, Scatter]]]
) -> None:
    """Prints a line for each test: its name in the column ``first``, then its CW, CCW and pooled figures."""
    table = Table(title=title, title_justify="left")
    table.add_column(first)
    for direction in ("CW", "CCW", "pooled"):
        table.add_column(f"{direction} 3σ", justify="right")
        table.add_column("mean", justify="right")
    for name, parts in rows:
        figures = (value for part in parts for value in (part.three_sigma_arcsec, part.mean_arcsec))
        table.add_row(name, *(f"{value:z.2f}" for value in figures))
    print_table(table)
