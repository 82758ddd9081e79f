"""Sections of a stepping test before and after: the gain of a new model on the axis itself."""

from collections.abc import Iterator
from typing import Final

from hdbridge.commissioning.calibration.validation import Validation
from hdbridge.report.page import Block, Chart, Grid, Heading, Mark, Section, Series, Table, histogram
from hdbridge.report.words import SCATTER, SIGMA

X_LABEL: Final = "load target, deg"
Y_LABEL: Final = "error, arcsec"
WAYS: Final = ("there (CW)", "back (CCW)")
ISO_FIGURES: Final = (
    ("accuracy", "accuracy A"),
    ("repeatability", "repeatability R"),
    ("reversal", "reversal B"),
    ("systematic", "systematic E"),
    ("range", "range M"),
)


def stepping_sections(checked: Validation) -> list[Section]:
    """Returns the stepping test, and the ISO 230-2 figures if the plan had a positioning test."""
    return [Section("Stepping test", _stepping_text(checked), [*_stepping(checked)]), *_iso_section(checked)]


def _stepping_text(checked: Validation) -> str:
    share = checked.after.pooled.three_sigma_arcsec / checked.floor.three_sigma_arcsec
    return (
        f"The axis stepped both ways, before and after. This axis's counts and noise allow {SIGMA} = "
        f"{checked.floor.three_sigma_arcsec:.2f} arcsec at best; with the new model it is {share:.2f} times "
        f"that.{''.join(f' It got {each}.' for each in checked.worse)}"
        f"{''.join(f' Noted: {each}.' for each in checked.survived)}"
    )


def _stepping(checked: Validation) -> Iterator[Block]:
    rows: list[list[str | float]] = []
    charts, remains = [], {}
    reach = 1.08 * max(
        (
            abs(error)
            for each in (checked.before, checked.after)
            for way in each.errors_arcsec
            for error in way
        ),
        default=1.0,
    )
    for when, each in (("before", checked.before), ("after", checked.after)):
        row: list[str | float] = [f"{when}: {each.model}"]
        for part in (each.pooled, each.cw, each.ccw):
            row += [part.three_sigma_arcsec, part.mean_arcsec]
        rows.append(row)
        series = [
            Series(name, targets, errors, Mark.POINTS)
            for name, targets, errors in zip(WAYS, each.targets_deg, each.errors_arcsec, strict=True)
        ]
        caption = f"{when.capitalize()}: {each.model}"
        charts.append(Chart(caption, X_LABEL, Y_LABEL, series, height_px=240, y_range=(-reach, reach)))
        remains = {one.label: one.y for one in series}
    after = Chart("After, enlarged", X_LABEL, Y_LABEL, charts[-1].series, height_px=240)
    yield Table(["with", *(Heading(each) for each in SCATTER)], rows)
    yield Grid([*charts, after, histogram("After: error histogram", Y_LABEL, remains, height_px=240)])


def _iso_section(checked: Validation) -> list[Section]:
    given = [
        (when, each)
        for when, each in (("before", checked.accuracy_before), ("after", checked.accuracy_after))
        if each is not None
    ]
    if not given:
        return []
    rows = [[when, *(getattr(each, name) for name, _ in ISO_FIGURES)] for when, each in given]
    tested = given[-1][1]
    text = (
        f"The figures of ISO 230-2 for a rotary axis: {tested.targets} targets, each approached "
        f"{tested.runs} times from either side."
    )
    headings = [Heading(words) for _, words in ISO_FIGURES]
    return [Section("Accuracy and repeatability", text, [Table(["with", *headings], rows)])]
