"""``hdbridge twin``: what the simulated drive gets wrong about an axis, and what it learns of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from hdbridge.cli.options import (
    HtmlOption,
    JsonOption,
    ProfileArgument,
    TruthOption,
    console,
    notes,
    print_table,
    write_json,
    write_result,
)
from hdbridge.errors import InputError
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.records.recording import Recording
    from hdbridge.report.twin import TwinReport
    from hdbridge.twin.translation import Translation


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("twin")(command)


def command(
    profile: ProfileArgument,
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING...", help="Recording folders or CSV files, in their order."),
    ],
    truth: TruthOption = None,
    afresh: Annotated[
        bool,
        typer.Option("--afresh", help="Begin from usual values, whatever the profile says of the plant."),
    ] = False,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Compare the simulated drive of a profile with recordings of its axis, channel by channel.

    The recordings' commands run through the simulated drive once more. It is what the profile's twin or truth
    file says, and errs as the active model says.
    """
    from hdbridge.report.page import render
    from hdbridge.report.twin import TwinReport, twin_page
    from hdbridge.twin.comparison import compare
    from hdbridge.twin.replay import legs_of, replay_directly

    files = Profile.find(profile)
    axis, recording = _loaded(files, recordings)
    begun = _beginning(files, axis, truth, afresh=afresh)
    notes.print("the recording's commands run through the simulated drive ...")
    simulated = replay_directly(recording, axis, begun.truth)
    before = compare(recording.record, simulated, legs_of(recording), axis.gear.ratio)
    report = TwinReport(
        axis.name, before, translated=begun.rows, facts=_facts(files, recording, recordings, truth, afresh)
    )
    write_json(json_file, as_dict(report))
    if html_file is not None:
        write_result(html_file, render(twin_page(report)))
    print_report(report)


def _loaded(files: Profile, recordings: list[Path]) -> tuple[AxisConfig, Recording]:
    """The axis and all recordings as one; InputError where they are not of one axis, or have no command."""
    from hdbridge.axis import AxisConfig
    from hdbridge.observations.foreign import check_once
    from hdbridge.records.recording import Recording

    axis = AxisConfig.load(files.axis)
    loaded = [Recording.load(each) for each in recordings]
    check_once(recordings, [each.record for each in loaded])
    for path, each in zip(recordings, loaded, strict=True):
        if each.axis is not None and each.axis != axis.name:
            raise InputError(
                f"{path}: a recording of axis '{each.axis}', but {axis.path} is of '{axis.name}'; expected "
                "the recordings of one axis"
            )
        if each.record.motor_target_deg is None:
            raise InputError(
                f"{path}: no column motor_target_deg; expected the commanded motor angle in each row: what "
                "the drive was told is what the simulated one is told again"
            )
        each.record.check_ratio(axis.gear.ratio)
    return axis, Recording.joined(loaded)


def _beginning(files: Profile, axis: AxisConfig, truth: Path | None, *, afresh: bool) -> Translation:
    """The simulation as it is: what the profile says of the plant, erring as the active model says."""
    from hdbridge.model import TransmissionModel
    from hdbridge.sim.truth import Truth
    from hdbridge.twin.translation import translate

    if truth is not None and afresh:
        raise InputError("--afresh begins from usual values: leave out --truth")
    plant = truth or (files.simulated if files.simulated.is_file() and not afresh else None)
    model = TransmissionModel.load(files.model) if files.model.is_file() else None
    if model is not None:
        model.check_bound_to(axis)
    return translate(axis, model, Truth.load(plant) if plant is not None else None)


def _facts(
    files: Profile, recording: Recording, paths: list[Path], truth: Path | None, afresh: bool
) -> list[tuple[str, str]]:
    import numpy as np

    plant = truth or files.simulated
    rows = [("recording", str(each)) for each in paths]
    rows.append(("axis", str(files.axis)))
    rows.append(("simulated by", "usual values" if afresh or not plant.is_file() else str(plant)))
    rows.append(
        ("errs as", str(files.model) if files.model.is_file() else "that says: there is no active model")
    )
    if recording.date:
        rows.append(("recorded", recording.date))
    return [*rows, ("samples", f"{len(recording.record):,} in {np.ptp(recording.record.time_s):,.0f} s")]


def as_dict(report: TwinReport) -> dict[str, Any]:
    """The result for machines, ``hdbridge.twin/1``."""
    return {
        "schema": "hdbridge.twin/1",
        "axis": report.axis,
        "before": report.before.as_dict(),
        "after": report.after.as_dict() if report.after is not None else None,
        "parameters": [
            {
                "name": each.name,
                "unit": each.unit,
                "before": each.before,
                "value": each.after,
                "ci95": list(each.interval) if each.interval else None,
            }
            for each in report.learned
        ],
        "findings": [{"cause": each.cause, "text": each.text} for each in report.named],
        "from_model": [
            {"effect": each.effect, "counterpart": each.counterpart, "note": each.note}
            for each in report.translated
        ],
    }


def print_report(report: TwinReport) -> None:
    """The verdict and the figures of the whole record."""
    from hdbridge.report.twin import title_of, verdict
    from hdbridge.twin.comparison import ALL

    for each in report.translated:
        if each.counterpart is None:
            notes.print(f"{each.effect} is not simulated: {each.note}", markup=False, soft_wrap=True)
    console.print(escape(verdict(report)), soft_wrap=True)
    table = Table("")
    columns = ["measured", "simulated", *(["before"] if report.after else []), "difference", "of the noise"]
    for name in columns:
        table.add_column(name, justify="right")
    table.add_column("unit")
    for row in report.now.rows:
        if row.kind != ALL:
            continue
        cells = [f"{row.measured:.4g}", f"{row.simulated:.4g}"]
        if report.after is not None:
            was = report.before.row(row.channel)
            cells.append(f"{was.difference:.4g}" if was else "")
        table.add_row(title_of(row), *cells, f"{row.difference:.4g}", f"{row.in_noise:.3g}", row.unit)
    print_table(table)
    for named in report.named:
        console.print(f"{named.cause}: {named.text}", markup=False, soft_wrap=True)
