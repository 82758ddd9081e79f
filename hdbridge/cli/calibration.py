"""Commands that fit a model: `calibrate`, `measure`, `fit`, `report`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import note, print_blocks, progress_bar, say, write_json, write_page, write_result
from hdbridge.cli.session import Session, model_file
from hdbridge.errors import InputError, command
from hdbridge.files.atomic import make_folder, new_folder, sole_writer
from hdbridge.files.outputs import Kind
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.cli.session import Session
    from hdbridge.commissioning.calibration import Calibration, Callbacks, Journal
    from hdbridge.commissioning.calibration.pipeline import Offer
    from hdbridge.drive.drive import Drive
    from hdbridge.motion.procedures.plan import Plan


@dataclass(frozen=True)
class PlanOptions:
    """Options of a command that measures by a plan."""

    plan: Annotated[
        str,
        Option(
            "--plan",
            metavar="quick|full|dynamics|FILE",
            help="Plan to measure: a bundled plan, or a file. A twin also needs the plan dynamics.",
        ),
    ] = "quick"
    out: Annotated[
        Path | None,
        Option(
            "--out",
            metavar="FOLDER",
            help="Write the recordings to this folder; else to recordings/AXIS-DATE-TIME.",
        ),
        Kind.FOLDER,
    ] = None
    resume: Annotated[
        Path | None,
        Option("--resume", metavar="FOLDER", help="Continue the interrupted measurement in this folder."),
    ] = None

    def of(self, session: Session) -> Measurement:
        """Returns the measurement; raises `InputError` if options contradict each other or the recording.

        Also creates the folder, so that an unwritable location is refused before a drive is connected.
        """
        from hdbridge.commissioning.calibration import Journal
        from hdbridge.commissioning.calibration.measure import remaining_plan
        from hdbridge.motion.procedures.plan import Plan

        axis, date = session.axis, datetime.now().astimezone()
        if self.resume is None:
            plan = Plan.load(self.plan)
            remaining_plan(plan, axis)  # an impossible plan is refused before the folder is created
            default = Path("recordings") / f"{axis.name}-{date:%Y%m%d-%H%M%S}"
            folder = make_folder(self.out) if self.out else new_folder(default)
            return Measurement(session, plan, folder, date, None)
        if self.out is not None:
            raise InputError("--resume continues in its own folder: leave out --out")
        journal = Journal.open(self.resume)
        journal.check_is_of(axis)
        return Measurement(session, journal.plan, self.resume, date, journal)


@dataclass(frozen=True, slots=True)
class Measurement:
    """Plan to be measured into a folder, or the remaining part of an interrupted measurement."""

    session: Session
    plan: Plan
    folder: Path
    date: datetime
    journal: Journal | None
    """Journal of the recording to continue; None for a new recording."""

    def announce(self, after: str = "") -> None:
        """Prints the remaining part of the plan and its duration; ``after`` describes the step after it."""
        from hdbridge.commissioning.calibration.measure import remaining_plan

        done = self.journal.done if self.journal else ()
        left = remaining_plan(self.plan, self.session.axis, done)
        for each in left.notes:
            note(f"plan '{self.plan.name}': {each}")
        there = f" ({len(done)} tasks are there already)" if self.journal else ""
        note(
            f"plan '{self.plan.name}': {len(left.tasks)} tasks{there}, {left.duration_s / 60:.1f} min of the "
            f"axis{f', and {after}' if after else ''}"
        )

    def begun(self, drive: Drive) -> Journal:
        """Returns the journal to continue, or starts a new one for this booted drive."""
        from hdbridge.commissioning.calibration import Journal

        if self.journal is not None:
            return self.journal
        seed = self.session.simulated_seed
        about = {} if seed is None else {"simulated": True, "seed": seed}
        return Journal.create(self.folder, self.session.axis, self.plan, self.date, drive.identity, about)

    @contextmanager
    def booted(self) -> Iterator[tuple[Drive, Callbacks]]:
        """Yields the booted drive, and the functions that a measurement calls.

        Locks the axis against other measurements. If the measurement fails, prints the location of its
        record; removes an empty folder.
        """
        from hdbridge.axis.model.store import measuring
        from hdbridge.commissioning.calibration import Callbacks

        with sole_writer(self.folder, new=self.journal is None):
            try:
                with (
                    measuring(self.session.files.axis),
                    self.session.booted() as (drive, interrupted),
                    phases() as progress,
                ):
                    yield drive, Callbacks(progress, interrupted, note)
            except BaseException:
                if (self.folder / "recording.yaml").exists():
                    note(f"the measured data are kept; continue with --resume {self.folder}")
                raise
            finally:
                with suppress(OSError):
                    self.folder.rmdir()


@contextmanager
def phases() -> Iterator[Callable[[str, float, float], None]]:
    """Yields a progress function that shows one bar per phase; the total duration, s, identifies a phase."""
    with progress_bar() as bar:
        bars: dict[float, int] = {}

        def show(name: str, done_s: float, total_s: float) -> None:
            if total_s not in bars:
                bars[total_s] = bar.add_task("", total=total_s)
            bar.update(bars[total_s], completed=done_s, description=f"{name:>18}")  # type: ignore[arg-type]

        yield show


@taking(Session, PlanOptions)
def calibrate(
    session: Session, measured: PlanOptions, json_file: opt.Json = None, html_file: opt.Html = None
) -> None:
    """Measure an axis by a plan, fit its model, test it on the axis, and keep it as pending.

    The axis moves within the limits of its axis file, without compensation. Ctrl-C stops it and keeps what
    was measured. A model that does not improve on held-out data is not offered.
    """
    from hdbridge.axis.model.store import MODELS
    from hdbridge.commissioning.calibration import calibrate
    from hdbridge.commissioning.calibration.motion import motion_test_s
    from hdbridge.commissioning.calibration.validation import validation_s

    MODELS.check_pending(session.files.folder)
    work, axis = measured.of(session), session.axis
    test_s = validation_s(work.plan, axis)
    if work.plan.validation.motion:
        with suppress(InputError):  # too little travel: the calibration reports it and skips the test
            test_s += motion_test_s(axis)
    work.announce(f"{test_s / 60:.1f} min to test the model")
    with work.booted() as (drive, callbacks):
        result = calibrate(drive, work.begun(drive), session.files.folder, work.date, callbacks)
    _conclude(result, work.folder, json_file, html_file, session)


def _conclude(
    result: Calibration,
    folder: Path,
    json_file: Path | None,
    html_file: Path | None,
    session: Session | None = None,
) -> None:
    """Writes and prints the result; for a measurement in a session, also the next steps."""
    from hdbridge.report.calibration import calibration_page

    page = html_file or folder / "report.html"
    write_json(json_file, result.as_dict())
    write_page(page, calibration_page(result))
    print_calibration(result)
    if session is not None:
        say(f"\nrecording: {folder}")
    say(f"report: {page}")
    if session is not None:
        print_next(result.offer, session)


@taking(Session, PlanOptions)
def measure(session: Session, measured: PlanOptions) -> None:
    """Move an axis by a plan and keep the recording, for diagnose, twin and fit.

    The axis moves as in a calibration, without compensation. No model is fitted or changed.
    """
    from hdbridge.commissioning.calibration import measure

    work, files = measured.of(session), session.files
    work.announce()
    with work.booted() as (drive, callbacks):
        journal = work.begun(drive)
        measure(drive, journal, callbacks)
    recording = journal.recording()
    say(f"recording: {work.folder}, {len(journal.done)} tasks, {len(recording.record)} samples")
    if files.model.exists():
        say(f"what the model lacks: {command('diagnose', work.folder, '--model', files.model)}")
    say(f"deviations of the simulated drive: {command('twin', session.profile, work.folder)}")


@taking(opt.CsvFormat)
def fit(
    csv: opt.CsvFormat,
    records: Annotated[
        list[Path], Argument(metavar="RECORD...", help="Recording folders or CSV files, in order of time.")
    ],
    ratio: Annotated[
        float | None,
        Option("--ratio", min=1, max=1000, help="Motor turns per load turn; else the recording's."),
    ] = None,
    axis: Annotated[
        str | None, Option("--axis", metavar="PROFILE", help="The axis that was recorded: ratio and binding.")
    ] = None,
    active: Annotated[
        str | None,
        Option("--model", metavar="MODEL.yaml|PROFILE", help="Model to compare with, and to fall back on."),
    ] = None,
    independent_zeros: opt.IndependentZeros = False,
    out: Annotated[
        Path | None, Option("--out", metavar="MODEL.yaml", help="Write the model file."), Kind.MODEL
    ] = None,
    force: Annotated[
        bool, Option("--force", help="Write the model even if it is worse on held-out data.")
    ] = False,
    json_file: opt.Json = None,
    html_file: opt.Html = None,
) -> None:
    """Fit a model to recordings; report parameter intervals and what the data cannot determine.

    A CSV file needs `time_s`, `motor_position_deg` and `load_position_deg` (multi-turn), or other names by
    --columns; `motor_target_deg` helps. Nothing is activated. A model that is worse on held-out data than
    that of --model, or than no model, is not written.
    """
    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.calibration import fit
    from hdbridge.report.calibration import calibration_page

    config = AxisConfig.load(Profile.find(axis).axis) if axis else None
    loaded = csv.load(records)
    compared = TransmissionModel.load(model_file(active)) if active else None
    if compared and config:
        compared.check_bound_to(config)
    found = fit(loaded, ratio=ratio, axis=config, active=compared, independent_zeros=independent_zeros)
    held_out = found.fit.held_out
    refused = out is not None and held_out.worse and not force
    if out is not None and not refused:
        write_result(out, found.model.dump())
    write_json(json_file, found.as_dict())
    if html_file is not None:
        write_page(html_file, calibration_page(found))
    print_calibration(found)
    if out is not None and not refused:
        say(f"model: {out}")
    if html_file is not None:
        say(f"report: {html_file}")
    if refused:
        raise InputError(
            f"{out}: not written: the model is worse on held-out data; it {held_out.text}; record more, or "
            "write it anyway with --force"
        )


def report(
    recording: Annotated[Path, Argument(metavar="RECORDING", help="Folder of a calibration's recording.")],
    json_file: opt.Json = None,
    html_file: opt.Html = None,
) -> None:
    """Fit a recording again and report the result; nothing moves."""
    from hdbridge.commissioning.calibration import concluded

    _conclude(concluded(recording), recording, json_file, html_file)


def print_calibration(result: Calibration) -> None:
    """Prints parameters with intervals, the quality of the fit, the tests on the axis, and the decision."""
    from hdbridge.report.calibration import fit_facts, parameters
    from hdbridge.report.motion import motion_sections
    from hdbridge.report.stepping import stepping_sections

    axis = f"axis '{result.axis}'" if result.axis else ", ".join(result.recordings)
    print_blocks(parameters(result), f"Model of {axis}, ratio {result.model.ratio:g}")
    print_blocks([fit_facts(result)])
    for section in (
        *(stepping_sections(result.validation) if result.validation else ()),
        *(motion_sections(result.motion) if result.motion else ()),
    ):
        print_blocks(section.blocks, section.title)
    if result.offer:
        say(result.offer.reason, style=None if result.offer.made else "bold")


def print_next(offer: Offer | None, session: Session) -> None:
    """Prints the next commands for a pending model; a daemon that lent its bus commits the model itself."""
    if offer is not None and offer.made:
        folder = session.files.axis.parent
        daemon = command("ctl", "model", session.axis.name, "pending")
        use = daemon if session.borrow else command("model", "commit", folder)
        say(f"pending: {offer.pending}\nreview it: {command('model', 'diff', folder)}\nuse it: {use}")


COMMANDS: Final = {"calibrate": calibrate, "measure": measure, "fit": fit, "report": report}
