"""``hdbridge calibrate``: from a bare axis to a model that waits to be committed."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from hdbridge.axis import AxisConfig
from hdbridge.calibration import Calibration, Journal, calibrate, start_journal
from hdbridge.calibration.measure import identity_of, outlook
from hdbridge.calibration.validation import validation_s
from hdbridge.cli.findings import print_calibration, write_calibration_page
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
from hdbridge.procedures.plan import Plan


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(command)


def command(
    profile: ProfileArgument,
    plan: Annotated[
        str,
        typer.Option(
            "--plan", metavar="quick|full|FILE", help="What is measured: a bundled plan, or a file."
        ),
    ] = "quick",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FOLDER", help="Where the recording goes; else recordings/AXIS-DATE-TIME."
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume",
            metavar="FOLDER",
            help="Go on with an interrupted calibration: what its plan still lacks.",
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
    """Measure an axis by a plan, fit its model, test it on the axis, and keep it as pending.

    The axis moves within the limits of its axis file, without compensation. Everything measured is kept;
    Ctrl-C stops the axis, and --resume goes on. The model is pending until `hdbridge model commit PROFILE`.
    One that does not improve on data that it has not seen is not offered.
    """
    files = Profile.find(profile)
    axis = load_axis(files, interface, channel)
    date = datetime.now().astimezone()
    if resume is not None and out is not None:
        raise InputError("--resume goes on in its own folder: leave out --out")
    journal = Journal.open(resume) if resume is not None else None
    if journal is not None:
        journal.check_is_of(axis)
    chosen = journal.plan if journal is not None else Plan.load(plan)
    _announce(chosen, axis, journal)
    folder = resume or out or Path("recordings") / f"{axis.name}-{date:%Y%m%d-%H%M%S}"
    with (
        deferred_interrupt() as interrupted,
        connected(axis, files, simulate=simulate, truth=truth, seed=seed) as (bus, clock),
        Drive(bus, axis, clock) as drive,
        kept_in(folder),
    ):
        drive.boot()
        notes.print(f"booted node {axis.drive.node_id} over {drive.link.name}")
        if journal is None:
            about = {"simulated": True, "seed": seed} if simulate else {}
            journal = start_journal(folder, axis, chosen, date, identity_of(drive), about)
        with phases() as progress:
            result = calibrate(
                drive,
                journal,
                files.axis.parent,
                date,
                progress=progress,
                interrupted=interrupted,
                tell=lambda line: notes.print(escape(line)),
            )
    report(result, folder, files, json_file, html_file)


def report(
    result: Calibration, folder: Path, files: Profile, json_file: Path | None, html_file: Path | None
) -> None:
    """Tell the result, and what comes next."""
    print_calibration(result)
    console.print(f"\nrecording: {folder}", soft_wrap=True)
    write_json(json_file, result.as_dict())
    page = html_file or folder / "report.html"
    write_calibration_page(page, result)
    if result.offer and result.offer.made:
        console.print(
            f"pending: {result.offer.pending}\nreview it: hdbridge model diff {files.axis.parent}\n"
            f"use it: hdbridge model commit {files.axis.parent}",
            soft_wrap=True,
        )


def _announce(plan: Plan, axis: AxisConfig, journal: Journal | None) -> None:
    left = outlook(plan, axis, journal.done if journal else ())
    for each in left.notes:
        notes.print(escape(f"plan '{plan.name}': {each}"))
    done = f" ({len(journal.done)} tasks are there already)" if journal else ""
    notes.print(
        f"plan '{plan.name}': {len(left.tasks)} tasks{done}, {left.duration_s / 60:.1f} min of the axis, and "
        f"{validation_s(plan, axis) / 60:.1f} min to test the model",
        soft_wrap=True,
    )
