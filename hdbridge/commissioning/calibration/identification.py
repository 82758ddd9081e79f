"""Joins recordings into one measurement and identifies the axis from it (`hdbridge.analysis.identify`)."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hdbridge.analysis.cuts import jumps, observed
from hdbridge.analysis.identification import FitOptions, FitResult
from hdbridge.analysis.identify import fit
from hdbridge.analysis.linear import counted
from hdbridge.analysis.prepared import Measured
from hdbridge.axis.effects import FloatArray, IntArray, Start
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.journal import tasks_of
from hdbridge.errors import InputError
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording, versions_here

STANDING = ("reference", "standstill")


def identify(
    recordings: Sequence[Recording],
    ratio: float,
    active: TransmissionModel | None = None,
    *,
    independent_zeros: bool = False,
) -> FitResult:
    """Fits a model to recordings; InputError if they are unusable.

    The ``warnings`` of the result list the quantities that the data do not determine.
    """
    prepared = [observed(each.record, ratio) for each in recordings]
    whole = [replace(each, record=seen.record) for each, seen in zip(recordings, prepared, strict=True)]
    measured = measured_of(whole, independent_zeros=independent_zeros)
    found = fit(measured, ratio, FitOptions(active=active))
    remarks = tuple(remark for seen in prepared for remark in seen.remarks)
    return replace(found, warnings=(*remarks, *found.warnings))


def measured_of(recordings: Sequence[Recording], *, independent_zeros: bool = False) -> Measured:
    """Joins recordings in order, leg by leg; a recording without legs is used as a whole.

    ``independent_zeros`` states that the encoders lost their zeros between the recordings. InputError if no
    samples are usable.
    """
    pieces: list[_Piece] = []
    for recording in recordings:
        zeros = int(pieces[-1].zero[-1]) + 1 if pieces else 0
        apart = independent_zeros or len({each.session for each in tasks_of(recording)}) > 1
        pieces += _pieces(recording, zeros if apart else 0, independent_zeros)
    if not pieces:
        raise InputError("the recordings hold no leg to be used; expected samples: record more")
    whole = concatenate([each.record for each in pieces])
    kinds = tuple(dict.fromkeys(each.kind for each in pieces))
    zero = np.concatenate([each.zero for each in pieces])
    edges = np.cumsum([0, *(len(each.record) for each in pieces)]).tolist()
    # Motion is continuous from one leg to the next, except at jumps and where the zeros were lost.
    begins = {0, *(np.flatnonzero(np.diff(zero)) + 1).tolist()}
    begins |= {row + 1 for row in jumps(whole.motor_position_deg, whole.time_s).tolist() if row + 1 in edges}
    begins |= {
        first + row for first, each in zip(edges, pieces, strict=False) for row in each.record.starts[1:]
    }
    states = {first: each.start for first, each in zip(edges, pieces, strict=False) if each.start is not None}
    return Measured(
        Record(whole.columns, whole.source, tuple(sorted(begins | states.keys()))),
        kinds,
        np.repeat([kinds.index(each.kind) for each in pieces], np.diff(edges)),
        counted(zero),
        states,
    )


def standings(recording: Recording, ratio: float) -> list[tuple[float, float]]:
    """Returns time (s) and error (arcsec, relative to the first) of each visit to the reference pose."""
    found = [
        (float(np.mean(piece.time_s)), float(np.mean(piece.transmission_error_arcsec(ratio))))
        for _, piece in recording.pieces("reference")
        if len(piece)
    ]
    return [(time_s, error - found[0][1]) for time_s, error in found]


def resting(recording: Recording, window_s: float) -> FloatArray:
    """Returns the load angle at standstill, averaged over windows, relative to the mean of its standstill;
    arcsec, shape (n,).
    """
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
    paths: Iterable[Path | str], recordings: Sequence[Recording], held_out: Mapping[str, Any] | str
) -> dict[str, Any]:
    """Returns the provenance for a model file.

    ``held_out`` is the gain on held-out data, or a text with the reason for its absence.
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


class _Piece(NamedTuple):
    record: Record
    kind: str
    zero: IntArray
    start: Start | None


def _pieces(recording: Recording, zero: int, independent: bool) -> Iterator[_Piece]:
    record = recording.record
    if not recording.segments:
        part = np.zeros(len(record), dtype=np.intp)
        part[list(record.starts[1:])] = 1
        yield _Piece(record, "unknown", zero + independent * np.cumsum(part), None)
        return
    tasks = list(tasks_of(recording))
    session, known = 1, not tasks
    for leg, piece in recording.pieces():
        if tasks and leg.start_s >= tasks[0].start_s:
            session, known = tasks.pop(0).session, False
        if not known and leg.kind == "precondition":
            continue  # the gear's state is known only after this leg
        if len(piece):
            yield _Piece(
                piece, leg.kind, np.full(len(piece), zero + session - 1), None if known else Start.FORWARD
            )
            known = True
