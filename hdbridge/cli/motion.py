"""``hdbridge motion``: ripple over speed, without and with compensation, and the response of the axis."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from hdbridge.cli.options import (
    HtmlOption,
    JsonOption,
    ModelOption,
    compensating_model,
    figures_table,
    note,
    print_table,
    say,
    write_json,
    write_result,
)
from hdbridge.cli.session import Session, on_axis
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.commissioning.calibration.motion import MotionTest


@on_axis
def command(
    session: Session,
    model: ModelOption = None,
    measure: Annotated[
        bool,
        typer.Option(
            "--measure/--no-measure",
            help="Measure the response of the axis, or test the one of the model file.",
        ),
    ] = True,
    propose: Annotated[
        bool,
        typer.Option("--propose", help="Keep the model with the measured response as pending."),
    ] = False,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Run the axis at several speeds; print the ripple of the load without and with compensation.

    Measures the response to a correction in motion, and compensates for it.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.axis.model.store import propose as keep
    from hdbridge.cli.measuring import phases
    from hdbridge.commissioning.calibration.motion import motion_test, motion_test_s

    files, axis = session.files, session.axis
    chosen = compensating_model(files, session.profile, model)
    if propose and not measure:
        raise InputError("--propose needs a measured response: leave --no-measure out")
    used = TransmissionModel.load(chosen)
    used.check_bound_to(axis)
    note(f"motion test: {motion_test_s(axis) / 60.0:.1f} min at most")
    with (
        session.booted() as (drive, interrupted),
        phases() as progress,
    ):
        result = motion_test(drive, used, measure=measure, progress=progress, interrupted=interrupted)
        identity = drive.identity
    write_json(json_file, result.as_dict())
    if html_file is not None:
        from hdbridge.report.motion import motion_page
        from hdbridge.report.page import render

        write_result(html_file, render(motion_page(axis.name, result)))
    print_motion(result)
    if propose and result.response is not None:
        pending = keep(
            files.axis.parent,
            result.applied(used),
            f"response in motion, known up to {result.response.known_to_hz:.0f} Hz",
            datetime.now().astimezone(),
            identity,
        )
        say(f"pending: {pending}; commit it with: hdbridge model commit {session.profile}")


def print_motion(result: MotionTest) -> None:
    """Prints the result."""
    table = Table(title="Ripple of the load at constant speed, rms arcsec", title_justify="left")
    for name in ("deg/s", "none", "static", "removed", "filtered", "removed", "orders faded out"):
        table.add_column(name, justify="left" if "orders" in name else "right")
    for each in result.ripples:
        table.add_row(
            f"{each.speed_deg_s:g}",
            f"{each.none_arcsec:.2f}",
            _figure(each.static_arcsec),
            _percent(each.removed_static_percent),
            _figure(each.filtered_arcsec),
            _percent(each.removed_percent),
            " ".join(map(str, each.faded_orders)),
        )
    print_table(table)
    fastest = result.ripples[-1]
    table = Table(title=f"Motor orders at {fastest.speed_deg_s:g} deg/s, arcsec", title_justify="left")
    for name in ("order", "Hz", "none", "static", "filtered"):
        table.add_column(name, justify="right")
    for order in fastest.orders:
        figures = (order.none_arcsec, order.static_arcsec, order.filtered_arcsec)
        table.add_row(str(order.order), f"{order.frequency_hz:.0f}", *map(_figure, figures))
    print_table(table)
    if result.paths:
        from hdbridge.report.motion import PATH_COLUMNS, path_rows

        paths = figures_table("Errors on a path, rms arcsec", *PATH_COLUMNS)
        for row in path_rows(result):
            paths.add_row(*row)
        print_table(paths)
    if result.response is not None:
        say(
            f"response known up to {result.response.known_to_hz:.0f} Hz, "
            f"following lag {result.response.following_lag_ms:.2f} ms"
        )
    if result.wind_up is not None:
        say(f"wind-up J / K {result.wind_up.inertia_over_stiffness_s2:.3g} s2: compensated in acceleration")
    if (reached := result.helps_to_deg_s) is not None:
        say(f"the compensation removes half of the ripple or more up to {reached:g} deg/s")
    for line in result.remarks:
        say(f"note: {line}")


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.0f} %"
