"""Splits a concatenated record at its joins and drops invalid readings.

A motor cannot jump between two samples. A jump is either a join of two records, with unknown motion between
them, or a misreading if the angle returns after one or two samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from hdbridge.analysis.readings import coarse, spread
from hdbridge.axis.effects import FloatArray
from hdbridge.records.record import Record
from hdbridge.units import ARCSEC_PER_DEG

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

FASTEST_DEG_S2 = 1e6
"""Upper limit of the motor acceleration: a small servo motor at peak torque (17,000 rad/s^2). A motor with a
wave generator on its shaft reaches less."""
JUMP_DEG = 30.0
"""Minimum step of the motor angle that counts as a jump; smaller ones may be noise or a lost count."""
SPIKE_ARCSEC = 900.0
"""Minimum deviation of a misread sample from its neighbours' transmission error; no gear can produce it."""
SLOWEST_S = 1.0
"""Shortest implausible sample period; such a record has too few samples per motor turn."""
MISREAD_ROWS = 2
"""Maximum length of a misreading, samples."""
MISREAD_SHARE = 0.01
"""Maximum fraction of misread samples; a larger fraction has another cause, and no sample is dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """A record without invalid readings, split at jumps of the motor angle."""

    record: Record
    remarks: tuple[str, ...]
    """Descriptions of the samples left out and of the cuts."""
    cuts: tuple[int, ...] = ()
    """Rows that follow a jump, before which the motion is unknown; a subset of ``record.starts``."""


def observed(record: Record, ratio: float) -> Observed:
    """Cleans a record: spreads coarse time stamps evenly, drops misread samples and cuts at jumps.

    Returns an intact record unchanged.
    """
    remarks = []
    if repeated := sum(coarse(part.time_s, part.motor_position_deg) for part in record.parts()):
        remarks.append(
            f"{_name(record)}{repeated} of {len(record)} samples have the time of the previous one, although "
            "the motor has moved: the clock is coarser than the sampling; the samples are spread evenly over "
            "its ticks"
        )
        times = np.concatenate([spread(part.time_s) for part in record.parts()])
        record = replace(record, columns={**record.columns, "time_s": times})
    kept = np.ones(len(record), dtype=np.bool_)
    for first, end in _edges(record):
        kept[first:end] = ~_misread(record.rows(first, end), ratio)
    if not np.all(kept):
        rows = np.flatnonzero(~kept)
        remarks.append(
            f"{_name(record)}{len(rows)} of {len(record)} samples left out as misread, because their angles "
            f"jump and return (the first is number {rows[0] + 1}, at {record.time_s[rows[0]]:g} s)"
        )
        record = _picked(record, kept)
    cuts = [int(row) + 1 for row in jumps(record.motor_position_deg, record.time_s)]
    new = sorted(set(cuts) - set(record.starts))
    if new:
        step = record.motor_position_deg[new[0]] - record.motor_position_deg[new[0] - 1]
        remarks.append(
            f"{_name(record)}cut where the motor jumps ({step:+.0f} deg before {record.time_s[new[0]]:g} s"
            f"{f', and {len(new) - 1} more' if len(new) > 1 else ''}): nothing is known of the axis between "
            "the parts"
        )
        record = replace(record, starts=tuple(sorted({*record.starts, *new})))
    steps = np.diff(record.time_s)
    period_s = float(np.median(steps)) if len(steps) else 0.0
    if period_s >= SLOWEST_S and float(np.ptp(record.motor_position_deg)) > 0.0:
        remarks.append(
            f"{_name(record)}time_s advances by {period_s:g} s per sample, too slow to see a motor turn: if "
            "these are milliseconds, divide them by 1000"
        )
    return Observed(record, tuple(remarks), tuple(cuts))


def _edges(record: Record) -> list[tuple[int, int]]:
    return list(zip(record.starts, (*record.starts[1:], len(record)), strict=True))


def _name(record: Record) -> str:
    return f"{record.source}: " if record.source else ""


def _picked(record: Record, kept: BoolArray) -> Record:
    before = np.concatenate([[0], np.cumsum(kept)])
    starts = tuple(dict.fromkeys(int(before[each]) for each in record.starts))
    columns = {name: column[kept] for name, column in record.columns.items()}
    return replace(record, columns=columns, starts=starts)


def jumps(motor_deg: FloatArray, time_s: FloatArray) -> IntArray:
    """Returns the indices of steps that no motor can make, given the speeds before and after them."""
    step, time = np.diff(motor_deg), np.maximum(np.diff(time_s), 1e-6)
    if not len(step):
        return np.empty(0, dtype=np.intp)
    speed = step / time
    before = np.concatenate([[0.0], speed[:-1]])
    after = np.concatenate([speed[1:], [0.0]])
    excess = np.minimum(np.abs(speed - before), np.abs(speed - after)) * time
    return np.flatnonzero((excess > JUMP_DEG) & (4.0 * excess / time**2 > FASTEST_DEG_S2))


def _misread(record: Record, ratio: float) -> BoolArray:
    """Returns a mask of misread samples: one of the angles jumps away and returns within `MISREAD_ROWS`."""
    window = 2 * MISREAD_ROWS + 1
    found = np.zeros(len(record), dtype=np.bool_)
    if len(record) <= 2 * window:
        return found
    error = (record.load_position_deg - record.motor_position_deg / ratio) * ARCSEC_PER_DEG
    found |= np.abs(error - median_filter(error, window, mode="mirror")) > SPIKE_ARCSEC
    rows = jumps(record.motor_position_deg, record.time_s).tolist()
    for out, back in pairwise(rows):
        away = record.motor_position_deg[out + 1] - record.motor_position_deg[out]
        returned = record.motor_position_deg[back + 1] - record.motor_position_deg[out]
        if back - out <= MISREAD_ROWS and abs(returned) < 0.5 * abs(away):
            found[out + 1 : back + 1] = True
    return found if np.mean(found) <= MISREAD_SHARE else np.zeros(len(record), dtype=np.bool_)
