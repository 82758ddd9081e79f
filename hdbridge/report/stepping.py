"""Report page of a stepping test under several compensation schemes."""

import math
from collections.abc import Mapping
from typing import Final

from hdbridge import __version__
from hdbridge.commissioning.evaluation.stepping import Scheme, SchemeResult
from hdbridge.report.page import (
    Chart,
    Facts,
    Grid,
    Heading,
    Level,
    Mark,
    Page,
    Section,
    Series,
    Table,
    histogram,
)
from hdbridge.report.words import SCATTER, SIGMA

X_LABEL: Final = "load target, deg"
Y_LABEL: Final = "load error, arcsec"
NAMES: Final = {
    Scheme.NONE: "no compensation",
    Scheme.SYNCHRONOUS: "synchronous compensation",
    Scheme.HYSTERESIS: "hysteresis compensation",
    Scheme.BOTH: "both compensations",
    Scheme.EXTENDED: "the extended model's compensation",
}

ARTICLE_TABLE_3 = {
    "none": (75.0, 34.2),
    "synchronous": (50.2, 29.0),
    "hysteresis": (55.7, -23.2),
    "both": (30.2, -29.15),
}
"""3 sigma and mean, arcsec, as printed in the article's Table 3."""


def stepping_page(
    axis_name: str,
    results: Mapping[Scheme, SchemeResult],
    floor_arcsec: float,
    facts: Mapping[str, str],
    *,
    with_article: bool = False,
) -> Page:
    """Returns the page; ``with_article`` adds the article's Table 3 to the result."""
    best = _best(results)
    reach = 1.08 * max(
        abs(stand.error_arcsec)
        for result in results.values()
        for stand in (*result.outcome.cw, *result.outcome.ccw)
    )
    return Page(
        title=f"Stepping test of axis '{axis_name}'",
        verdict=_verdict(results, floor_arcsec),
        sections=[
            Section("Figures", blocks=[_table(results, with_article)]),
            Section(
                "Load error at rest",
                "Each point is one step: what the load encoder read at rest, minus the target. The two "
                "directions are apart where the gear's hysteresis is not compensated; the wave along the "
                "angle is the synchronous error. All schemes are drawn to one scale.",
                [Grid([_errors(scheme, result, reach) for scheme, result in results.items()])],
            ),
            Section(
                f"What remains: {_name(best)}",
                "The same points, enlarged. A motor target is a whole number of counts, so even a perfect "
                "compensation leaves errors spread evenly over one count, from minus half a count to half a "
                "count.",
                [Grid(_remaining(results[best], floor_arcsec))],
            ),
            Section("What was done", blocks=[Facts([*facts.items()])]),
        ],
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; {SIGMA} is three standard "
        "deviations about the mean.",
    )


def _best(results: Mapping[Scheme, SchemeResult]) -> Scheme:
    return min(results, key=lambda scheme: results[scheme].pooled.three_sigma_arcsec)


def _name(scheme: Scheme) -> str:
    return NAMES[scheme]


def _verdict(results: Mapping[Scheme, SchemeResult], floor_arcsec: float) -> str:
    best = _best(results)
    pooled = results[best].pooled
    text = (
        f"With {_name(best)}, the load's error at rest is {pooled.three_sigma_arcsec:.2f} arcsec ({SIGMA}) "
        f"about a mean of {_signed(pooled.mean_arcsec)}: {pooled.three_sigma_arcsec / floor_arcsec:.2f} "
        f"times the {floor_arcsec:.2f} that one motor count allows"
    )
    if Scheme.NONE in results and best is not Scheme.NONE:
        before = results[Scheme.NONE].pooled.three_sigma_arcsec
        text += f". Without compensation it is {before:.1f} arcsec"
    return text + "."


def _errors(scheme: Scheme, result: SchemeResult, reach_arcsec: float) -> Chart:
    pooled = result.pooled
    caption = (
        f"{_name(scheme).capitalize()}: {SIGMA} {pooled.three_sigma_arcsec:.1f} arcsec, "
        f"mean {_signed(pooled.mean_arcsec)} arcsec"
    )
    return Chart(
        caption, X_LABEL, Y_LABEL, _by_way(result), height_px=250, y_range=(-reach_arcsec, reach_arcsec)
    )


def _remaining(result: SchemeResult, floor_arcsec: float) -> list[Chart]:
    half_count = floor_arcsec / math.sqrt(3.0)
    levels = [Level("\N{PLUS-MINUS SIGN} half a motor count", half_count), Level("", -half_count)]
    ways = _by_way(result)
    return [
        Chart("Error of each step", X_LABEL, Y_LABEL, ways, height_px=280, levels=levels),
        histogram("Error histogram", Y_LABEL, {each.label: each.y for each in ways}, height_px=280),
    ]


def _by_way(result: SchemeResult) -> list[Series]:
    return [
        Series(label, [s.target_deg for s in stands], [s.error_arcsec for s in stands], Mark.POINTS)
        for label, stands in (("there (CW)", result.outcome.cw), ("back (CCW)", result.outcome.ccw))
    ]


def _signed(value: float) -> str:
    """Formats two decimals with a typographic minus sign, and no minus before a zero."""
    text = f"{value:.2f}"
    return text.lstrip("-") if float(text) == 0.0 else text.replace("-", "\N{MINUS SIGN}")


def _table(results: Mapping[Scheme, SchemeResult], with_article: bool) -> Table:
    header: list[str | Heading] = ["compensation", *(Heading(each) for each in SCATTER)]
    if with_article:
        header += [Heading(f"article {SIGMA}"), Heading("mean")]
    rows: list[list[str | float]] = []
    for scheme, result in results.items():
        row: list[str | float] = [scheme.value]
        for part in (result.pooled, result.cw, result.ccw):
            row += [part.three_sigma_arcsec, part.mean_arcsec]
        if with_article:
            row += ARTICLE_TABLE_3.get(scheme.value, ("", ""))
        rows.append(row)
    caption = ""
    if with_article:
        caption = (
            "On the right the article's Table 3. Its own Tables 1 and 2, which this axis has, cannot give "
            "it: see docs/method.md"
        )
    return Table(header, rows, caption)
