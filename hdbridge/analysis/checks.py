"""What goes wrong with records of other benches, refused in words before anything is made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hdbridge.analysis.cuts import observed
from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.files.csvfile import line_of_row
from hdbridge.records.record import REQUIRED, Record
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

WRAPPED_SHARE = 0.05
"""How near a whole number of turns a jump is when it is an angle that began anew."""
LEAST_WHOLE = 10.0
"""Travel beyond which whole numbers are no chance."""
LEAST_JUMP_DEG = 900.0 / ARCSEC_PER_DEG
"""No gear's error jumps by as much."""


def check_records(records: Mapping[Path, Record], ratio: float) -> None:
    """Refuse (InputError) records that no axis of this ratio can have made, or that say nothing of one.

    Time has to pass, angles have to be multi-turn, the ratio has to be the gear's, and in one of the records
    the motor has to move. Each record is named by its path.
    """
    for path, given in records.items():
        record = observed(given, ratio).record
        if len(record) > 1 and float(np.ptp(record.time_s)) == 0.0:
            raise InputError(
                f"{path}: time_s: {record.time_s[0]:g} in all {len(record)} rows; expected time that passes"
            )
        _check_whole(path, record)
        _check_wrapped(path, record, given, ratio)
        for part in record.parts():
            part.check_ratio(ratio)
    counts = sum(len(each) for each in records.values())
    if counts and not any(_moves(each) for each in records.values()):
        raise InputError(
            f"{', '.join(map(str, records))}: the motor never moves in {counts} samples; expected a move: "
            "record sweeps in both directions"
        )


def zeros_apart_arcsec(records: Sequence[Record], ratio: float) -> float | None:
    """How far apart the zeros of records are that went the same way; None where that is no more than their
    own errors, or there is nothing to compare.

    Half the height of a loop lies between two directions, so only records of one direction are compared.
    """
    apart: list[float] = []
    for sign in (-1.0, 1.0):
        errors = [
            each.transmission_error_arcsec(ratio)
            for each in records
            if len(each) > 1 and np.sign(each.motor_position_deg[-1] - each.motor_position_deg[0]) == sign
        ]
        if len(errors) < 2:
            continue
        means = [float(np.mean(each)) for each in errors]
        own = float(np.sqrt(np.mean([np.var(each) for each in errors])))
        if np.std(means) > 2.0 * own:
            apart.append(float(np.ptp(means)))
    return max(apart, default=None)


def _moves(record: Record) -> bool:
    return len(record) > 1 and float(np.ptp(record.motor_position_deg)) > 0.0


def check_once(paths: Sequence[Path], records: Sequence[Record]) -> None:
    """Refuse (InputError) a measurement that is named twice: what it says would count twice."""
    for number, (path, record) in enumerate(zip(paths, records, strict=True)):
        for other, before in zip(paths[:number], records[:number], strict=True):
            if len(record) == len(before) and all(
                np.array_equal(record.columns[name], before.columns[name]) for name in REQUIRED
            ):
                same = "is named twice" if path == other else f"holds the same samples as {other}"
                raise InputError(f"{path}: {same}; expected each measurement once: leave one of them out")


def _check_whole(path: Path, record: Record) -> None:
    """Refuse a load angle in whole numbers: no encoder reads whole degrees."""
    load = record.load_position_deg
    if len(load) and float(np.ptp(load)) >= LEAST_WHOLE and np.all(load == np.round(load)):
        raise InputError(
            f"{path}: load_position_deg: whole numbers only ({load[0]:.10g} to {load[-1]:.10g}), which looks "
            "like counts; expected degrees: multiply by 360, divided by the encoder's counts per turn (look "
            "at motor_position_deg, too)"
        )


def _check_wrapped(path: Path, record: Record, given: Record, ratio: float) -> None:
    """Refuse an angle that jumps by a turn of its encoder from one sample to the next."""
    slip = np.diff(record.load_position_deg) - np.diff(record.motor_position_deg) / ratio
    for name, turn_deg in (("load_position_deg", DEG_PER_TURN), ("motor_position_deg", DEG_PER_TURN / ratio)):
        angle = record.columns[name]
        rows = _wraps(slip, turn_deg)
        rows = rows[np.abs(np.diff(angle)[rows]) > 0.5 * DEG_PER_TURN]
        if len(rows):
            row = int(rows[0]) + 1
            line = int(np.searchsorted(given.time_s, record.time_s[row]))
            where = f"{path}:{line_of_row(path, line)}" if path.is_file() else f"{path}"
            raise InputError(
                f"{where}: {name}: {angle[row]:g} after {angle[row - 1]:g}, a jump of a whole turn that the "
                f"other angle does not make; expected multi-turn angles: unwrap the column "
                f"({len(rows)} such jumps)"
            )


def _wraps(slip_deg: FloatArray, turn_deg: float) -> NDArray[np.intp]:
    """The steps that are off by a turn, or several, of an encoder; no gear's error is as large."""
    turns = slip_deg / turn_deg
    whole = np.round(turns)
    near = (whole != 0.0) & (np.abs(turns - whole) < WRAPPED_SHARE * np.abs(whole))
    return np.flatnonzero(near & (np.abs(slip_deg) > LEAST_JUMP_DEG))
