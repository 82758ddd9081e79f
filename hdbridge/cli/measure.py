"""``hdbridge measure``: a recording of an axis by a plan, without a fit."""

from pathlib import Path
from typing import Annotated

import typer

from hdbridge.cli.measuring import out_option, resume_option
from hdbridge.cli.options import say
from hdbridge.cli.session import Session, on_axis
from hdbridge.files.outputs import Kind


@on_axis
def command(
    session: Session,
    plan: Annotated[
        str,
        typer.Option(
            "--plan",
            metavar="quick|full|dynamics|FILE",
            help="What is measured: a bundled plan, or a file. A twin needs dynamics, too.",
        ),
    ] = "quick",
    out: Annotated[Path | None, out_option("Where the recording goes"), Kind.FOLDER] = None,
    resume: Annotated[Path | None, resume_option("Continue an interrupted recording.")] = None,
) -> None:
    """Move an axis by a plan and keep the recording, for diagnose, twin and fit.

    The axis moves as in a calibration, without compensation. No model is fitted or changed.
    """
    from hdbridge.cli.measuring import Measurement, phases
    from hdbridge.commissioning.calibration import measure

    files, axis = session.files, session.axis
    work = Measurement.asked(axis, plan, out, resume)
    work.announce()
    with work.booted(session) as (drive, interrupted):
        journal = work.begun(drive, session.simulated_seed)
        with phases() as progress:
            measure(drive, journal, progress=progress, interrupted=interrupted)
    recording = journal.recording()
    say(f"recording: {work.folder}, {len(journal.done)} tasks, {len(recording.record)} samples")
    if files.model.exists():
        say(f"what the model lacks: hdbridge diagnose {work.folder} --model {files.model}")
    say(f"what the simulated drive gets wrong: hdbridge twin {session.profile} {work.folder}")
