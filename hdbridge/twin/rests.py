"""Where an axis stands in a recording, by what torque it is held there, and where what was before is unknown.

A motor that has stuck creeps as its integral goes on, until it breaks away: a replay that is off by a
thousandth of a count there sets out at another time. But the recording tells by what torque it is held.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import FloatArray
from hdbridge.records.record import Record

RINGING_S = 0.25
"""So long after the command has come to rest the torque still tells of the motion; then of how it stuck."""
STANDS_COUNTS = 1.5
"""A motor that stays within so many counts of where it comes to rest stands. Its torque is what the integral
stopped at, or creeps up while friction holds it: which of the two hangs on a thousandth of a count."""
HELD_S = 0.1
"""A motor that stands so long after the command is held by the integral alone: loops answer in some ms."""
UNKNOWN_S = 1.0
"""Time after which a load that was ringing before a recording is at rest, where that is not known."""
LARGEST_UNKNOWN = 0.25
"""Of a part of a recording, the largest share that is left out for that."""


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


def unknown_rows(part: Record, counts_per_turn: int) -> NDArray[np.bool_]:
    """For each row whether the load may still ring of what nobody knows.

    Where a recording begins in motion that is what was before it; where a procedure ended in motion, the
    cycles until the drive was switched off.
    """
    target, time_s = part.motor_target_deg, part.time_s
    assert target is not None  # commands_of has refused it
    begins = [0] if begins_in_motion(part) else []
    count_deg = 360.0 / counts_per_turn
    begins += [
        first
        for first in part.starts[1:]
        if abs(target[first] - target[first - 1]) > STANDS_COUNTS * count_deg
    ]
    unknown = np.zeros(len(part), dtype=np.bool_)
    ends = (*part.starts[1:], len(part))
    for begin in begins:
        end = next(each for each in ends if each > begin)
        length_s = min(UNKNOWN_S, LARGEST_UNKNOWN * float(time_s[end - 1] - time_s[begin]))
        unknown[begin:end] = time_s[begin:end] - time_s[begin] < length_s
    return unknown
