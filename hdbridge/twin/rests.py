"""Where an axis stands in a recording, by what torque it is held there, and where what was before is unknown.

A motor that has stuck creeps as its integral goes on, until it breaks away: a replay that is off by a
thousandth of a count there sets out at another time. But the recording tells by what torque it is held.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import FloatArray
from hdbridge.records.record import Record
from hdbridge.twin.stretches import RUN_IN_S, continuous

RINGING_S = 0.25
"""So long after the command has come to rest the torque still tells of the motion; then of how it stuck."""
STANDS_COUNTS = 1.5
"""A motor that stays within so many counts of where it comes to rest stands. Its torque is what the integral
stopped at, or creeps up while friction holds it: which of the two hangs on a thousandth of a count."""
HELD_S = 0.1
"""A motor that stands so long after the command is held by the integral alone: loops answer in some ms."""
LARGEST_UNKNOWN = 0.25
"""Of a recording, the largest share that is left out because of what was before it."""


def stands(moved: NDArray[np.bool_], motor_deg: FloatArray, within_deg: float) -> NDArray[np.bool_]:
    """For each row whether command and motor stand where they stand until the command moves on."""
    rest = np.cumsum(moved)
    last = np.searchsorted(rest, rest, side="right") - 1
    away = np.abs(motor_deg - motor_deg[last]) > within_deg
    rows = np.arange(len(rest))
    last_away = np.maximum.accumulate(np.where(away | moved, rows, -1))
    given: NDArray[np.bool_] = last_away < rows
    return given


def held_rows(part: Record, moved: NDArray[np.bool_], still: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Rows in which a standing motor tells by what torque it is held: each `HELD_S` of a rest, and its last.

    Not its last one alone: the integral may have moved on until the motor broke away.
    """
    rested_s = part.time_s - np.maximum.accumulate(np.where(moved, part.time_s, part.time_s[0]))
    times = np.floor(rested_s / HELD_S)
    told = still & (times >= 1.0)
    told[1:-1] &= (times[1:-1] > times[:-2]) | moved[2:]
    told[-1:] = False
    return np.flatnonzero(told)


def begins_in_motion(part: Record) -> bool:
    """Whether the command moves before it has stood long enough for the axis to rest."""
    target, time_s = part.motor_target_deg, part.time_s
    assert target is not None  # commands_of has refused it
    return bool(np.any(np.diff(target[time_s - time_s[0] < RINGING_S]) != 0.0))


def unknown_rows(record: Record, count_deg: float) -> NDArray[np.bool_]:
    """For each row of a recording whether the load may still ring of what nobody knows.

    Where a recording begins in motion, or goes on so after a while, that is what was before. Where a
    procedure ended in motion it is the cycles until the drive was switched off. ``count_deg`` is the motor's.
    """
    target, time_s = record.motor_target_deg, record.time_s
    unknown = np.zeros(len(record), dtype=np.bool_)
    if target is None:
        return unknown
    alone = {each.start for each in continuous(record)}
    parts = []
    for first, end in pairwise((*record.starts, len(record))):
        jumps = first > 0 and abs(target[first] - target[first - 1]) > STANDS_COUNTS * count_deg
        if jumps or (first in alone and begins_in_motion(record.rows(first, end))):
            parts.append(slice(first, end))
    rings_s = [min(RUN_IN_S, float(time_s[each][-1] - time_s[each][0])) for each in parts]
    whole_s = sum(float(np.ptp(each.time_s)) for each in record.parts())
    share = min(1.0, LARGEST_UNKNOWN * whole_s / max(sum(rings_s), 1e-9))
    for part, length_s in zip(parts, rings_s, strict=True):
        unknown[part] = time_s[part] - time_s[part.start] <= share * length_s
    return unknown
