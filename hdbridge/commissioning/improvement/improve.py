"""Runs a complete improvement, from a booted drive to a pending model that positions better."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.identification import provenance
from hdbridge.commissioning.calibration.journal import Journal, check_is_of, fault_notes_in, tasks_of
from hdbridge.commissioning.calibration.measure import SILENT, Callbacks, measure
from hdbridge.commissioning.calibration.pipeline import Offer, proposed, save_result
from hdbridge.commissioning.calibration.validation import floor_of
from hdbridge.commissioning.improvement.extension import Extension, alternatives, extension_of, named
from hdbridge.commissioning.improvement.further import Choice, advice, choose, unseparated
from hdbridge.commissioning.improvement.trial import Trial, run_trial
from hdbridge.control.bench import axis_view
from hdbridge.control.caps import cap_remark
from hdbridge.control.realtime import suspended_realtime
from hdbridge.drive.drive import Drive
from hdbridge.errors import InputError
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.recording import ABOUT_NAME, Recording


@dataclass(frozen=True, slots=True)
class Round:
    """One further experiment, and the findings after it."""

    experiment: str
    about: str
    recording: str
    separates: tuple[str, ...]
    """Alternatives that the experiment was predicted to separate; empty for a resumed experiment."""
    found: tuple[str, ...]
    """Findings after the experiment, each with its alternatives."""


@dataclass(frozen=True, slots=True, eq=False)
class Improvement:
    """Result of diagnosis, extension and trial, with the decision about the offer."""

    axis: str
    recordings: tuple[str, ...]
    date: str | None
    """Date of the first recording, ISO 8601."""
    plan: str
    active: TransmissionModel
    diagnosis: Diagnosis
    extension: Extension
    unseparated: Mapping[str, tuple[str, ...]]
    """For each cause found, the other causes from which it has not been separated."""
    rounds: tuple[Round, ...]
    further: Choice | None
    """Next experiment that the axis could run to separate causes; None if none would help."""
    advice: tuple[str, ...]
    """Advice to the user about open questions."""
    trial: Trial | None
    offer: Offer
    fault_notes: tuple[str, ...] = ()
    """One line for each recorded file whose run tolerated faults."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``--json``: schema ``hdbridge.improvement/1``."""
        trial = (
            self.trial.as_dict() if self.trial else {"stepping": None, "small_steps": None, "improves": None}
        )
        return {
            "schema": "hdbridge.improvement/1",
            "axis": self.axis,
            "recordings": list(self.recordings),
            "date": self.date,
            "plan": self.plan,
            "offered": self.offer.made,
            "reason": self.offer.reason,
            "pending": str(self.offer.pending) if self.offer.pending else None,
            "compensated": [each.cause for each in self.extension.carried],
            "not_compensated": list(self.extension.left),
            "not_told_from": {name: list(each) for name, each in self.unseparated.items()},
            "rounds": [asdict(each) for each in self.rounds],
            "further": self.further.as_dict() if self.further else None,
            "advice": list(self.advice),
            "survived": list(self.fault_notes),
            **trial,
            "diagnosis": self.diagnosis.as_dict(),
        }


RESULT_NAME = "improvement.json"


@dataclass(frozen=True, slots=True)
class Source:
    """Data for the diagnosis: a plan to be run (its journal), or existing recordings."""

    plan: Plan
    """Plan of the measurement; its stepping test is used in the trial, even with given recordings."""
    folder: Path
    """Folder for all new files."""
    journal: Journal | None = None
    given: Mapping[Path, Recording] = field(default_factory=dict)
    independent_zeros: bool = False
    """True if the encoders' zeros were lost between the given recordings."""


@suspended_realtime()  # fitting takes long; a bench resumes real-time priority for each motion
def improve(
    drive: Drive,
    source: Source,
    profile: Path,
    active: TransmissionModel,
    date: datetime,
    callbacks: Callbacks = SILENT,
    *,
    rounds: int = 0,
) -> Improvement:
    """Diagnoses the axis, extends its model, steps with both, and proposes the better one to the profile.

    ``profile`` is the folder of axis.yaml, ``active`` its model. The axis runs up to ``rounds`` further
    experiments while causes remain to be separated. Nothing is proposed without a finding that can be
    compensated, or without a gain both on held-out data and in stepping. Raises `InputError` if model or
    recordings belong to another axis or drive.
    """
    axis, notify = drive.axis, callbacks.notify
    active.check_bound_to(axis, drive.identity)
    axis.require_load_encoder()
    first = source.journal
    earlier = first is None or bool(first.done)  # measured before the drive was booted
    if first is not None:
        apart = _measured(drive, first, callbacks)
        recordings = {first.folder: first.recording()}
        plans = [first.plan]
    else:
        recordings, apart = dict(source.given), source.independent_zeros
        for path, recording in recordings.items():
            check_is_of(recording, axis, path, "run 'hdbridge improve' for the axis that was recorded")
        notes = [each.notes for each in recordings.values()]
        plans = [Plan.model_validate(each["plan"]) for each in notes if "plan" in each]
    notify("diagnosing")
    diagnosis = diagnose(recordings, active, independent_zeros=apart)
    view = axis_view(axis)
    rivals = unseparated(diagnosis, active, view, plans)
    found: list[Round] = []
    while len(found) < rounds:
        folder = source.folder / f"round-{len(found) + 1}"
        if (folder / ABOUT_NAME).exists():  # resumed
            journal, pairs = Journal.open(folder), tuple[str, ...]()
        elif choice := choose(diagnosis, rivals, active, view, [each.name for each in plans]):
            journal = Journal.create(folder, axis, choice.plan, date, drive.identity)
            pairs = choice.separates
        else:
            break
        notify(diagnosis.verdict())
        notify(f"round {len(found) + 1}: {journal.plan.about}, to separate {', '.join(pairs) or 'the rest'}")
        apart = _measured(drive, journal, callbacks) or apart or earlier
        recordings[folder] = journal.recording()
        diagnosis = diagnose(recordings, active, independent_zeros=apart)
        plans.append(journal.plan)
        rivals = unseparated(diagnosis, active, view, plans)
        left = tuple(map(alternatives, diagnosis.findings))
        found.append(Round(journal.plan.name, journal.plan.about, str(folder), pairs, left))
    result = Improvement(
        axis=axis.name,
        recordings=tuple(map(str, recordings)),
        date=next(iter(recordings.values())).date,
        plan=source.plan.name,
        active=active,
        diagnosis=diagnosis,
        extension=extension_of(diagnosis, active, rivals),
        unseparated=rivals,
        rounds=tuple(found),
        further=choose(diagnosis, rivals, active, view, [each.name for each in plans]),
        advice=advice(diagnosis),
        trial=None,
        offer=Offer(False, "nothing found: the active model stays"),
        fault_notes=fault_notes_in(list(recordings)),
    )
    if diagnosis.findings:
        whole = Recording.joined(list(recordings.values()))
        result = _concluded(result, drive, source, profile, whole, date, callbacks)
    if source.folder.is_dir() and any(source.folder.iterdir()):  # something new was measured
        model = result.extension.model if diagnosis.findings else None
        save_result(source.folder / RESULT_NAME, result.as_dict(), model, active)
    return result


def _measured(drive: Drive, journal: Journal, callbacks: Callbacks) -> bool:
    """Runs the missing measurements; returns True if an encoder may have lost its zero between tasks."""
    measure(drive, journal, callbacks)
    return len({each.session for each in tasks_of(journal.recording())}) > 1


def _concluded(
    result: Improvement,
    drive: Drive,
    source: Source,
    profile: Path,
    recording: Recording,
    date: datetime,
    callbacks: Callbacks,
) -> Improvement:
    """Returns the result with the trial, if the extended model may be offered, and with the offer."""
    extension, notify = result.extension, callbacks.notify
    if not extension.carried:
        return replace(result, offer=Offer(False, f"nothing proposed: {'; '.join(extension.left)}"))
    if not extension.improves:
        return replace(result, offer=Offer(False, f"not offered: {'; '.join(extension.refused)}"))
    model = extension.model.with_provenance(**_provenance(result, recording))
    if remark := cap_remark(drive.axis, model):
        notify(remark)
    notify("stepping with the active and the extended model alternately")
    floor = floor_of(drive.axis, recording)
    try:
        trial = run_trial(drive, source.plan, result.active, model, floor, source.folder, callbacks)
    except InputError as problem:
        return replace(result, offer=Offer(False, f"not offered: {problem}"))
    result = replace(result, trial=trial)
    summary = _summary(trial)
    if not trial.improves:
        return replace(
            result, offer=Offer(False, f"not offered: positioning is not more accurate, {summary}")
        )
    reason = f"improvement {source.folder.name}: {named(extension.carried)}; {summary}"
    return replace(result, offer=proposed(profile, model, reason, date, drive))


def _summary(trial: Trial) -> str:
    big = [each.pooled.three_sigma_arcsec for each in (trial.stepping.before, trial.stepping.after)]
    small = [each.pooled.three_sigma_arcsec for each in trial.small]
    figures = (
        f"stepping 3 sigma {big[0]:.2f} to {big[1]:.2f} arcsec",
        f"small steps {small[0]:.2f} to {small[1]:.2f}",
        *trial.worse,
    )
    return ", ".join(figures)


def _provenance(result: Improvement, recording: Recording) -> dict[str, Any]:
    cause, gain = result.extension.gains()[0]
    held_out = gain.as_dict() | {"over": f"{gain.over} left out of the fit, without and with {cause}"}
    found = [
        {"cause": each.cause, "probability": round(each.probability, 3), "aliases": list(each.aliases)}
        | (
            {
                "held_out_before_arcsec": each.gain.before_arcsec,
                "held_out_after_arcsec": each.gain.after_arcsec,
            }
            if each.gain
            else {}
        )
        | ({"not_offered": refused} if (refused := each.refusal()) else {})
        for each in result.diagnosis.findings
    ]
    return {**provenance(result.recordings, [recording], held_out), "found": found}
