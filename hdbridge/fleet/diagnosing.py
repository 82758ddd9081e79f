"""Task of a worker: converts one recording of the fleet to plain rows, including errors.

The key of a row is a hash of its samples, model and version. The motor orders are estimated from the samples
alone, so that joints can be distinguished without relying on their models.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdbridge import __version__
from hdbridge.axis.effects import FloatArray
from hdbridge.errors import HdbridgeError, InputError
from hdbridge.files.expectation import one_line
from hdbridge.fleet.sources import BUS_LOGS, NotFetchedError, Source, fetched
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.units import DEG_PER_TURN

if TYPE_CHECKING:
    from hdbridge.analysis.findings import Diagnosis

ORDERS: Final = (1, 2, 3, 4, 5, 6, 7, 8)
"""Motor orders that identify a joint."""
SETTLED_DEG: Final = 90.0
"""Motor travel after each reversal that is excluded from the estimation of orders, because the hysteresis
loop is not saturated yet."""
TURNS: Final = 2.0
"""Minimum travel for estimating orders; motor turns."""
NO_MEMORY: Final = "more memory was needed than a worker has; raise --memory"
Row = dict[str, Any]


@dataclass(frozen=True)
class Model:
    """Model of a joint as text, or the reason for its absence."""

    text: str = ""
    where: str = ""
    reason: str = ""
    sha256: str | None = None
    """Hash of the model without its provenance."""


@cache
def model_in(text: str, where: str) -> Model:
    """Returns the `Model` of a model file's text; that of an invalid file contains the reason."""
    from hdbridge.axis.model import TransmissionModel

    try:
        document = TransmissionModel.from_text(text, where).document()
    except InputError as problem:
        return Model(where=where, reason=str(problem))
    content = {name: each for name, each in document.items() if name != "provenance"}
    return Model(text, where, sha256=hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest())


def fitted(sources: Sequence[Source], where: str) -> Model:
    """Fits the model of a joint to the first usable one of its recordings.

    If none is usable, the reason given is that of a readable recording if possible.
    """
    from hdbridge.commissioning.calibration import fit

    reasons = []
    for source in sources:
        unread = True
        try:
            recording = read(source)
            unread = False
            return model_in(fit(recording, ratio=source.ratio or recording.ratio).model.dump(), where)
        except Exception as problem:
            reasons.append((unread, _reason(problem)))
    _, reason = min(reasons, key=lambda each: each[0], default=(True, "no recording"))
    return Model(where=where, reason=f"no model could be fitted: {reason}")


def axes_of(path: str) -> list[str] | str:
    """Returns the axes of a flight recording, or the reason why it cannot be read."""
    from hdbridge.daemon.recorder.reading import overview

    try:
        with fetched(path) as file:
            return [each.name for each in overview(file).about.axes] or f"{path}: no axis in this recording"
    except Exception as problem:
        return _reason(problem)


def read(source: Source) -> Recording:
    """Reads the recording of a source; InputError for any error in it."""
    with fetched(source.path) as path:
        try:
            if source.is_flight:
                from hdbridge.daemon.recorder.export import exported
                from hdbridge.daemon.recorder.reading import read as read_flight

                return exported([read_flight(path, (source.axis,) if source.axis else None)], source.axis)
            if source.path.endswith(BUS_LOGS):
                from hdbridge.axis import AxisConfig
                from hdbridge.control.buslog import import_log
                from hdbridge.files.profile import Profile

                if source.axis is None:
                    raise InputError(f"{path}: a bus log needs its axis file; name it in the manifest: axis")
                return import_log(path, AxisConfig.load(Profile.find(source.axis).axis))
            if not path.exists():
                raise InputError(f"{path}: no such recording; correct the path")
            return Recording.load(path, columns=source.columns, units=source.units, unwrap=source.unwrap)
        except HdbridgeError as problem:
            raise InputError(str(problem).replace(str(path), source.path)) from None


def diagnosed(source: Source, model: Model, known: str = "") -> Row:
    """Diagnoses a recording and returns its row; stops early, without ``findings``, at the ``known`` key."""
    row = _described(source) | {"model": model.where or None, "model_sha256": model.sha256}
    try:
        recording = read(source)
        if source.joint is None:
            raise InputError(f"{source.path}: the joint is not known; name it in the manifest: joint")
        row |= _of_samples(recording)
        row["date"] = row["date"] or recording.date
        if model.reason:
            raise InputError(model.reason)
        from hdbridge.axis.model import TransmissionModel

        used = TransmissionModel.from_text(model.text, model.where or "model.yaml")
        ratio = source.ratio or recording.ratio or used.ratio
        row |= {"ratio": ratio, "gear": source.gear or f"ratio {ratio:g}"}
        row["key"] = _key(row)
        if row["key"] == known:
            return row
        row |= _orders(recording.record, ratio)
        recording = replace(recording, ratio=ratio)
        from hdbridge.analysis.diagnosis import diagnose

        row |= _of_diagnosis(diagnose(recording, used))
        origin = recording.record.origin
        if origin is not None and origin.remark:
            row["remarks"].append(origin.remark.replace(str(origin.file.path), source.path))
    except Exception as problem:
        row["reason"] = _reason(problem)
        row["key"] = _key(row)
        if isinstance(problem, NotFetchedError):
            row["stamp"] = None
        if row["key"] == known:
            return row
    return {"findings": [], **row}


def lost(source: Source, reason: str) -> Row:
    """Returns the row of a recording without a diagnosis, for example because it kills its worker."""
    row = _described(source) | {"reason": reason, "findings": []}
    return {**row, "key": _key(row)}


def _described(source: Source) -> Row:
    """Returns the columns that are known before a recording is read."""
    return asdict(source) | {"joint": source.joint or "", "version": __version__}


def _reason(problem: Exception) -> str:
    text = str(problem) if isinstance(problem, HdbridgeError) else f"{type(problem).__name__}: {problem}"
    if isinstance(problem, MemoryError):
        text = NO_MEMORY
    elif not isinstance(problem, HdbridgeError):
        text = f"an error in hdbridge, please report it: {text}"
    return one_line(text)


def _of_samples(recording: Recording) -> Row:
    record = recording.record
    digest = hashlib.sha256()
    for column in (record.time_s, record.motor_position_deg, record.load_position_deg):
        digest.update(np.ascontiguousarray(column, dtype="<f8").tobytes())
    temperature = record.columns.get("temperature_c")
    return {
        "samples_sha256": digest.hexdigest(),
        "samples": len(record),
        "duration_s": float(sum(np.ptp(each.time_s) for each in record.parts() if len(each))),
        "travel_deg": float(np.ptp(record.load_position_deg)),
        "temperature_c": None if temperature is None else float(np.mean(temperature)),
    }


def _key(row: Mapping[str, Any]) -> str:
    """Hashes samples, model and version; without a diagnosis, samples, joint, reason and version."""
    if row.get("reason"):
        parts = [row.get("samples_sha256", ""), row["joint"], row["reason"], row["version"]]
    else:
        parts = [row["samples_sha256"], row["model_sha256"], row["version"]]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _of_diagnosis(diagnosis: Diagnosis) -> Row:
    from hdbridge.analysis.intervals import leaves

    model = diagnosis.model
    figures = []
    for effect in model.effects:
        half = dict(leaves(model.uncertainty.get(effect.name, {})))
        for path, value in leaves(effect.parameters()):
            if path in half:
                name = f"{effect.name}.{path}"
                figures.append({"name": name, "value": value, "half_width": half[path]})
    return {
        "rms_arcsec": diagnosis.baseline.rms_arcsec,
        "refitted_rms_arcsec": diagnosis.refitted.rms_arcsec,
        "extended_rms_arcsec": diagnosis.extended.rms_arcsec,
        "floor_arcsec": diagnosis.noise_floor_arcsec,
        "figures": figures,
        "limits": [
            {"cause": name, "arcsec": each.detection_limit_arcsec}
            for name, each in sorted(diagnosis.identifiability.items())
            if each.detectable and each.detection_limit_arcsec is not None
        ],
        "remarks": list(diagnosis.remarks),
        "findings": [
            {
                "rank": rank,
                "cause": each.cause,
                "probability": each.probability,
                "aliases": list(each.aliases),
                "peak_arcsec": each.peak_arcsec,
                "held_out_before_arcsec": each.gain.before_arcsec if each.gain else None,
                "held_out_after_arcsec": each.gain.after_arcsec if each.gain else None,
                "parameters": [
                    {"name": name, "value": one.value, "low": one.low, "high": one.high, "unit": one.unit}
                    for name, one in each.parameters.items()
                ],
                "lives_in": each.lives_in,
                "note": each.note,
            }
            for rank, each in enumerate(diagnosis.findings, 1)
        ],
    }


def _orders(record: Record, ratio: float) -> Row:
    """Fits cosine and sine of each motor order by least squares to the samples away from reversals."""
    rows, designs, kept = [], [], 0.0
    for number, part in enumerate(record.parts()):
        clear = _clear(part.motor_position_deg)
        turn = np.radians(part.motor_position_deg[clear])
        kept += float(np.sum(np.abs(np.diff(turn))[np.abs(np.diff(turn)) < 1.0])) / np.radians(DEG_PER_TURN)
        rows.append(part.transmission_error_arcsec(ratio)[clear])
        direction = np.sign(np.gradient(part.motor_position_deg))[clear] if len(part) > 1 else turn
        load = np.radians(part.load_position_deg[clear])
        waves = [wave(k * turn) for k in ORDERS for wave in (np.cos, np.sin)]
        waves += [wave(k * load) for k in (1, 2) for wave in (np.cos, np.sin)]
        designs.append(
            np.column_stack([*waves, direction, np.full(len(turn), float(number == 0)), np.ones(len(turn))])
        )
    if kept < TURNS:
        return {"orders": []}
    found, *_ = np.linalg.lstsq(np.concatenate(designs), np.concatenate(rows), rcond=1e-6)
    return {
        "orders": [
            {"order": k, "cos_arcsec": float(found[2 * i]), "sin_arcsec": float(found[2 * i + 1])}
            for i, k in enumerate(ORDERS)
        ]
    }


def _clear(motor_deg: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Selects moving samples more than `SETTLED_DEG` beyond the last reversal; mask of shape (n,)."""
    steps = np.diff(motor_deg, prepend=motor_deg[:1])
    moving = np.abs(steps) > 1e-9
    sign = np.sign(steps)
    held = sign[np.maximum.accumulate(np.where(moving, np.arange(len(sign)), 0))] if len(sign) else sign
    turned = np.concatenate([[True], held[1:] != held[:-1]]) if len(sign) else moving
    since = np.maximum.accumulate(np.where(turned, np.arange(len(sign)), 0))
    result: np.ndarray[Any, np.dtype[np.bool_]] = moving & (
        np.abs(motor_deg - motor_deg[since]) > SETTLED_DEG
    )
    return result


def local_model(path: str) -> Model:
    """Reads the model file at a local path or URL; an error becomes the reason of the `Model`."""
    try:
        with fetched(path) as file:
            return model_in(Path(file).read_text(encoding="utf-8"), path)
    except (OSError, UnicodeDecodeError) as problem:
        return Model(where=path, reason=f"{path}: cannot be read: {problem}")
    except InputError as problem:
        return Model(where=path, reason=str(problem))
