"""What a fit replays in one go: stretches of long parts, with what came before them. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hdbridge.records.record import Record
from hdbridge.records.recording import Segment

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
