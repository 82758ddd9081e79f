"""Runs a complete calibration, from a booted drive to a pending model, and restores results from folders."""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from hdbridge.analysis.checks import check_once, check_records
from hdbridge.analysis.identification import FitResult
from hdbridge.analysis.linear import on_one_thread
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.difference import diff
from hdbridge.axis.model.store import propose
from hdbridge.commissioning.calibration.identification import identify, provenance, standings
from hdbridge.commissioning.calibration.journal import Journal, fault_notes_in, tasks_of
from hdbridge.commissioning.calibration.measure import SILENT, Callbacks, measure
from hdbridge.commissioning.calibration.motion import MotionTest, motion_test, wind_up_of
from hdbridge.commissioning.calibration.validation import Validation, floor_of, validate
from hdbridge.control.caps import cap_remark
from hdbridge.control.realtime import suspended_realtime
from hdbridge.drive.drive import Drive
from hdbridge.errors import InputError, OutputError
from hdbridge.files.atomic import write_atomically
from hdbridge.files.outputs import defer, writing
from hdbridge.records.recording import Given, Recording, agreed_ratio, by_name
from hdbridge.units import unit_of


@dataclass(frozen=True, slots=True)
class Offer:
    """Decision to offer a model for commit, or not, with the reason."""

    made: bool
    reason: str
    pending: Path | None = None
    """File of the pending model."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of a calibration, or of a fit to recordings alone (without validation and offer)."""

    recordings: tuple[str, ...]
    fit: FitResult
    model: TransmissionModel
    """New model, with its provenance."""
    active: TransmissionModel | None
    """Previously active model, for comparison."""
    axis: str | None = None
    date: str | None = None
    """Date and time of the recording, ISO 8601."""
    plan: str | None = None
    shortened: tuple[str, ...] = ()
    """Parts of the plan that were shortened for this axis, in words."""
    validation: Validation | None = None
    motion: MotionTest | None = None
    """Motion test, which measures the response; None if the plan has none."""
    drift: tuple[tuple[float, float], ...] = ()
    """Time (s) and error (arcsec, relative to the first) of each visit to the reference pose."""
    offer: Offer | None = None

    def as_dict(self) -> dict[str, Any]:
        """Returns the document of ``--json``, schema ``hdbridge.calibration/1``."""
        fit, held_out = self.fit, self.fit.held_out
        return {
            "schema": "hdbridge.calibration/1",
            "axis": self.axis,
            "recordings": list(self.recordings),
            "date": self.date,
            "plan": self.plan,
            "shortened": list(self.shortened),
            "ratio": self.model.ratio,
            "offered": self.offer.made if self.offer else None,
            "reason": self.offer.reason if self.offer else None,
            "pending": str(self.offer.pending) if self.offer and self.offer.pending else None,
            "parameters": [
                {
                    "effect": each.effect,
                    "parameter": each.parameter,
                    "value": _number(each.value),
                    "unit": unit_of(each.parameter),
                    "ci95": [_number(each.value - each.half_width), _number(each.value + each.half_width)],
                    "identifiable": each.identifiable,
                }
                for each in fit.intervals
            ],
            "changes": [
                {name: getattr(each, name) for name in ("effect", "parameter", "before", "after")}
                for each in (diff(self.active, self.model) if self.active else [])
                if each.changed
            ],
            "orders": [
                {
                    "order": str(each.order),
                    "amplitude_arcsec": each.amplitude_arcsec,
                    "fall_in_chi_square": each.fall_in_chi_square,
                    "threshold": each.threshold,
                }
                for each in fit.orders
            ],
            "beside_the_model": [
                {
                    "name": each.name,
                    "value": each.value,
                    "half_width": _number(each.half_width),
                    "unit": each.unit,
                }
                for each in fit.nuisances
            ],
            "noise": asdict(fit.noise),
            "held_out": {
                "before_arcsec": held_out.gain.before_arcsec if held_out.gain else None,
                "after_arcsec": held_out.gain.after_arcsec if held_out.gain else None,
                "fitted_arcsec": _number(held_out.fitted_arcsec),
                "over": held_out.gain.over if held_out.gain else None,
                "folds": held_out.gain.folds if held_out.gain else 0,
                "improves": held_out.improves,
                "text": held_out.text,
            },
            "residual_tests": [
                {**asdict(each), "size_arcsec": _number(each.size_arcsec)} for each in fit.residual_tests
            ],
            "outliers": {"samples": fit.outliers.samples, "longest_run": fit.outliers.longest_run},
            "warnings": list(fit.warnings),
            "drift": [{"time_s": time_s, "error_arcsec": error} for time_s, error in self.drift],
            "stepping": self.validation.as_dict() if self.validation else None,
            "motion": self.motion.as_dict() if self.motion else None,
        }


def _number(value: float) -> float | None:
    """Returns the number, or None if it is not finite, because JSON has no infinity."""
    return float(value) if math.isfinite(value) else None


RESULT_NAME = "calibration.json"
MODEL_NAME = "model.yaml"
ACTIVE_NAME = "active.yaml"


@suspended_realtime()  # fitting takes long; a bench resumes real-time priority for each motion
def calibrate(
    drive: Drive,
    journal: Journal,
    profile: Path,
    date: datetime,
    callbacks: Callbacks = SILENT,
) -> Calibration:
    """Measures the remaining tasks, fits, validates, and proposes the model to the profile.

    ``profile`` is the folder of axis.yaml. A model that does not improve on held-out data, or that worsens
    positioning, is saved in the recording's folder but not proposed.
    """
    axis, notify = drive.axis, callbacks.notify
    measure(drive, journal, callbacks)
    active = active_model(profile, axis, drive, notify)
    notify("fitting")
    recording = journal.recording()
    result = conclude({journal.folder: recording}, axis.gear.ratio, active, axis=axis)
    if active and active.response:
        # This calibration measured the gear again, but not the servo or the load inertia.
        kept = MotionTest(
            (), active.response, wind_up=wind_up_of(active) if not wind_up_of(result.model) else None
        )
        result = replace(result, model=kept.applied(result.model))
    if not result.fit.held_out.improves:
        result = replace(result, offer=Offer(False, f"not offered for commit: {result.fit.held_out.text}"))
        return _kept(journal.folder, result)
    if remark := cap_remark(axis, result.model):
        notify(remark)
    if journal.plan.validation.motion:
        notify("measuring the response in motion")
        try:
            tested = motion_test(drive, result.model, callbacks)
        except InputError as problem:
            notify(f"not tested in motion: {problem}")
        else:
            result = replace(result, model=tested.applied(result.model), motion=tested)
    notify("testing it on the axis, before and after")
    floor = floor_of(axis, recording)
    checked, model = validate(drive, journal.plan, active, result.model, floor, journal.folder, callbacks)
    for each in diff(result.model, model):
        if each.changed:
            notify(f"{each.effect}.{each.parameter} at rest: {each.after:.2f}; fitted {each.before:.2f}")
    result = replace(result, model=model, validation=checked)
    before, after = (each.pooled.three_sigma_arcsec for each in (checked.before, checked.after))
    if not checked.improves:
        reason = (
            f"not offered for commit: stepping is worse, 3 sigma {after:.2f} arcsec instead of {before:.2f} "
            f"with {checked.before.model}"
        )
        return _kept(journal.folder, replace(result, offer=Offer(False, reason)))
    figures = (f"stepping 3 sigma {before:.2f} to {after:.2f} arcsec", *checked.worse)
    if result.motion is not None:
        figures = (*figures, result.motion.summary)
    reason = f"calibration {journal.folder.name}: {', '.join(figures)}"
    return _kept(journal.folder, replace(result, offer=proposed(profile, result.model, reason, date, drive)))


def proposed(profile: Path, model: TransmissionModel, reason: str, date: datetime, drive: Drive) -> Offer:
    """Makes the model pending; if its file cannot be written, the offer's reason still states the results."""
    try:
        return Offer(True, reason, propose(profile, model, reason, date, drive.identity))
    except OutputError as problem:
        defer(problem)
        return Offer(False, f"not offered for commit: {problem}; {reason}")


def conclude(
    recordings: Mapping[Path, Recording],
    ratio: float,
    active: TransmissionModel | None = None,
    *,
    axis: AxisConfig | None = None,
    independent_zeros: bool = False,
) -> Calibration:
    """Fits a model to recordings, keyed by path, in the given order; requires no drive.

    With ``axis``, the model is bound to it.
    """
    measured = list(recordings.values())
    fit = identify(measured, ratio, active, independent_zeros=independent_zeros)
    fit = replace(fit, warnings=(*_lost(recordings), *fault_notes_in(recordings), *fit.warnings))
    gain = fit.held_out.gain
    held_out = gain.as_dict() if gain else fit.held_out.text
    model = fit.model.with_provenance(**provenance(recordings, measured, held_out))
    first = measured[0]
    return Calibration(
        recordings=tuple(map(str, recordings)),
        fit=fit,
        model=model.bound_to(axis, first.drive) if axis else model,
        active=active,
        axis=axis.name if axis else first.axis,
        date=first.date,
        plan=first.notes.get("plan", {}).get("name"),
        shortened=tuple(first.notes.get("shortened", ())),
        drift=tuple(standings(first, ratio)) if len(measured) == 1 else (),
    )


def _lost(recordings: Mapping[Path, Recording]) -> Iterator[str]:
    """Yields one line for each channel that failed during a task."""
    tasks = [(task, path) for path, each in recordings.items() for task in tasks_of(each)]
    for key in dict.fromkeys(key for task, _ in tasks for key in task.lost):
        places = ", ".join(f"{path.name}/{task.file}" for task, path in tasks if key in task.lost)
        yield f"the {key.replace('_', ' ')} was lost during the test ({places}); the fit does without it"


def concluded(folder: Path) -> Calibration:
    """Restores the result of a calibration from its folder: refits it and reads the stored tests and offer.

    InputError if the recording has no gear ratio, or if the stored result is damaged.
    """
    recording = Recording.load(folder)
    if recording.ratio is None:
        raise InputError(f"{folder}: the recording names no gear ratio; fit it with 'hdbridge fit --ratio'")
    before = folder / ACTIVE_NAME
    active = TransmissionModel.load(before) if before.exists() else None
    result = conclude({folder: recording}, recording.ratio, active)
    path = folder / RESULT_NAME
    if not path.exists():
        return result
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        validation = Validation.from_dict(data["stepping"]) if data["stepping"] else None
        motion = MotionTest.from_dict(data["motion"]) if data.get("motion") else None
        offer = Offer(bool(data["offered"]), str(data["reason"]))
        model = TransmissionModel.load(folder / MODEL_NAME)
    except (ValueError, KeyError, TypeError, OSError):
        raise InputError(
            f"{path}: not a calibration result; restore the file, or delete it to report without it"
        ) from None
    return replace(result, model=model, validation=validation, motion=motion, offer=offer)


def active_model(
    profile: Path, axis: AxisConfig, drive: Drive, notify: Callable[[str], None] = lambda _: None
) -> TransmissionModel | None:
    """Returns the profile's active model if it belongs to this axis and drive, else None."""
    path = profile / "model.yaml"
    if not path.exists():
        return None
    model = TransmissionModel.load(path)
    try:
        model.check_bound_to(axis, drive.identity)
    except InputError as problem:
        notify(f"not compared with the active model: {problem}")
        return None
    if model.response and not model.response.fits_cycle(axis.drive.cycle_s):
        notify("the response in motion of the active model is not used: it was measured at a different cycle")
        return replace(model, response=None)
    return model


def _kept(folder: Path, result: Calibration) -> Calibration:
    save_result(folder / RESULT_NAME, result.as_dict(), result.model, result.active)
    return result


def save_result(
    path: Path,
    document: dict[str, Any],
    model: TransmissionModel | None,
    active: TransmissionModel | None,
) -> None:
    """Saves a result, the new model and the active model in the folder of a recording."""
    with writing():
        if model:
            model.save(path.with_name(MODEL_NAME))
        if active:
            active.save(path.with_name(ACTIVE_NAME))
        write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


@on_one_thread
def fit(
    recording: Given,
    *,
    ratio: float | None = None,
    axis: AxisConfig | None = None,
    active: TransmissionModel | None = None,
    independent_zeros: bool = False,
) -> Calibration:
    """Fits a model to one or several recordings; ``.model`` is the model, ``.as_dict()`` the document.

    ``ratio`` (motor turns per load turn) is needed if neither the recordings nor ``axis`` state it; with
    ``axis`` the model is bound to it. ``active`` is the model for comparison and the fall-back.
    ``independent_zeros`` states that the encoders lost their zeros between the recordings.

    InputError if a recording cannot be used, belongs to another gear, or does not come from an axis.
    Quantities that the data do not determine are listed in ``.fit.warnings``.
    """
    recordings = by_name(recording)
    said = [("ratio", ratio), (str(axis.path), axis.gear.ratio) if axis else ("axis", None)]
    known = agreed_ratio(recordings, said)
    stated_by = str(axis.path) if axis and ratio is None else ""
    check_once(list(recordings), [each.record for each in recordings.values()])
    check_records({name: each.record for name, each in recordings.items()}, known, stated_by)
    if active and axis:
        active.check_ratio(axis)
    return conclude(recordings, known, active, axis=axis, independent_zeros=independent_zeros)
