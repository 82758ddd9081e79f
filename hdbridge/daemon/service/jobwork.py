"""Work of the jobs step, calibrate and improve on any rig, as the commands of these names do it.

It runs in its own process (`jobprocess`), so that hours of fitting do not slow down the service.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from hdbridge.axis.model import TransmissionModel, store
from hdbridge.commissioning.calibration import Journal, calibrate, start_journal
from hdbridge.commissioning.calibration.measure import outlook
from hdbridge.commissioning.calibration.validation import validation_s
from hdbridge.commissioning.evaluation.comparison import compare_schemes
from hdbridge.commissioning.evaluation.stepping import Scheme
from hdbridge.commissioning.improvement import Source, improve
from hdbridge.commissioning.improvement.trial import trial_s
from hdbridge.control.bench import Run
from hdbridge.control.rig import Rig
from hdbridge.daemon.service.joborder import CalibrateOptions, ImproveOptions, StepOptions, Told, Work
from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder, new_folder, write_atomically
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.stepping import Stepping, SteppingOutcome
from hdbridge.records.record import Record
from hdbridge.report.calibration import calibration_page
from hdbridge.report.diagnosis import diagnosis_page
from hdbridge.report.page import render

RESULT_NAME: Final = "result.json"
PAGE_NAME: Final = "report.html"


def run(work: Work, rig: Rig, told: Told) -> dict[str, Any]:
    """Runs a job and returns the document that the command of the same name writes; raises as that does.

    Raises KeyboardInterrupt if the job was interrupted; its measurements are kept.
    """
    match work.options:
        case StepOptions() as options:
            return _step(work, options, rig, told)
        case ImproveOptions() as options:
            return _improve(work, options, rig, told)
        case CalibrateOptions() as options:
            return _calibrate(work, options, rig, told)
    raise InputError(f"{work.kind.value}: no such job")


def _step(work: Work, options: StepOptions, rig: Rig, told: Told) -> dict[str, Any]:
    scheme = options.scheme
    schemes = (scheme,) if isinstance(scheme, Scheme) else scheme
    if schemes and set(schemes) == {Scheme.NONE}:
        model = TransmissionModel(work.axis.gear.ratio)
    else:
        model = _model(work, options.model)
    wanted = schemes or Scheme.offered_by(model)
    if Scheme.EXTENDED in wanted and Scheme.EXTENDED not in Scheme.offered_by(model):
        raise InputError("scheme extended: the model has no effect beyond its two parts; leave it out")
    folder = _new_folder(work, "step")
    told.folder(folder)

    def progress(scheme: Scheme, share: float) -> None:
        told.phase(f"stepping, {scheme.value}", wanted.index(scheme) + share, len(wanted))

    def finished(scheme: Scheme, run: Run[SteppingOutcome]) -> None:
        run.record.write_csv(folder / f"stepping-{scheme.value}.csv.gz")

    def stopped(scheme: Scheme, record: Record) -> None:
        record.write_csv(folder / f"stepping-{scheme.value}-stopped.csv.gz")

    comparison = compare_schemes(
        rig,
        model,
        wanted,
        Stepping(count=options.count, step_deg=options.step_deg, start_deg=options.start_deg),
        progress=progress,
        interrupted=told.interrupted,
        finished=finished,
        stopped=stopped,
    )
    return _kept(folder, comparison.as_dict())


def _calibrate(work: Work, options: CalibrateOptions, rig: Rig, told: Told) -> dict[str, Any]:
    with store.measuring(work.profile.axis):
        plan, folder, journal = _journal(work, options, rig, told)
        phases = _Phases(
            told, outlook(plan, work.axis, journal.done).duration_s + validation_s(plan, work.axis)
        )
        result = calibrate(
            rig,
            journal,
            work.profile.folder,
            work.date,
            progress=phases.progress,
            interrupted=told.interrupted,
            tell=told.line,
        )
    write_atomically(folder / PAGE_NAME, render(calibration_page(result)))
    return _kept(folder, result.as_dict())


def _improve(work: Work, options: ImproveOptions, rig: Rig, told: Told) -> dict[str, Any]:
    active = _model(work, None)
    with store.measuring(work.profile.axis):
        plan, folder, journal = _journal(work, options, rig, told)
        phases = _Phases(
            told, outlook(plan, work.axis, journal.done).duration_s + trial_s(plan, work.axis, active)
        )
        result = improve(
            rig,
            Source(plan, folder, journal),
            work.profile.folder,
            active,
            work.date,
            rounds=options.rounds if options.auto else 0,
            progress=phases.progress,
            interrupted=told.interrupted,
            tell=told.line,
        )
    page = diagnosis_page(
        result.diagnosis,
        title=f"Improvement of axis '{result.axis}'",
        provenance={
            "axis": result.axis,
            "recordings": ", ".join(result.recordings),
            "recorded": result.date or "not known",
            "plan": result.plan,
            **{f"round {number}": each.about for number, each in enumerate(result.rounds, 1)},
            **({"survived": "; ".join(result.survived)} if result.survived else {}),
        },
        stepping=result.trial.stepping if result.trial else None,
        offer=result.offer,
    )
    write_atomically(folder / PAGE_NAME, render(page))
    return _kept(folder, result.as_dict())


def _model(work: Work, version: int | None) -> TransmissionModel:
    if version is not None:
        return store.find(work.profile.folder, str(version)).content
    if not work.profile.model.exists():
        raise InputError(f"{work.profile.model}: there is no active model; calibrate and commit one first")
    return TransmissionModel.load(work.profile.model)


def _journal(work: Work, options: CalibrateOptions, rig: Rig, told: Told) -> tuple[Plan, Path, Journal]:
    """Returns the journal of the recording to continue, else of a new one."""
    if options.resume is not None:
        folder = work.recordings / options.resume
        journal = Journal.open(folder)
        journal.check_is_of(work.axis)
        told.folder(folder)
        return journal.plan, folder, journal
    own = work.profile.folder / f"{options.plan}.yaml"
    plan = Plan.load(str(own) if own.is_file() else options.plan)
    outlook(plan, work.axis)  # raises before a folder is created
    folder = _new_folder(work, "")
    told.folder(folder)
    return plan, folder, start_journal(folder, work.axis, plan, work.date, rig.identity)


def _new_folder(work: Work, what: str) -> Path:
    make_folder(work.recordings)
    name = "-".join(filter(None, (work.axis.name, what, f"{work.date:%Y%m%d-%H%M%S}")))
    return new_folder(work.recordings / name)


def _kept(folder: Path, document: dict[str, Any]) -> dict[str, Any]:
    write_atomically(folder / RESULT_NAME, json.dumps(document, indent=1, allow_nan=False) + "\n")
    return document


class _Phases:
    """Combines consecutive phases into one progress; a different total marks a new phase."""

    def __init__(self, told: Told, total_s: float) -> None:
        self._told = told
        self._total_s = total_s
        self._phase_s = 0.0
        self._before_s = 0.0

    def progress(self, name: str, done_s: float, total_s: float) -> None:
        if total_s != self._phase_s:
            self._before_s += self._phase_s
            self._phase_s = total_s
        done_s += self._before_s
        self._told.phase(name, done_s, max(self._total_s, done_s))
