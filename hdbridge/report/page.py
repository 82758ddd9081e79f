"""A page of results as plain data, and its rendering as one self-contained HTML file.

A page opens without a network: style, script and data are in it. Charts are drawn by uPlot (inlined; its
licence and checksum lie in ``assets``). Pure: `render` gives the text, the caller writes it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from hdbridge.effects import FloatArray

POINTS_MAXIMUM: Final = 4000
"""Points of one series in a page; longer ones are thinned so that a page stays below a megabyte."""
DIGITS: Final = 6


class Mark(Enum):
    """How a series is drawn."""

    LINE = "line"
    """Joined in the order given: also loops, whose x goes back and forth."""
    POINTS = "points"
    BARS = "bars"


@dataclass(frozen=True, eq=False)
class Series:
    """One set of points."""

    label: str
    x: FloatArray | Sequence[float]
    y: FloatArray | Sequence[float]
    mark: Mark = Mark.LINE


@dataclass(frozen=True, eq=False)
class Chart:
    """Series over common axes; the labels name the unit."""

    caption: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    height_px: int = 320
    y_range: tuple[float, float] | None = None
    """Given where several charts are to be compared; else what the series need."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells; numbers are aligned to the right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str | float]]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values."""

    rows: Sequence[tuple[str, str]]


Block = Chart | Table | Facts


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, a text and what it speaks of."""

    title: str
    text: str = ""
    blocks: Sequence[Block] = field(default_factory=tuple)


@dataclass(frozen=True, slots=True)
class Page:
    """The whole page; ``verdict`` is the one sentence that a reader in a hurry needs."""

    title: str
    verdict: str
    sections: Sequence[Section]
    footer: str = ""


def render(page: Page) -> str:
    """The page as one HTML document."""
    charts = [block for section in page.sections for block in section.blocks if isinstance(block, Chart)]
    return _template().render(
        page=page,
        kind=lambda block: type(block).__name__.lower(),
        number=charts.index,
        is_number=lambda cell: isinstance(cell, (int, float)),
        text_of=_text_of,
        charts=Markup(_script_safe([_chart_data(chart) for chart in charts])),
        uplot_script=Markup(_asset("uPlot.iife.min.js")),
        uplot_style=Markup(_asset("uPlot.min.css")),
        script=Markup(_asset("charts.js")),
        style=Markup(_asset("page.css")),
    )


def thinned(x: FloatArray, y: FloatArray, most: int = POINTS_MAXIMUM) -> tuple[FloatArray, FloatArray]:
    """At most ``most`` points in the same order: of each run of samples those of least and greatest y.

    What would be seen at this size stays: peaks are kept, whatever falls between them is not drawn apart.
    """
    count = len(x)
    if count <= most:
        return x, y
    edges = np.linspace(0, count, most // 2 + 1).astype(int)
    keep: list[int] = []
    for first, last in pairwise(edges.tolist()):
        run = y[first:last]
        keep += sorted({first + int(np.argmin(run)), first + int(np.argmax(run))})
    return x[keep], y[keep]


def _chart_data(chart: Chart) -> dict[str, Any]:
    series = []
    for each in chart.series:
        x, y = np.asarray(each.x, dtype=np.float64), np.asarray(each.y, dtype=np.float64)
        if x.shape != y.shape or x.ndim != 1:
            raise ValueError(f"series '{each.label}': x and y must be of one length")
        if each.mark is not Mark.BARS:
            x, y = thinned(x, y)
        series.append({"label": each.label, "mark": each.mark.value, "x": _rounded(x), "y": _rounded(y)})
    return {
        "x_label": chart.x_label,
        "y_label": chart.y_label,
        "height": chart.height_px,
        "y_range": chart.y_range,
        "series": series,
    }


def _rounded(values: FloatArray) -> list[float | None]:
    """Six significant digits of the largest value: more cannot be seen, and would double the page."""
    finite = values[np.isfinite(values)]
    largest = float(np.max(np.abs(finite))) if len(finite) else 1.0
    decimals = DIGITS - 1 - math.floor(math.log10(largest)) if largest > 0.0 else DIGITS
    return [round(value, decimals) if math.isfinite(value) else None for value in values.tolist()]


def _text_of(cell: str | float) -> str:
    return cell if isinstance(cell, str) else f"{cell:.2f}".replace("-", "\N{MINUS SIGN}")


def _script_safe(data: object) -> str:
    """JSON that cannot end the script element it stands in."""
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
