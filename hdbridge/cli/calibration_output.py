"""Printed results of `calibrate`, `fit` and `report`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from hdbridge.cli.options import figures_table, print_table, say, write_result

if TYPE_CHECKING:
    from hdbridge.cli.session import Session
    from hdbridge.commissioning.calibration import Calibration, Stepped, Validation
    from hdbridge.commissioning.calibration.result import Offer
    from hdbridge.commissioning.evaluation.stepping import Scatter

TAKEN_OFF = 0.95
"""Terms fitted in addition to the model (a delay, load orders) are reported if they reduce the residual to
this share or less.
"""


def print_calibration(result: Calibration) -> None:
    """Prints parameters with intervals, held-out figures, undetermined parameters and the stepping test."""
    from hdbridge.axis.model.difference import diff
    from hdbridge.units import figure, unit_of, with_interval

    fit = result.fit
    before = (
        {(each.effect, each.parameter): each.before for each in diff(result.active, result.model)}
        if result.active
        else {}
    )
    table = Table(title=_title(result), title_justify="left")
    for name in ("effect", "parameter"):
        table.add_column(name)
    for name in ("value", "± 95 %", "was" if before else "unit"):
        table.add_column(name, justify="right" if name != "unit" else "left")
    for each in fit.intervals:
        was = before.get((each.effect, each.parameter))
        value, half_width = with_interval(each.value, each.half_width)
        table.add_row(
            each.effect,
            escape(each.parameter),
            *((value, half_width) if each.identifiable else (f"({figure(each.value)})", "not known")),
            # With a previous model there is no space for the unit column; the names contain the units.
            ("-" if was is None else with_interval(was, each.half_width)[0])
            if before
            else unit_of(each.parameter),
        )
    print_table(table)
    noise = fit.noise
    standing = "not measured" if noise.standing_arcsec is None else f"{noise.standing_arcsec:.2f}"
    apart = ""
    if noise.fitted_arcsec < TAKEN_OFF * noise.residual_arcsec:
        apart = f"; {noise.fitted_arcsec:.2f} with what was fitted in addition to the model taken off"
    say(f"noise at rest {standing}, residual {noise.residual_arcsec:.2f} arcsec rms{apart}")
    say(f"held out: {fit.held_out.text}")
    if len(result.drift) > 1:
        errors = [error for _, error in result.drift]
        say(f"reference pose: {max(errors) - min(errors):.2f} arcsec of drift over {len(errors)} visits")
    for test in fit.residual_tests:
        if not test.passed:
            say(f"residual: {test.text}")
    for warning in fit.warnings:
        say(f"note: {warning}")
    if result.validation:
        print_stepping(result.validation)
    if result.motion:
        from hdbridge.cli.motion import print_motion

        print_motion(result.motion)
    if result.offer:
        say(result.offer.reason, style=None if result.offer.made else "bold")


def write_calibration_page(path: Path, result: Calibration) -> None:
    """Writes the result as a self-contained page."""
    from hdbridge.report.calibration import calibration_page
    from hdbridge.report.page import render

    write_result(path, render(calibration_page(result)))


def print_page(path: Path) -> None:
    """Prints the path of the page."""
    say(f"report: {path}")


def print_next(offer: Offer | None, session: Session) -> None:
    """Prints the commands for a pending model. The daemon that lent its bus commits it, and uses it."""
    if offer is not None and offer.made:
        folder = session.files.axis.parent
        daemon = f"hdbridge ctl model {session.axis.name} pending"
        use = daemon if session.borrow else f"hdbridge model commit {folder}"
        say(f"pending: {offer.pending}\nreview it: hdbridge model diff {folder}\nuse it: {use}")


def _title(result: Calibration) -> str:
    axis = f"axis '{result.axis}'" if result.axis else ", ".join(result.recordings)
    return escape(f"Model of {axis}, ratio {result.model.ratio:g}")


def print_stepping(checked: Validation) -> None:
    """Prints the stepping test with the previous and the new model, next to the floor of the axis."""
    print_steps("Stepping test: load error at rest, arcsec", (checked.before, checked.after))
    print_worse("stepping", checked.worse)
    _print_accuracy(checked)
    for line in checked.survived:
        say(f"note: {line}")
    floor = checked.floor
    say(
        f"best possible on this axis: {floor.three_sigma_arcsec:.2f} arcsec; new model: "
        f"{checked.after.pooled.three_sigma_arcsec / floor.three_sigma_arcsec:.2f} times that"
    )


def print_steps(title: str, tests: Iterable[Stepped]) -> None:
    """Prints scatter and mean of stepping tests, one line each."""
    print_scatter(title, "with", ((each.model, (each.cw, each.ccw, each.pooled)) for each in tests))


def print_worse(test: str, ways: Iterable[str]) -> None:
    """Prints what got worse in one direction."""
    for each in ways:
        say(f"{test}: {each}", style="bold")


def _print_accuracy(checked: Validation) -> None:
    found = ((checked.before.model, checked.accuracy_before), (checked.after.model, checked.accuracy_after))
    rows = [(model, each) for model, each in found if each is not None]
    if not rows:
        return
    table = figures_table(
        f"Positioning test (ISO 230-2), arcsec: {rows[0][1].targets} targets, {rows[0][1].runs} "
        "approaches from each side",
        "with",
        *("accuracy\nA", "repeatability\nR", "reversal\nB", "systematic\nE", "range\nM"),
    )
    for model, each in rows:
        figures = (each.accuracy, each.repeatability, each.reversal, each.systematic, each.range)
        table.add_row(model, *(f"{value:z.2f}" for value in figures))
    print_table(table)


def print_scatter(
    title: str, first: str, rows: Iterable[tuple[str, tuple[Scatter, Scatter, Scatter]]]
) -> None:
    """Prints a line for each test: its name in the column ``first``, then its CW, CCW and pooled figures."""
    table = figures_table(title, first, *("CW 3σ", "mean", "CCW 3σ", "mean", "pooled 3σ", "mean"))
    for name, parts in rows:
        figures = (value for part in parts for value in (part.three_sigma_arcsec, part.mean_arcsec))
        table.add_row(name, *(f"{value:z.2f}" for value in figures))
    print_table(table)
