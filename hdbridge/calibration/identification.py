"""From a recording, of the bench or anybody's, to what `hdbridge.identify` is given, and what it gives."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hdbridge.calibration.journal import tasks_of
from hdbridge.effects import FloatArray, Start
from hdbridge.identify import FitOptions, FitResult, Kind, Segment, fit
from hdbridge.model import TransmissionModel
from hdbridge.observations.cuts import observed
from hdbridge.records.record import Record, time_shifts_s
from hdbridge.records.recording import Recording, versions_here

STANDING = ("reference", "standstill")


def identify(
    recordings: Sequence[Recording],
    ratio: float,
    active: TransmissionModel | None = None,
    *,
    independent_zeros: bool = False,
) -> FitResult:
    """Fit a model. InputError where the recordings cannot be used; what they cannot say: ``warnings``."""
    prepared = [observed(each.record, ratio) for each in recordings]
    whole = [replace(each, record=seen.record) for each, seen in zip(recordings, prepared, strict=True)]
    segments = segments_of(whole, independent_zeros=independent_zeros)
    found = fit(segments, ratio, FitOptions(active=active))
    remarks = tuple(remark for seen in prepared for remark in seen.remarks)
    return replace(found, warnings=(*remarks, *found.warnings))


def segments_of(recordings: Sequence[Recording], *, independent_zeros: bool = False) -> list[Segment]:
    """Several recordings, one after the other, as segments.

    A recording with legs gives a segment for each; a bare CSV file is one segment of which nothing is known.
    ``independent_zeros`` says that the encoders' zeros were lost between the recordings.
    """
    shifts = time_shifts_s([each.record for each in recordings])
    segments: list[Segment] = []
    for recording, shift_s in zip(recordings, shifts, strict=True):
        zero = (
            max((each.zero for each in segments), default=-1) + 1
            if independent_zeros or _sessions(recording)
            else 0
        )
        segments += _of_one(recording, shift_s, zero, independent_zeros)
    return segments


def standings(recording: Recording, ratio: float) -> list[tuple[float, float]]:
    """Time (s) and error (arcsec) at each visit to the reference pose; the first is zero."""
    found = [
        (
            float(np.mean(piece.time_s)),
            float(np.mean(piece.transmission_error_arcsec(ratio))),
        )
        for _, piece in recording.pieces("reference")
        if len(piece)
    ]
    return [(time_s, error - found[0][1]) for time_s, error in found]


def resting(recording: Recording, window_s: float) -> FloatArray:
    """Means over windows of ``window_s`` while the axis stood, about the mean of each stand; arcsec, (n,)."""
    means: list[FloatArray] = []
    for _, piece in recording.pieces(*STANDING):
        if len(piece) < 2:
            continue
        size = max(round(window_s * (len(piece) - 1) / float(np.ptp(piece.time_s))), 1)
        whole = len(piece) // size
        values = piece.load_position_deg[: whole * size].reshape(whole, size).mean(axis=1) * 3600.0
        if whole >= 4:
            means.append(values - values.mean())
    return np.concatenate(means) if means else np.empty(0)


def provenance(
    paths: Iterable[Path | str],
    recordings: Sequence[Recording],
    held_out: Mapping[str, Any] | str,
) -> dict[str, Any]:
    """What a model file says of where its numbers come from.

    ``held_out`` is its gain on unseen data, or in words why there is none.
    """
    dates = sorted({each.date for each in recordings if each.date})
    data: dict[str, Any] = {
        "recordings": [str(each) for each in paths],
        "recorded": dates,
        "samples": sum(len(each.record) for each in recordings),
        "versions": versions_here(),
        "held_out": held_out if isinstance(held_out, str) else dict(held_out),
    }
    return {name: value for name, value in data.items() if value not in ([], {})}


def with_provenance(model: TransmissionModel, data: dict[str, Any]) -> TransmissionModel:
    """The same model, saying where it comes from."""
    return replace(model, provenance={**model.provenance, **data})


def _sessions(recording: Recording) -> bool:
    """Whether the zeros within it are numbered by its sessions."""
    return len({each.session for each in tasks_of(recording)}) > 1


def _of_one(recording: Recording, shift_s: float, zero: int, independent: bool) -> Iterator[Segment]:
    if not recording.segments:
        for number, part in enumerate(recording.record.parts()):
            name = part.source or f"part {number + 1}"
            segment = _segment(part, Kind.UNKNOWN, shift_s, zero + number * independent, None, name)
            yield replace(segment, follows=number == 0)
        return
    tasks = list(tasks_of(recording))
    session, known = 1, not tasks
    pieces = list(recording.pieces())
    for number, (leg, piece) in enumerate(pieces):
        if tasks and leg.start_s >= tasks[0].start_s:
            session, known = tasks.pop(0).session, False
        if not known and leg.kind == "precondition":
            continue  # the state before it is not known, after it it is
        if not len(piece):
            continue
        kind = Kind.STANDSTILL if leg.kind in STANDING else Kind.named(leg.kind)
        start = None if known else Start.FORWARD
        known = True
        name = f"leg {number + 1} of {len(pieces)} ({leg.kind})"
        yield _segment(piece, kind, shift_s, zero + session - 1, start, name)


def _segment(
    record: Record, kind: Kind, shift_s: float, zero: int, start: Start | None, name: str
) -> Segment:
    target = record.motor_target_deg
    return Segment(
        time_s=record.time_s + shift_s,
        motor_deg=record.motor_position_deg if target is None else target,
        load_deg=record.load_position_deg,
        kind=kind,
        position_deg=None if target is None else record.motor_position_deg,
        commanded=target is not None,
        measured=record.measured,
        start=start,
        zero=zero,
        name=name,
    )
