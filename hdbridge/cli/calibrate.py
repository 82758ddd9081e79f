"""``hdbridge calibrate``: from a bare axis to a model that is pending."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from hdbridge.cli.measuring import PlanOption, out_option, resume_option
from hdbridge.cli.options import HtmlOption, JsonOption, note, say, write_json
from hdbridge.cli.session import Session, on_axis
from hdbridge.errors import InputError
from hdbridge.files.outputs import Kind

if TYPE_CHECKING:
    from hdbridge.commissioning.calibration import Calibration


@on_axis
def command(
    session: Session,
    plan: PlanOption = "quick",
    out: Annotated[Path | None, out_option("Where the recording goes"), Kind.FOLDER] = None,
    resume: Annotated[Path | None, resume_option("Continue an interrupted calibration.")] = None,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Measure an axis by a plan, fit its model, test it on the axis, and keep it as pending.

    The axis moves within the limits of its axis file, without compensation. Ctrl-C stops it and keeps what
    was measured. A model that does not improve on held-out data is not offered.
    """
    from hdbridge.cli.measuring import Measurement, phases
    from hdbridge.commissioning.calibration import calibrate
    from hdbridge.commissioning.calibration.motion import motion_test_s
    from hdbridge.commissioning.calibration.validation import validation_s

    files, axis = session.files, session.axis
    work = Measurement.asked(axis, plan, out, resume)
    test_s = validation_s(work.plan, axis)
    if work.plan.validation.motion:
        with suppress(InputError):  # too little travel: the calibration reports it and skips the test
            test_s += motion_test_s(axis)
    work.announce(f"{test_s / 60:.1f} min to test the model")
    with work.booted(session) as (drive, interrupted):
        journal = work.begun(drive, session.simulated_seed)
        with phases() as progress:
            result = calibrate(
                drive,
                journal,
                files.axis.parent,
                work.date,
                progress=progress,
                interrupted=interrupted,
                tell=note,
            )
    report(result, work.folder, session, json_file, html_file)


def report(
    result: Calibration, folder: Path, session: Session, json_file: Path | None, html_file: Path | None
) -> None:
    """Writes and prints the result and the next steps."""
    from hdbridge.cli.calibration_output import (
        print_calibration,
        print_next,
        print_page,
        write_calibration_page,
    )

    page = html_file or folder / "report.html"
    write_json(json_file, result.as_dict())
    write_calibration_page(page, result)
    print_calibration(result)
    say(f"\nrecording: {folder}")
    print_page(page)
    print_next(result.offer, session)
