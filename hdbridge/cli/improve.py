"""``hdbridge improve``: diagnose a drive, extend its model, step again, keep the better model as pending."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from hdbridge.axis import AxisConfig
from hdbridge.calibration import Journal, start_journal
from hdbridge.calibration.measure import identity_of, outlook
from hdbridge.cli.diagnose import print_diagnosis
from hdbridge.cli.findings import print_stepping, print_steps
from hdbridge.cli.interrupt import deferred_interrupt
from hdbridge.cli.measuring import kept_in, phases
from hdbridge.cli.options import (
    ChannelOption,
    HtmlOption,
    InterfaceOption,
    JsonOption,
    Profile,
    ProfileArgument,
    SeedOption,
    SimulateOption,
    TruthOption,
    connected,
    console,
    load_axis,
    notes,
    write_json,
)
from hdbridge.drive.drive import Drive
from hdbridge.errors import InputError
from hdbridge.files.atomic import write_atomically
from hdbridge.improvement import Improvement, Source, improve
from hdbridge.improvement.trial import trial_s
from hdbridge.model import TransmissionModel
from hdbridge.procedures.plan import Plan
from hdbridge.recording import Recording
from hdbridge.report.diagnosis import diagnosis_page
from hdbridge.report.page import render

LEFT_OF_FLOOR = 1.5
"""A stepping test this far above its floor has something left to find."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("improve")(command)


def command(
    profile: ProfileArgument,
    plan: Annotated[
        str,
        typer.Option(
            "--plan", metavar="quick|full|FILE", help="What is measured: a bundled plan, or a file."
        ),
    ] = "quick",
    given: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            metavar="RECORDING",
            help="Measure nothing, diagnose this; may stand several times, in their order.",
        ),
    ] = None,
    independent_zeros: Annotated[
        bool,
        typer.Option("--independent-zeros", help="The encoders' zeros were lost between the recordings."),
    ] = False,
    auto: Annotated[
        bool,
        typer.Option("--auto", help="Let the axis run further experiments where causes are not told apart."),
    ] = False,
    rounds: Annotated[
        int, typer.Option("--rounds", min=1, max=20, help="With --auto: so many experiments at most.")
    ] = 3,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FOLDER", help="Where the recordings go; else recordings/AXIS-DATE-TIME."
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", metavar="FOLDER", help="Go on with an interrupted improvement: what it still lacks."
        ),
    ] = None,
    simulate: SimulateOption = False,
    truth: TruthOption = None,
    seed: SeedOption = 0,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Say what the active model lacks, extend it, step with both, and keep the better one as pending.

    The axis moves within the limits of its axis file; everything measured is kept, Ctrl-C stops the axis.
    Where nothing is found, or nothing that can be compensated, or where the axis does not point better
    with the extended model, nothing is proposed. The model is used after `hdbridge model commit PROFILE`.
    """
    files = Profile.find(profile)
    axis = load_axis(files, interface, channel)
    active = _active(files)
    if given and resume is not None:
        raise InputError("--from measures nothing that --resume could go on with: leave one of them out")
    if resume is not None and out is not None:
        raise InputError("--resume goes on in its own folder: leave out --out")
    date = datetime.now().astimezone()
    journal = Journal.open(resume) if resume is not None else None
    if journal is not None:
        journal.check_is_of(axis)
    chosen = journal.plan if journal is not None else Plan.load(plan)
    recordings = tuple(given or ())
    for each in recordings:
        Recording.load(each)  # refused before anything is connected
    _announce(chosen, axis, active, journal, measures=not recordings)
    folder = resume or out or Path("recordings") / f"{axis.name}-{date:%Y%m%d-%H%M%S}"
    with (
        deferred_interrupt() as interrupted,
        connected(axis, files, simulate=simulate, truth=truth, seed=seed) as (bus, clock),
        Drive(bus, axis, clock) as drive,
        kept_in(folder),
    ):
        drive.boot()
        notes.print(f"booted node {axis.drive.node_id} over {drive.link.name}")
        if journal is None and not recordings:
            about = {"simulated": True, "seed": seed} if simulate else {}
            journal = start_journal(folder, axis, chosen, date, identity_of(drive), about)
        with phases() as progress:
            result = improve(
                drive,
                Source(chosen, folder, journal, recordings, independent_zeros),
                files.axis.parent,
                active,
                date,
                rounds=rounds if auto else 0,
                progress=progress,
                interrupted=interrupted,
                tell=lambda line: notes.print(escape(line), soft_wrap=True),
            )
    report(result, folder, files, json_file, html_file)


def report(
    result: Improvement, folder: Path, files: Profile, json_file: Path | None, html_file: Path | None
) -> None:
    """Tell the result, and what comes next."""
    print_diagnosis(result.diagnosis)
    for line in result.extension.left:
        console.print(escape(line), soft_wrap=True)
    if result.further is not None:
        further = result.further
        console.print(
            f"the axis could tell {', '.join(further.tells)} by itself (--auto), in "
            f"{further.duration_s / 60:.0f} min: {further.plan.about}",
            soft_wrap=True,
        )
    if result.trial is not None:
        print_stepping(result.trial.stepping)
        print_steps("Small steps, within the hysteresis: load error at rest, arcsec", result.trial.small)
        if result.trial.of_floor > LEFT_OF_FLOOR:
            console.print(
                f"stepping is still {result.trial.of_floor:.1f} times the floor: something is left that "
                "these data do not show; --auto, or a plan with two load turns, shows more",
                soft_wrap=True,
            )
    console.print(escape(result.offer.reason), style=None if result.offer.made else "bold", soft_wrap=True)
    console.print(f"\nrecordings: {', '.join(result.recordings)}", soft_wrap=True)
    write_json(json_file, result.as_dict())
    if html_file is not None or folder.is_dir():
        write_page(html_file or folder / "report.html", result)
    if result.offer.made:
        console.print(
            f"pending: {result.offer.pending}\nreview it: hdbridge model diff {files.axis.parent}\n"
            f"use it: hdbridge model commit {files.axis.parent}",
            soft_wrap=True,
        )


def write_page(path: Path, result: Improvement) -> None:
    """The diagnosis with the stepping test, as a self-contained page."""
    provenance = {
        "axis": result.axis,
        "recordings": ", ".join(result.recordings),
        "recorded": result.date or "not known",
        "plan": result.plan,
        **{f"round {number}": each.about for number, each in enumerate(result.rounds, 1)},
        "outcome": result.offer.reason,
    }
    page = diagnosis_page(
        result.diagnosis,
        title=f"Improvement of axis '{result.axis}'",
        provenance=provenance,
        stepping=result.trial.stepping if result.trial else None,
    )
    write_atomically(path, render(page))
    console.print(f"report: {path}", soft_wrap=True)


def _active(files: Profile) -> TransmissionModel:
    if not files.model.exists():
        raise InputError(
            f"{files.model}: there is no active model to improve; calibrate first: hdbridge calibrate "
            f"{files.axis.parent}"
        )
    return TransmissionModel.load(files.model)


def _announce(
    plan: Plan, axis: AxisConfig, active: TransmissionModel, journal: Journal | None, *, measures: bool
) -> None:
    trial = f"{trial_s(plan, axis, active) / 60:.1f} min to step with both models, if something is found"
    if not measures:
        notes.print(f"nothing is measured first; {trial}", soft_wrap=True)
        return
    left = outlook(plan, axis, journal.done if journal else ())
    for each in left.notes:
        notes.print(escape(f"plan '{plan.name}': {each}"), soft_wrap=True)
    done = f" ({len(journal.done)} tasks are there already)" if journal else ""
    notes.print(
        f"plan '{plan.name}': {len(left.tasks)} tasks{done}, {left.duration_s / 60:.1f} min of the axis, "
        f"and {trial}",
        soft_wrap=True,
    )
