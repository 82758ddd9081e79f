"""``hdbridge twin``: differences between the simulated drive and an axis, and the fit that reduces them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import note, print_table, progress_bar, say, write_json, write_page
from hdbridge.errors import InputError, command
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.records.recording import Recording
    from hdbridge.report.twin import Learned, TwinReport
    from hdbridge.sim.truth import Truth
    from hdbridge.twin.translate import Translation


@taking(opt.CsvFormat)
def twin(
    csv: opt.CsvFormat,
    profile: opt.Profile,
    recordings: Annotated[
        list[Path], Argument(metavar="RECORDING...", help="Recording folders or CSV files, in order of time.")
    ],
    check: Annotated[
        bool, Option("--check", help="Only report changes since the profile's twin was made.")
    ] = False,
    compare: Annotated[
        bool, Option("--compare", help="Only compare the current simulation with the recordings.")
    ] = False,
    truth: opt.Truth = None,
    afresh: Annotated[bool, Option("--afresh", help="Start from typical values.")] = False,
    json_file: opt.Json = None,
    html_file: opt.Html = None,
) -> None:
    """Fit the simulated drive to recordings of an axis; report its errors, and keep the twin as pending.

    The fit starts from the profile's twin or truth file. `--simulate` uses the twin after `hdbridge model
    commit PROFILE --twin`.
    """
    from hdbridge.axis import AxisConfig
    from hdbridge.report.twin import twin_page
    from hdbridge.twin.replay import doubts

    files = Profile.find(profile)
    if check and (compare or afresh or truth is not None):
        raise InputError(
            "--check compares the recordings with the profile's twin: leave out the other options"
        )
    axis = AxisConfig.load(files.axis)
    recording = _joined(axis, csv.load(recordings))
    for doubt in doubts(recording, axis):
        note(f"look at the recording: {doubt}")
    if check:
        _check(files, axis, recording, json_file, html_file)
        return
    begun = _beginning(files, axis, truth, afresh=afresh)
    facts = _facts(files, recording, recordings, truth, afresh)
    if compare:
        report = _compared(axis, recording, begun, facts)
    else:
        report = _learned(files, axis, recording, recordings, begun, facts)
    # Files are written first, because the reader of the tables may close the pipe (`| head`).
    write_json(json_file, as_dict(report))
    if html_file is not None:
        write_page(html_file, twin_page(report))
    print_report(report)


def _compared(
    axis: AxisConfig, recording: Recording, begun: Translation, facts: list[tuple[str, str]]
) -> TwinReport:
    from hdbridge.report.twin import TwinReport
    from hdbridge.twin.compare import compare
    from hdbridge.twin.replay import legs_of, replay

    note("the recording's commands run through the simulated drive ...")
    simulated = replay(recording, axis, begun.truth)
    found = compare(recording.record, simulated, legs_of(recording), axis.gear.ratio)
    return TwinReport(axis.name, found, translated=begun.rows, facts=facts)


def _learned(
    files: Profile,
    axis: AxisConfig,
    recording: Recording,
    paths: list[Path],
    begun: Translation,
    facts: list[tuple[str, str]],
) -> TwinReport:
    """Fits a twin, and keeps it as pending if it is better on held-out legs."""
    from datetime import datetime

    from hdbridge.axis.model.store import measuring
    from hdbridge.report.page import Command, Status
    from hdbridge.report.twin import TwinReport
    from hdbridge.twin.twin import TWINS, TwinFile, fit_twin, judge

    TWINS.check_pending(files.folder)
    with measuring(files.axis), progress_bar() as bar:
        task = bar.add_task("fit", total=1.0)
        twin = fit_twin([recording], axis, begun.truth, lambda share: bar.update(task, completed=share))
        verdict = judge(twin)
        if verdict.kept:
            kept = TwinFile(twin.truth).with_provenance(recordings=[str(each) for each in paths])
            reason = f"learned from {', '.join(each.name for each in paths)}"
            TWINS.propose(files.folder, kept, reason, datetime.now().astimezone(), recording.drive)
    commit = Command(command("model", "commit", files.folder, "--twin"), "makes --simulate use it")
    return TwinReport(
        axis.name,
        twin.before,
        twin.after,
        learned=_values(begun.truth, twin.truth) if verdict.kept else (),
        # If the twin is no better, only its unexplained residual is reported.
        named=[*twin.findings, *twin.inseparable_sets, *twin.unexplained]
        if verdict.kept
        else twin.unexplained,
        translated=begun.rows,
        facts=facts,
        verdict=verdict.text,
        values=str(twin.values),
        channel_residuals=twin.channel_residuals,
        commands=(commit,) if verdict.kept else (),
        status=Status.PENDING if verdict.kept else Status.REFUSED,
    )


def _values(before: Truth, after: Truth) -> list[Learned]:
    """Returns the fitted values with their intervals, and the previous values unless only assumed."""
    from hdbridge.report.twin import Learned
    from hdbridge.twin.misfit import Values
    from hdbridge.twin.parameters import PARAMETERS, value_in
    from hdbridge.twin.thermal import THERMAL

    fitted, assumed = after.provenance["fit"]["parameters"], Values.of(before) is Values.USUAL
    rows = []
    for each in {parameter.path: parameter for parameter in (*PARAMETERS, *THERMAL)}.values():
        now, interval = value_in(after, each), after.intervals.get(each.path)
        if now is not None and (interval is not None or each.name in fitted):
            was = None if assumed else value_in(before, each)
            rows.append(Learned(each.name, each.unit, was, now, interval))
    return rows


def _check(
    files: Profile, axis: AxisConfig, recording: Recording, json_file: Path | None, html_file: Path | None
) -> None:
    """Reports the changes since the profile's twin was made, in one sentence."""
    from hdbridge.twin.check import check
    from hdbridge.twin.twin import TwinFile

    if html_file is not None:
        raise InputError("--check writes no page: leave out --html, or use --compare")
    twin = TwinFile.load(files.twin) if files.twin.is_file() else None
    if twin is None:
        raise InputError(
            f"{files.folder}: there is no active twin to check; make one with 'hdbridge twin', and commit it "
            f"with: {command('model', 'commit', files.folder, '--twin')}"
        )
    twin.check_bound_to(axis, recording.drive)
    with progress_bar() as bar:
        task = bar.add_task("check", total=1.0)
        found = check(recording, axis, twin.truth, lambda share: bar.update(task, completed=share))
    write_json(
        json_file,
        {
            "schema": "hdbridge.twin-check/1",
            "axis": axis.name,
            "twin": str(files.twin),
            "sentence": found.sentence,
            "changes": [{"cause": each.cause, "text": str(each)} for each in found.changes],
            "misfit_growth": dict(found.growth_before),
            "unexplained": found.unexplained,
            "unseen": list(found.unseen),
        },
    )
    say(found.sentence)


def _joined(axis: AxisConfig, recordings: dict[Path, Recording]) -> Recording:
    """Joins the recordings; raises `InputError` if one is of another axis or has no commanded position."""
    from hdbridge.analysis.checks import check_records
    from hdbridge.records.recording import Recording

    for path, each in recordings.items():
        if each.axis is not None and each.axis != axis.name:
            raise InputError(
                f"{path}: a recording of axis '{each.axis}', but {axis.path} describes '{axis.name}'; "
                "expected the recordings of one axis"
            )
        if each.record.motor_target_deg is None:
            name = "; pass --columns target=COLUMN" if each.record.origin is not None else ""
            raise InputError(
                f"{path}: no column motor_target_deg; expected the commanded motor angle in each row, "
                f"because the simulated drive receives the same commands as the real one{name}"
            )
    check_records({path: each.record for path, each in recordings.items()}, axis.gear.ratio, str(axis.path))
    return Recording.joined(list(recordings.values()))


def _beginning(files: Profile, axis: AxisConfig, truth: Path | None, *, afresh: bool) -> Translation:
    """Returns the initial simulation: the profile's plant with the active model's transmission error."""
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.sim.truth import Truth
    from hdbridge.twin.translate import translate

    if truth is not None and afresh:
        raise InputError("--afresh starts from typical values: leave out --truth")
    plant = truth or (files.simulated if files.simulated.is_file() and not afresh else None)
    model = TransmissionModel.load(files.model) if files.model.is_file() else None
    if model is not None:
        model.check_bound_to(axis)
    begun = translate(axis, model, Truth.load(plant) if plant is not None else None)
    if not (begun.truth.gear.hysteresis or begun.truth.gear.motor_orders):
        note(
            "no transmission error is simulated: neither a model nor the plant's file has one. Its effect on "
            "torque and following error may be attributed to motor or loops; calibrate first "
            f"({command('calibrate', files.folder)})"
        )
    return begun


def _facts(
    files: Profile, recording: Recording, paths: list[Path], truth: Path | None, afresh: bool
) -> list[tuple[str, str]]:
    import numpy as np

    plant = truth or files.simulated
    error = str(files.model) if files.model.is_file() else "of the plant, as there is no active model"
    rows = [
        *(("recording", str(each)) for each in paths),
        ("axis", str(files.axis)),
        ("simulated by", "usual values" if afresh or not plant.is_file() else str(plant)),
        ("transmission error", error),
    ]
    if recording.date:
        rows.append(("recorded", recording.date))
    return [*rows, ("samples", f"{len(recording.record):,} in {np.ptp(recording.record.time_s):,.0f} s")]


def as_dict(report: TwinReport) -> dict[str, Any]:
    """Returns the result as data, ``hdbridge.twin/1``."""
    return {
        "schema": "hdbridge.twin/1",
        "axis": report.axis,
        "verdict": report.verdict,
        "values": report.values,
        "left": [{**asdict(each), "explained": each.explained} for each in report.channel_residuals],
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
        "from_model": [asdict(each) for each in report.translated],
    }


def print_report(report: TwinReport) -> None:
    """Prints the verdict, the figures of the whole record, and the findings."""
    from hdbridge.report.page import sentence
    from hdbridge.report.twin import figures, verdict
    from hdbridge.twin.misfit import Values

    for effect in report.translated:
        if effect.counterpart is None:
            note(f"{effect.effect} is not simulated: {effect.note}")
    if report.verdict:
        say(sentence(report.verdict), style="bold")
    say(verdict(report))
    print_table(*figures(report))
    for named in report.named:
        say(f"{named.cause}: {named.text}")
    for estimate in report.learned if report.values == Values.AXIS else ():
        if estimate.before is None:
            say(estimate.text)
    for each in report.commands:
        say(f"  {each.line}   # {each.purpose}")


COMMANDS: Final = {"twin": twin}
