"""``hdbridge improve``: diagnoses a drive, extends its model, steps again, keeps the better
model as pending.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.measuring import PlanOption, out_option, resume_option
from hdbridge.cli.options import (
    ColumnsOption,
    HtmlOption,
    IndependentZerosOption,
    JsonOption,
    UnitsOption,
    UnwrapOption,
    load_recordings,
    note,
    say,
    write_json,
    write_result,
)
from hdbridge.cli.session import Session, on_axis
from hdbridge.errors import InputError
from hdbridge.files.outputs import Kind
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.improvement import Improvement

LEFT_OF_FLOOR = 1.5
"""Ratio of a stepping test to its floor above which a further cause is suspected."""


@on_axis
def command(
    session: Session,
    plan: PlanOption = "quick",
    given: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            metavar="RECORDING",
            help="Diagnose this and measure nothing; may be repeated, in order of time.",
        ),
    ] = None,
    independent_zeros: IndependentZerosOption = False,
    columns: ColumnsOption = None,
    units: UnitsOption = None,
    unwrap: UnwrapOption = None,
    auto: Annotated[
        bool,
        typer.Option("--auto", help="Run further experiments if causes cannot be separated."),
    ] = False,
    rounds: Annotated[
        int, typer.Option("--rounds", min=1, max=20, help="With --auto: maximum number of experiments.")
    ] = 3,
    out: Annotated[Path | None, out_option("Where the recordings go"), Kind.FOLDER] = None,
    resume: Annotated[Path | None, resume_option("Continue an interrupted improvement.")] = None,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Diagnose the active model, extend it, step with both, and keep the better one as pending.

    The axis moves within the limits of its axis file. Ctrl-C stops it and keeps what was measured.
    """
    from hdbridge.cli.measuring import Measurement, phases
    from hdbridge.commissioning.improvement import Source, improve
    from hdbridge.commissioning.improvement.trial import trial_s

    files, axis = session.files, session.axis
    active = _active(files)
    if given and resume is not None:
        raise InputError("--from and --resume exclude each other: leave one of them out")
    recordings = load_recordings(given or (), columns, units, unwrap)  # refused before anything is connected
    work = Measurement.asked(axis, plan, out, resume)
    trial = f"{trial_s(work.plan, axis, active) / 60:.1f} min to step with both models, if something is found"
    if recordings:
        note(f"nothing is measured first; {trial}")
    else:
        work.announce(trial)
    with work.booted(session) as (drive, interrupted):
        journal = None if recordings else work.begun(drive, session.simulated_seed)
        with phases() as progress:
            result = improve(
                drive,
                Source(work.plan, work.folder, journal, recordings, independent_zeros),
                files.axis.parent,
                active,
                work.date,
                rounds=rounds if auto else 0,
                progress=progress,
                interrupted=interrupted,
                tell=note,
            )
    report(result, work.folder, session, json_file, html_file)


def report(
    result: Improvement, folder: Path, session: Session, json_file: Path | None, html_file: Path | None
) -> None:
    """Writes and prints the result and the next steps."""
    from hdbridge.cli.calibration_output import (
        print_next,
        print_page,
        print_stepping,
        print_steps,
        print_worse,
    )
    from hdbridge.cli.diagnose import print_diagnosis
    from hdbridge.commissioning.calibration.validation import worse_ways

    page = html_file or (folder / "report.html" if folder.is_dir() else None)
    write_json(json_file, result.as_dict())
    if page is not None:
        write_page(page, result)
    print_diagnosis(result.diagnosis)
    for line in result.extension.left:
        say(line)
    for line in result.survived:
        say(f"note: {line}")
    if result.further is not None:
        further = result.further
        say(
            f"the axis could separate {', '.join(further.separates)} on its own (--auto), in "
            f"{further.duration_s / 60:.0f} min: {further.plan.about}"
        )
    if result.trial is not None:
        print_stepping(result.trial.stepping)
        print_steps("Small steps, within the hysteresis: load error at rest, arcsec", result.trial.small)
        print_worse("small steps", worse_ways(*result.trial.small))
        if result.trial.of_floor > LEFT_OF_FLOOR:
            say(
                f"stepping is still {result.trial.of_floor:.1f} times the floor: something is left that "
                "these data do not show; --auto, or a plan with two load turns, shows more"
            )
    say(result.offer.reason, style=None if result.offer.made else "bold")
    say(f"\nrecordings: {', '.join(result.recordings)}")
    if page is not None:
        print_page(page)
    print_next(result.offer, session)


def write_page(path: Path, result: Improvement) -> None:
    """Writes the diagnosis with the stepping test as a self-contained page."""
    from hdbridge.report.diagnosis import diagnosis_page
    from hdbridge.report.page import render

    provenance = {
        "axis": result.axis,
        "recordings": ", ".join(result.recordings),
        "recorded": result.date or "not known",
        "plan": result.plan,
        **{f"round {number}": each.about for number, each in enumerate(result.rounds, 1)},
        **({"survived": "; ".join(result.survived)} if result.survived else {}),
    }
    page = diagnosis_page(
        result.diagnosis,
        title=f"Improvement of axis '{result.axis}'",
        provenance=provenance,
        stepping=result.trial.stepping if result.trial else None,
        offer=result.offer,
    )
    write_result(path, render(page))


def _active(files: Profile) -> TransmissionModel:
    from hdbridge.axis.model import TransmissionModel

    if not files.model.exists():
        raise InputError(
            f"{files.model}: there is no active model to improve; calibrate first: hdbridge calibrate "
            f"{files.axis.parent}"
        )
    return TransmissionModel.load(files.model)
