"""Report of stepping tests: a page that compares schemes, and sections for a test before and after."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from hdbridge import __version__
from hdbridge.commissioning.calibration.pipeline import Offer
from hdbridge.commissioning.calibration.validation import Validation, worse_ways
from hdbridge.commissioning.evaluation.stepping import Stepped
from hdbridge.commissioning.improvement.trial import Trial
from hdbridge.enums import Scheme
from hdbridge.errors import command
from hdbridge.report.page import (
    SCATTER,
    SIGMA,
    Block,
    Chart,
    Command,
    Facts,
    Grid,
    Heading,
    Level,
    Mark,
    Page,
    Section,
    Series,
    Status,
    Table,
    histogram,
)

X_LABEL: Final = "load target, deg"
Y_LABEL: Final = "load error, arcsec"
WAYS: Final = ("there (CW)", "back (CCW)")
ISO_FIGURES: Final = (
    ("accuracy_arcsec", "accuracy\nA"),
    ("repeatability_arcsec", "repeatability\nR"),
    ("reversal_arcsec", "reversal\nB"),
    ("systematic_arcsec", "systematic\nE"),
    ("range_arcsec", "range\nM"),
)


def stepping_sections(checked: Validation) -> list[Section]:
    """Returns sections for the stepping test and, if there was one, the positioning test (ISO 230-2)."""
    best_arcsec = checked.floor.three_sigma_arcsec
    facts = [
        (
            "best possible on this axis",
            f"{best_arcsec:.2f} arcsec; new model: "
            f"{checked.after.pooled.three_sigma_arcsec / best_arcsec:.2f} times that",
        ),
        *(("stepping", each) for each in checked.worse),
        *(("note", each) for each in checked.fault_notes),
    ]
    tests = (checked.before, checked.after)
    range_ = _range(tests)
    remains = _ways(checked.after)
    charts = [
        *(
            Chart(f"{when}: {each.model}", X_LABEL, Y_LABEL, _ways(each), height_px=240, y_range=range_)
            for when, each in zip(("Before", "After"), tests, strict=True)
        ),
        Chart("After, enlarged", X_LABEL, Y_LABEL, remains, height_px=240),
        _histogram("After: error histogram", remains, 240),
    ]
    text = "The axis stepped both ways, with the previous and with the new model."
    blocks: list[Block] = [scatter_table(tests), Facts(facts), Grid(charts)]
    return [Section("Stepping test: load error at rest", text, blocks), *_iso_section(checked)]


def trial_sections(trial: Trial) -> list[Section]:
    """Returns sections for the stepping test and the small steps of an improvement."""
    worse = [("small steps", each) for each in worse_ways(*trial.small)]
    title = "Small steps, within the hysteresis: load error at rest"
    return [
        *stepping_sections(trial.stepping),
        Section(title, "", [scatter_table(trial.small), Facts(worse)]),
    ]


def _range(tests: Iterable[Stepped]) -> tuple[float, float]:
    """Returns a symmetric error range that covers all tests, so that they are drawn to one scale."""
    errors = [abs(error) for each in tests for way in each.errors_arcsec for error in way]
    reach = 1.08 * max(errors, default=1.0)
    return -reach, reach


def _ways(test: Stepped) -> list[Series]:
    return [
        Series(name, targets, errors, Mark.POINTS)
        for name, targets, errors in zip(WAYS, test.targets_deg, test.errors_arcsec, strict=True)
    ]


def scatter_table(tests: Iterable[Stepped], first: str = "with", *, with_article: bool = False) -> Table:
    """Returns scatter and mean of each test; ``first`` is the heading of the column of test names."""
    header: list[str | Heading] = [first, *(Heading(each) for each in SCATTER)]
    if with_article:
        header += [Heading(f"article {SIGMA}"), Heading("mean")]
    rows: list[list[str | float]] = []
    for test in tests:
        parts = (test.pooled, test.cw, test.ccw)
        figures = (value for each in parts for value in (each.three_sigma_arcsec, each.mean_arcsec))
        rows.append([test.model, *figures])
        if with_article:
            rows[-1] += ARTICLE_TABLE_3.get(test.model, ("", ""))
    caption = ""
    if with_article:
        caption = (
            "On the right the article's Table 3. Its own Tables 1 and 2, which this axis has, cannot give "
            "it: see docs/method.md"
        )
    return Table(header, rows, caption)


def _histogram(caption: str, ways: Sequence[Series], height_px: int) -> Chart:
    return histogram(caption, Y_LABEL, {each.label: each.y for each in ways}, height_px=height_px)


def _iso_section(checked: Validation) -> list[Section]:
    given = [
        (test.model, each)
        for test, each in (
            (checked.before, checked.accuracy_before),
            (checked.after, checked.accuracy_after),
        )
        if each is not None
    ]
    if not given:
        return []
    rows = [[model, *(getattr(each, name) for name, _ in ISO_FIGURES)] for model, each in given]
    tested = given[-1][1]
    title = f"Positioning test (ISO 230-2): {tested.targets} targets, {tested.runs} approaches from each side"
    headings = [Heading(words) for _, words in ISO_FIGURES]
    return [Section(title, "", [Table(["with", *headings], rows)])]


def of_offer(offer: Offer) -> tuple[Status, tuple[Command, ...]]:
    """Returns status and next commands for a model that was tested for commit."""
    if not offer.made:
        return Status.REFUSED, ()
    if offer.pending is None:
        return Status.OFFERED, (
            Command(
                "hdbridge model log PROFILE", "shows whether this model is pending or has been committed"
            ),
        )
    profile = offer.pending.parent
    return Status.PENDING, (
        Command(command("model", "diff", profile), "shows what would change"),
        Command(command("model", "commit", profile), "makes it the active model"),
    )


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
"""Three sigma and mean, arcsec, as printed in the article's Table 3."""


def stepping_page(
    axis_name: str,
    results: Mapping[Scheme, Stepped],
    floor_arcsec: float,
    facts: Mapping[str, str],
    *,
    with_article: bool = False,
) -> Page:
    """Returns the page of a stepping test; ``with_article`` adds the article's Table 3 to the table."""
    best = _best(results)
    range_ = _range(results.values())
    return Page(
        title=f"Stepping test of axis '{axis_name}'",
        verdict=_verdict(results, floor_arcsec),
        sections=[
            Section("Figures", blocks=scheme_blocks(results, floor_arcsec, with_article=with_article)),
            Section(
                "Load error at rest",
                "Each point is one step: the load encoder's reading at rest, minus the target. The two "
                "directions are apart if the gear's hysteresis is not compensated; the wave along the "
                "angle is the synchronous error. All schemes are drawn to one scale.",
                [Grid([_errors(scheme, result, range_) for scheme, result in results.items()])],
            ),
            Section(
                f"What remains: {NAMES[best]}",
                "The same points, enlarged. A motor target is a whole number of counts, so even a perfect "
                "compensation leaves errors spread evenly over one count, from minus half a count to half a "
                "count.",
                [Grid(_remaining(results[best], floor_arcsec))],
            ),
            Section("Test conditions", blocks=[Facts([*facts.items()])]),
        ],
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; {SIGMA} is three standard "
        "deviations about the mean.",
    )


def scheme_blocks(
    results: Mapping[Scheme, Stepped],
    floor_arcsec: float,
    fault_notes: Iterable[str] = (),
    *,
    with_article: bool = False,
) -> list[Block]:
    """Returns the figures of all schemes, tolerated faults, and the best scheme relative to the floor."""
    best = _best(results)
    times = results[best].pooled.three_sigma_arcsec / floor_arcsec
    facts = [
        *(("note", each) for each in fault_notes),
        (
            "quantisation floor (3 sigma of one motor count)",
            f"{floor_arcsec:.2f}; '{best.value}' is at {times:.2f} times that",
        ),
    ]
    return [scatter_table(results.values(), "compensation", with_article=with_article), Facts(facts)]


def _best(results: Mapping[Scheme, Stepped]) -> Scheme:
    return min(results, key=lambda scheme: results[scheme].pooled.three_sigma_arcsec)


def _verdict(results: Mapping[Scheme, Stepped], floor_arcsec: float) -> str:
    best = _best(results)
    pooled = results[best].pooled
    text = (
        f"With {NAMES[best]}, the load's error at rest is {pooled.three_sigma_arcsec:.2f} arcsec ({SIGMA}) "
        f"about a mean of {pooled.mean_arcsec:z.2f}: "
        f"{pooled.three_sigma_arcsec / floor_arcsec:.2f} times the {floor_arcsec:.2f} that one motor count "
        "allows"
    )
    if Scheme.NONE in results and best is not Scheme.NONE:
        before = results[Scheme.NONE].pooled.three_sigma_arcsec
        text += f". Without compensation it is {before:.1f} arcsec"
    return text + "."


def _errors(scheme: Scheme, result: Stepped, range_: tuple[float, float]) -> Chart:
    pooled = result.pooled
    caption = (
        f"{NAMES[scheme].capitalize()}: {SIGMA} {pooled.three_sigma_arcsec:.1f} arcsec, "
        f"mean {pooled.mean_arcsec:z.2f} arcsec"
    )
    return Chart(caption, X_LABEL, Y_LABEL, _ways(result), height_px=250, y_range=range_)


def _remaining(result: Stepped, floor_arcsec: float) -> list[Chart]:
    half_count = floor_arcsec / math.sqrt(3.0)
    levels = [Level("\N{PLUS-MINUS SIGN} half a motor count", half_count), Level("", -half_count)]
    ways = _ways(result)
    return [
        Chart("Error of each step", X_LABEL, Y_LABEL, ways, height_px=280, levels=levels),
        _histogram("Error histogram", ways, 280),
    ]
