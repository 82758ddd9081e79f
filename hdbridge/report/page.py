"""Report page as plain data, and its rendering as one self-contained HTML file.

A page opens without a network connection, because it contains style, script and data. Charts are drawn by
uPlot (inlined; its licence and checksum are in ``assets``). Pure: `render` returns the text, and the caller
writes it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from hdbridge.axis.effects import FloatArray
from hdbridge.units import FIGURE, rounded

SIGMA: Final = "3\N{GREEK SMALL LETTER SIGMA}"
SCATTER: Final = (f"pooled {SIGMA}", "mean", f"CW {SIGMA}", "mean", f"CCW {SIGMA}", "mean")
"""Columns of a stepping test. The pooled result is first, because a mobile phone shows only two columns."""


def sentence(text: str) -> str:
    """Capitalises the first letter, and ends the text with exactly one full stop."""
    return text[:1].upper() + text[1:].rstrip(".") + "."


POINTS_MAXIMUM: Final = 4000
"""Maximum number of points of a series in a page; longer series are thinned to limit a page to a megabyte."""
PAUSE_STEPS: Final = 20.0
"""Minimum pause between two runs, in median time steps."""
DIGITS: Final = 5
"""Number of significant digits relative to a series' span. It resolves a hundredth of a screen pixel; more
digits would only enlarge the page."""


class Mark(Enum):
    """Drawing style of a series."""

    LINE = "line"
    """Line through the points in the given order; x may go back and forth, as in loops."""
    DASHED = "dashed"
    POINTS = "points"
    FAINT = "faint"
    """Small grey points behind all other series, for raw data."""
    BARS = "bars"
    """Bars from zero (on a logarithmic axis, from its lower end) to y."""


@dataclass(frozen=True, eq=False)
class Series:
    """Points with x and y of equal length, in the units of the chart's labels; NaN is a gap."""

    label: str
    x: FloatArray | Sequence[float]
    y: FloatArray | Sequence[float]
    mark: Mark = Mark.LINE
    bar_width: float | None = None
    """Width of the bars for `Mark.BARS`, in units of x; None for an automatic width."""
    spread: FloatArray | Sequence[float] | None = None
    """Half the length of a vertical error bar at each point, in units of y; for `Mark.POINTS` only."""
    colour: int | None = None
    """Palette index, for series that should have the same colour; None for an automatic colour."""


@dataclass(frozen=True, slots=True)
class Level:
    """Horizontal line at a value of y, such as a threshold."""

    label: str
    value: float


@dataclass(frozen=True, eq=False)
class Chart:
    """Series in common axes; the axis labels include the units."""

    caption: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    height_px: int = 320
    y_range: tuple[float, float] | None = None
    """Fixed range of y, for comparing several charts; None for the range of the series."""
    levels: Sequence[Level] = ()
    y_log: bool = False
    """Logarithmic y axis; non-positive values are gaps."""
    x_log: bool = False
    """Logarithmic x axis; non-positive values are gaps."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Charts that are shown side by side if the window is wide enough."""

    charts: Sequence[Chart]
    columns: int = 2


@dataclass(frozen=True, slots=True)
class Heading:
    """Header of a numerical column: the quantity, and its unit on a second line."""

    name: str
    unit: str = "arcsec"


@dataclass(frozen=True, slots=True)
class Table:
    """Table of cells. Numerical columns are right-aligned, and numbers are shown with two decimals."""

    header: Sequence[str | Heading]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """List of names and values."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Link:
    """Table cell with a link to another page; the address is relative to this page."""

    text: str
    address: str


Cell = str | float | Link
Block = Chart | Grid | Table | Facts


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a page: heading, text (blank lines separate paragraphs) and blocks."""

    title: str
    text: str = ""
    blocks: Sequence[Block] = field(default_factory=tuple)


class Status(Enum):
    """Outcome that a page reports, shown in front of its verdict."""

    OFFERED = "offered"
    """The model is better. The profile shows whether it has been committed since."""
    PENDING = "pending"
    """The model is better and awaits commit."""
    REFUSED = "refused"
    """The model is not offered, and the active model remains."""
    FOUND = "found"
    NOTHING_FOUND = "nothing found"
    MEASURED = "measured"


@dataclass(frozen=True, slots=True)
class Command:
    """A command that the user may run next, and its purpose."""

    line: str
    purpose: str


@dataclass(frozen=True, slots=True)
class Page:
    """Content of a page; ``verdict`` is the summary that follows ``status``."""

    title: str
    verdict: str
    sections: Sequence[Section]
    footer: str = ""
    status: Status = Status.MEASURED
    commands: Sequence[Command] = ()


def render(page: Page) -> str:
    """Returns the page as one HTML document; raises `ValueError` if x and y of a series differ in length."""
    charts = [chart for section in page.sections for block in section.blocks for chart in _charts_of(block)]
    return _template().render(
        page=page,
        kind=lambda block: type(block).__name__.lower(),
        number=charts.index,
        unit_of=lambda heading: heading.unit if isinstance(heading, Heading) else "",
        name_of=lambda heading: heading.name if isinstance(heading, Heading) else heading,
        is_words=_is_words,
        text_of=_markup_of,
        charts=Markup(_script_safe([_chart_data(chart) for chart in charts])),
        uplot_script=Markup(_asset("uPlot.iife.min.js")),
        uplot_style=Markup(_asset("uPlot.min.css")),
        script=Markup(_asset("charts.js")),
        style=Markup(_asset("page.css")),
    )


def histogram(
    caption: str,
    x_label: str,
    groups: Mapping[str, FloatArray | Sequence[float]],
    *,
    bins: int | None = None,
    height_px: int = 320,
) -> Chart:
    """Returns a histogram of all groups with common bins of equal width; ignores NaN and infinity.

    ``bins`` is the number of bins. By default it is the square root of the mean number of values in a group,
    between 5 and 60.
    """
    finite = {name: np.asarray(each, dtype=np.float64) for name, each in groups.items()}
    finite = {name: each[np.isfinite(each)] for name, each in finite.items()}
    everything = np.concatenate([*finite.values()]) if finite else np.empty(0)
    count = bins or min(max(math.ceil(math.sqrt(len(everything) / max(len(finite), 1))), 5), 60)
    edges = np.histogram_bin_edges(everything, bins=count)
    width = float(edges[1] - edges[0])
    centres = 0.5 * (edges[:-1] + edges[1:])
    series = [
        Series(name, centres, np.histogram(each, edges)[0].astype(float), Mark.BARS, bar_width=width)
        for name, each in finite.items()
    ]
    return Chart(caption, x_label, "number", series, height_px=height_px)


def parted(y: FloatArray, time_s: FloatArray) -> FloatArray:
    """Inserts a gap after each pause, so that no line is drawn across it."""
    steps = np.diff(time_s, prepend=time_s[0])
    return np.where(steps > PAUSE_STEPS * float(np.median(steps)), np.nan, y)


def thinned(x: FloatArray, y: FloatArray, most: int = POINTS_MAXIMUM) -> tuple[FloatArray, FloatArray]:
    """Returns at most ``most`` points of a line, in order: those with minimum and maximum y in each interval.

    The visible shape is preserved, because peaks are kept and points between them are dropped.
    """
    keep = _extremes(y, most)
    return (x, y) if keep is None else (x[keep], y[keep])


def sampled(x: FloatArray, y: FloatArray, most: int = POINTS_MAXIMUM) -> tuple[FloatArray, FloatArray]:
    """Returns at most ``most`` points of a cloud, in order: three quarters evenly spaced, the others peaks.

    Peaks alone, as for a line, would make a cloud look wider than it is.
    """
    if len(x) <= most:
        return x, y
    peaks = _extremes(y, most // 4)
    regular = np.linspace(0, len(x) - 1, most - most // 4).astype(int)
    keep = np.union1d(regular, regular if peaks is None else peaks)
    return x[keep], y[keep]


def _extremes(y: FloatArray, most: int) -> list[int] | None:
    """Returns the indices of the extremes of y in ``most / 2`` intervals; None if no thinning is needed."""
    if len(y) <= most:
        return None
    low, high = np.where(np.isnan(y), np.inf, y), np.where(np.isnan(y), -np.inf, y)
    keep: list[int] = []
    for first, last in pairwise(np.linspace(0, len(y), most // 2 + 1).astype(int).tolist()):
        keep += sorted({first + int(np.argmin(low[first:last])), first + int(np.argmax(high[first:last]))})
    return keep


def _charts_of(block: Block) -> Sequence[Chart]:
    if isinstance(block, Grid):
        return block.charts
    return (block,) if isinstance(block, Chart) else ()


def _chart_data(chart: Chart) -> dict[str, Any]:
    series = []
    most_left_out = 0.0
    for each in chart.series:
        x, y = np.asarray(each.x, dtype=np.float64), np.asarray(each.y, dtype=np.float64)
        if x.shape != y.shape or x.ndim != 1:
            raise ValueError(f"series '{each.label}': x and y must be of one length")
        spread = None if each.spread is None else np.asarray(each.spread, dtype=np.float64)
        if spread is not None and (spread.shape != x.shape or len(x) > POINTS_MAXIMUM):
            raise ValueError(f"series '{each.label}': one spread per point, {POINTS_MAXIMUM} at most")
        if chart.y_log:
            y = np.where(y > 0.0, y, np.nan)
        if chart.x_log:
            y = np.where(x > 0.0, y, np.nan)
        count = len(x)
        if each.mark is not Mark.BARS:
            cloud = each.mark in {Mark.POINTS, Mark.FAINT}
            x, y = (sampled if cloud else thinned)(x, y)
        most_left_out = max(most_left_out, count / max(len(x), 1))
        series.append(
            {
                "label": each.label,
                "mark": each.mark.value,
                "bar": each.bar_width,
                "colour": each.colour,
                "x": _significant(x) if chart.x_log else _rounded(x),
                "y": _significant(y) if chart.y_log else _rounded(y),
                "spread": None if spread is None else _rounded(spread),
            }
        )
    return {
        "x_label": chart.x_label,
        "y_label": chart.y_label,
        "height": chart.height_px,
        "y_range": chart.y_range,
        "y_log": chart.y_log,
        "x_log": chart.x_log,
        "levels": [{"label": each.label, "value": each.value} for each in chart.levels],
        "note": f"every {most_left_out:.0f}th point is drawn, and the peaks" if most_left_out >= 1.5 else "",
        "series": series,
    }


def _rounded(values: FloatArray) -> list[float | None]:
    """Rounds values to a fixed number of decimals, such that their span has `DIGITS` digits."""
    finite = values[np.isfinite(values)]
    span = float(np.ptp(finite)) or float(np.max(np.abs(finite))) if len(finite) else 1.0
    decimals = DIGITS - 1 - math.floor(math.log10(span)) if span > 0.0 else DIGITS
    # Adding 0.0 converts -0.0 to 0.0.
    return [round(value, decimals) + 0.0 if math.isfinite(value) else None for value in values.tolist()]


def _significant(values: FloatArray) -> list[float | None]:
    """Rounds all values to the same relative precision, for logarithmic axes."""
    return [rounded(value, DIGITS - 1) if math.isfinite(value) else None for value in values.tolist()]


def text_of(cell: Cell) -> str:
    """Returns the text of a cell; numbers have two decimals."""
    if isinstance(cell, Link):
        return cell.text
    return cell if isinstance(cell, str) else f"{cell:z.2f}"


def _markup_of(cell: Cell) -> str:
    """Returns a link, or the text of a cell, with a typographic minus sign in numbers."""
    text = text_of(cell)
    if isinstance(cell, Link):
        return Markup('<a href="{}">{}</a>').format(cell.address, text)
    return text.replace("-", "\N{MINUS SIGN}") if FIGURE.fullmatch(text) else text


def _is_words(table: Table, column: int) -> bool:
    """Returns True for the first column and any column without numbers, which are left-aligned."""
    cells = [row[column] for row in table.rows if column < len(row)]
    return column == 0 or not any(
        not isinstance(cell, Link) and FIGURE.fullmatch(text_of(cell)) is not None for cell in cells
    )


def _script_safe(data: object) -> str:
    """Returns JSON that cannot close the script element in which it is embedded."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


@cache
def _asset(name: str) -> str:
    return (files("hdbridge.report") / "assets" / name).read_text(encoding="utf-8")


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("hdbridge.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.j2")
