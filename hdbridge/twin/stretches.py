"""What a fit replays in one go: stretches of long parts, with what came before them. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import FloatArray
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment

# ----------------------------------------------------------------

STRETCH_S = 10.0
"""Long against what a replay does not know of the time before it: 60 degrees of the motor, the ringing."""
LONG_S = 30.0
"""A part no longer than this stays whole."""
GAP_S = 0.5
"""A master that goes from task to task records nothing for some cycles; the command may stay the same."""
SAME_DEG = 1e-6
"""Of the motor: the same count, told with as many digits."""
STOPPED_DEG = 5.0
"""Of the motor: as far as it goes at most from the last row of a procedure until it has stopped."""
IDLE = 0.002
"""Share of a record's largest torque that is as good as none."""
RUN_IN_S = 2.0
"""What happened so long before a stretch is no longer to be seen in it: the ringing of a load that is hardly
damped (15 Hz, 0.03) has come down to a three-hundredth."""


def stretches(part: Record, legs: Sequence[Segment]) -> list[Record]:
    """The part's rows in order; each stretch begins with a leg, or within one longer than a stretch."""
    start_s, end_s = float(part.time_s[0]), float(part.time_s[-1])
    if end_s - start_s <= LONG_S:
        return [part]
    places: list[float] = []
    for leg in legs:
        inside = np.arange(leg.start_s, leg.end_s, STRETCH_S)
        places += [each for each in inside.tolist() if start_s < each < end_s]
    cuts = [start_s]
    for place in sorted(places):
        if place - cuts[-1] >= 0.5 * STRETCH_S and end_s - place >= 0.5 * STRETCH_S:
            cuts.append(place)
    rows = [*np.searchsorted(part.time_s, cuts).tolist(), len(part)]
    return [part.rows(first, end) for first, end in pairwise(rows)]


def continuous(record: Record) -> list[slice]:
    """The rows of parts that follow each other, in order: within `GAP_S`, the axis standing where it stood.

    In between the drive was switched off, as the bench does between two procedures, or it holds the command.
    """
    target, motor, time_s = record.motor_target_deg, record.motor_position_deg, record.time_s
    firsts = [0]
    for first in record.starts[1:]:
        gap_s = float(time_s[first] - time_s[first - 1])
        # Records that were put together afterwards are one row apart.
        follows = 1.5 * float(np.median(np.diff(time_s))) < gap_s <= GAP_S
        held = target is not None and abs(float(target[first] - target[first - 1])) <= SAME_DEG
        stood = abs(float(motor[first] - motor[first - 1])) <= STOPPED_DEG
        if not follows or not (held or (stood and just_on(record, first))):
            firsts.append(first)
    return [slice(first, end) for first, end in pairwise([*firsts, len(record)])]


def just_on(record: Record, row: int) -> bool:
    """Whether a row is of a drive that has just been switched on: it has no torque yet.

    Of a record without torque that is taken for granted: power is on only while a procedure runs.
    """
    torque_nm = record.columns.get("motor_torque_nm")
    if torque_nm is None:
        return True
    return bool(abs(torque_nm[row]) <= IDLE * np.max(np.abs(torque_nm)))


# ----------------------------------------------------------------
# Where an axis stands in a recording, by what torque it is held there, and where what was before is unknown.

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
