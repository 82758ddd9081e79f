"""Stretches: pieces of long recordings that a fit replays separately, and their unknown rows. Pure."""

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
"""Length of a stretch: long against its unknown beginning (60 motor degrees, ringing)."""
LONG_S = 30.0
"""Maximum length of a part that is not divided."""
GAP_S = 0.5
"""Maximum gap between two parts that follow each other, as between two tasks of a master."""
SAME_DEG = 1e-6
"""Maximum change of the command that counts as unchanged; motor degrees."""
STOPPED_DEG = 5.0
"""Maximum motor travel from the last row of a procedure to standstill."""
IDLE = 0.002
"""Share of a record's largest torque below which the torque counts as zero."""
RUN_IN_S = 2.0
"""Time after which earlier motion no longer matters: the ringing of a weakly damped load (15 Hz, damping
ratio 0.03) has decayed to a three-hundredth."""


def stretches(part: Record, legs: Sequence[Segment]) -> list[Record]:
    """Divides a part into stretches; each begins with a leg, or within a leg longer than a stretch."""
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
    """Groups parts that follow each other within `GAP_S` with the axis in place; returns their rows.

    In between, the drive is switched off, as on the bench between two procedures, or holds the command.
    """
    target, motor, time_s = record.motor_target_deg, record.motor_position_deg, record.time_s
    firsts = [0]
    for first in record.starts[1:]:
        gap_s = float(time_s[first] - time_s[first - 1])
        # Records that were joined afterwards are one row apart.
        follows = 1.5 * float(np.median(np.diff(time_s))) < gap_s <= GAP_S
        held = target is not None and abs(float(target[first] - target[first - 1])) <= SAME_DEG
        stood = abs(float(motor[first] - motor[first - 1])) <= STOPPED_DEG
        if not follows or not (held or (stood and just_on(record, first))):
            firsts.append(first)
    return [slice(first, end) for first, end in pairwise([*firsts, len(record)])]


def just_on(record: Record, row: int) -> bool:
    """Returns True if the drive has just been switched on at a row, because it has no torque yet.

    Returns True for a record without torque, on the assumption that power is on only during a procedure.
    """
    torque_nm = record.columns.get("motor_torque_nm")
    if torque_nm is None:
        return True
    return bool(abs(torque_nm[row]) <= IDLE * np.max(np.abs(torque_nm)))


# ----------------------------------------------------------------
# Standstill in a recording, the holding torque, and rows with an unknown history.

RINGING_S = 0.25
"""Time after the command's stop in which the torque still shows the motion; later it depends on sticking."""
STANDS_COUNTS = 1.5
"""Distance from the rest position within which the motor is at standstill; counts. Its torque is then
constant or creeps up against friction, depending on a thousandth of a count."""
HELD_S = 0.1
"""Standstill after which the integral alone holds the motor; the loops respond within a few milliseconds."""
LARGEST_UNKNOWN = 0.25
"""Maximum share of a recording that is excluded for its unknown history."""


def stands(moved: NDArray[np.bool_], motor_deg: FloatArray, within_deg: float) -> NDArray[np.bool_]:
    """Returns the mask of rows from which command and motor stay at rest until the command moves again."""
    rest = np.cumsum(moved)
    last = np.searchsorted(rest, rest, side="right") - 1
    away = np.abs(motor_deg - motor_deg[last]) > within_deg
    rows = np.arange(len(rest))
    last_away = np.maximum.accumulate(np.where(away | moved, rows, -1))
    given: NDArray[np.bool_] = last_away < rows
    return given


def held_rows(part: Record, moved: NDArray[np.bool_], still: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Returns the rows that show the holding torque of a motor at rest: every `HELD_S`, and the last.

    The last one alone would not do, because the integral may have moved until the motor broke away.
    """
    rested_s = part.time_s - np.maximum.accumulate(np.where(moved, part.time_s, part.time_s[0]))
    times = np.floor(rested_s / HELD_S)
    told = still & (times >= 1.0)
    told[1:-1] &= (times[1:-1] > times[:-2]) | moved[2:]
    told[-1:] = False
    return np.flatnonzero(told)


def begins_in_motion(part: Record) -> bool:
    """Returns True if the command moves before it has rested for `RINGING_S`."""
    target, time_s = part.motor_target_deg, part.time_s
    assert target is not None  # commands_of has refused it
    return bool(np.any(np.diff(target[time_s - time_s[0] < RINGING_S]) != 0.0))


def unknown_rows(record: Record, count_deg: float) -> NDArray[np.bool_]:
    """Returns the mask of rows in which the load may still ring from an unknown motion.

    This is the motion before a recording that begins (or resumes) in motion, or the cycles before switching
    off after a procedure that ended in motion. ``count_deg`` is one motor count.
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
