"""The page of a stepping test under several compensation schemes."""

from __future__ import annotations

from collections.abc import Mapping

from hdbridge import __version__
from hdbridge.report.page import Chart, Facts, Mark, Page, Section, Series, Table
from hdbridge.stepping import Scheme, SchemeResult

ARTICLE_TABLE_3 = {
    "none": (75.0, 34.2),
    "synchronous": (50.2, 29.0),
    "hysteresis": (55.7, -23.2),
    "both": (30.2, -29.15),
}
"""3 sigma and mean, arcsec, as the article's Table 3 prints them."""


def stepping_page(
    axis_name: str,
    results: Mapping[Scheme, SchemeResult],
    floor_arcsec: float,
    facts: Mapping[str, str],
    *,
    beside_article: bool = False,
) -> Page:
    """The page; ``beside_article`` sets the article's Table 3 beside the result."""
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
            Section(
                "Load error at rest",
                "Each point is one step: what the load encoder read at rest, minus the target. The way there "
                "and the way back are apart where the gear's hysteresis is not compensated; the wave along "
                "the angle is the synchronous error. All schemes are drawn to one scale.",
                [_errors(scheme, result, reach) for scheme, result in results.items()],
            ),
            Section(
                "What remains",
                f"Scheme '{best.value}' again, enlarged. Drag to enlarge any chart, double-click to go back.",
                [_errors(best, results[best], None)],
            ),
            Section("Figures", blocks=[_table(results, beside_article)]),
            Section("What was done", blocks=[Facts([*facts.items()])]),
        ],
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; 3\N{GREEK SMALL LETTER SIGMA} is "
        "three standard deviations about the mean.",
    )


def _best(results: Mapping[Scheme, SchemeResult]) -> Scheme:
    return min(results, key=lambda scheme: results[scheme].pooled.three_sigma_arcsec)


def _verdict(results: Mapping[Scheme, SchemeResult], floor_arcsec: float) -> str:
    best = _best(results)
    three_sigma = results[best].pooled.three_sigma_arcsec
    text = (
        f"With compensation '{best.value}' the load stands within 3\N{GREEK SMALL LETTER SIGMA} = "
        f"{three_sigma:.2f} arcsec of its target, {three_sigma / floor_arcsec:.2f} times the "
        f"{floor_arcsec:.2f} arcsec that one motor count allows"
    )
    if Scheme.NONE in results and best is not Scheme.NONE:
        before = results[Scheme.NONE].pooled.three_sigma_arcsec
        text += f"; without compensation it is {before:.1f} arcsec"
    return text + "."


def _errors(scheme: Scheme, result: SchemeResult, reach_arcsec: float | None) -> Chart:
    series = [
        Series(label, [s.target_deg for s in stands], [s.error_arcsec for s in stands], Mark.POINTS)
        for label, stands in (("there (CW)", result.outcome.cw), ("back (CCW)", result.outcome.ccw))
    ]
    pooled = result.pooled
    caption = (
        f"{scheme.value}: pooled 3\N{GREEK SMALL LETTER SIGMA} {pooled.three_sigma_arcsec:.2f}, "
        f"mean {pooled.mean_arcsec:.2f} arcsec"
    )
    y_range = None if reach_arcsec is None else (-reach_arcsec, reach_arcsec)
    return Chart(caption, "load target, deg", "load error, arcsec", series, height_px=240, y_range=y_range)


def _table(results: Mapping[Scheme, SchemeResult], beside_article: bool) -> Table:
    sigma = "3\N{GREEK SMALL LETTER SIGMA}"
    header = ["compensation", f"CW {sigma}", "mean", f"CCW {sigma}", "mean", f"pooled {sigma}", "mean"]
    if beside_article:
        header += [f"article {sigma}", "mean"]
    rows: list[list[str | float]] = []
    for scheme, result in results.items():
        row: list[str | float] = [scheme.value]
        for part in (result.cw, result.ccw, result.pooled):
            row += [part.three_sigma_arcsec, part.mean_arcsec]
        if beside_article:
            row += ARTICLE_TABLE_3.get(scheme.value, ("", ""))
        rows.append(row)
    caption = "arcsec at the load"
    if beside_article:
        caption += (
            "; the article's Table 3 beside it. Its own Tables 1 and 2, which this axis has, cannot give it: "
            "see docs/article-table-3.md"
        )
    return Table(header, rows, caption)
