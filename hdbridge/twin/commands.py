"""Commands of a part of a recording, on the grid of its own cycle, preceded by an approach.

The state before a recording is unknown, so the replay switches the drive on at its angle zero and moves to
the first command at the axis's limits; so does each part that does not follow another one. If the recording
begins with the drive holding the axis, its torque sets the integrals of the loops; a recorded temperature
sets the axis's.
Between parts that follow each other the drive is switched off, as on the bench, and the load continues to
ring.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from ruckig import InputParameter, Result, Ruckig, Trajectory

from hdbridge.axis import AxisConfig
from hdbridge.effects import Channel, FloatArray
from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.truth import Truth
from hdbridge.twin.stretches import just_on

STANDING_S = 0.3
"""Standstill between the approach and a recording that begins at rest."""
SETTLING_S = 1.5
"""The same if the recording begins with the drive on: long enough for loops with a gain of 4/s."""
UNEVEN = 0.25
"""Maximum deviation of a sample's time from the grid; cycles."""
MOSTLY = 0.95
"""Minimum share of samples within `UNEVEN`: a few late stamps do not mean late commands."""
REST_S = 0.1
"""Minimum rest of the command between two legs if the recording names no legs."""
RINGS_S = 1.0
"""Time from the end of a leg's motion to the end of the leg; a longer standstill belongs to no leg."""
LEAST_LEG_S = 0.4
"""Minimum length of such a leg: an acceleration and the ringing of a load at 15 Hz."""
SIGN_SHARE = 0.2
"""Share of the mean torque that must oppose the motion for the sign to be wrong."""
TORQUE_MARGIN = 1.5
"""Ratio of a torque to the axis's limit above which its unit must be wrong."""
AHEAD_CYCLES = 0.5
"""Lead of the motor over its command above which the command was logged late; cycles."""
MOVING_DEG_S = 5.0
"""Motor speed above which the direction of friction is certain."""
OFF_AFTER, ON_BEFORE = 2, 1
"""Cycles between the last row of a procedure and switching off on the bench, and between switching on and the
first row of the next procedure."""


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of one part of a recording by cycle, preceded by the approach."""

    counts: tuple[float, ...]
    """Motor demand at the end of each cycle, from switching on; counts."""
    lead: int
    """Number of cycles of the approach."""
    row_cycles: FloatArray
    """Time of each row since the end of the approach, in cycles (fractional if uneven)."""
    time_s: FloatArray
    """Time of each row."""
    cycle_s: float
    told_nm: FloatArray | None = None
    """Recorded torque on the load by cycle (during the approach its first value); None if not recorded."""
    off: tuple[slice, ...] = ()
    """Cycles in which the drive is switched off."""
    held: tuple[tuple[int, float], ...] = ()
    """Cycles before which the loops' integrals are set to a holding torque, and that torque in Nm."""
    start_c: float | None = None
    """Initial temperature of the axis; None: the truth's own."""


def commands_of(part: Record, axis: AxisConfig, truth: Truth) -> Commands:
    """Returns the commands of a part on the grid of its own cycle; InputError without usable commands."""
    target = part.motor_target_deg
    name = f"{part.source}: " if part.source else ""
    if target is None or np.isnan(target).any():
        raise InputError(
            f"{name}no commanded motor angle (motor_target_deg); expected one in each row: what the drive "
            "was told is what a simulated one is told again"
        )
    if len(part) < 2:
        raise InputError(f"{name}{len(part)} rows; expected at least two in each part of a recording")
    time_s = part.time_s
    cycle_s = cycle_of(part, axis)
    cycles = counted_cycles(time_s, cycle_s)
    grid = np.arange(math.floor(cycles[-1]) + 1.0 + (cycles[-1] % 1.0 > 0.0))
    gaps = [first for first in part.starts[1:] if just_on(part, first)]
    nodes, values = cycles, target
    for first in gaps:
        # After its last row a procedure continues to slow down, but not beyond the start of the next one.
        later = np.arange(1.0, OFF_AFTER + 1.0)
        earlier, before, last, rest = target[[max(first - 3, 0), first - 2, first - 1, first]]
        slowing = last - 2.0 * before + earlier
        goes_on = last + later * (last - before) + 0.5 * later * (later + 1.0) * slowing
        nodes = np.append(nodes, cycles[first - 1] + later)
        values = np.append(values, np.clip(goes_on, min(last, rest), max(last, rest)))
    order = np.argsort(nodes, kind="stable")
    demand_deg = np.interp(grid, nodes[order], values[order])
    if grid[-1] > cycles[-1]:
        # Extrapolate to the end of the cycle that the last row lies in.
        speed = (target[-1] - target[-2]) / (cycles[-1] - cycles[-2])
        demand_deg[-1] = target[-1] + speed * (grid[-1] - cycles[-1])
    recorded = np.round(axis.motor_encoder.counts(1.0) * demand_deg).tolist()
    holds = target[0] == target[1] and not just_on(part, 0)
    approach = _approach(truth, axis, demand_deg, cycle_s, SETTLING_S if holds else STANDING_S)
    told_nm = part.columns.get(Channel.LOAD_TORQUE.value)
    if told_nm is not None:
        told_nm = np.concatenate([np.full(len(approach), told_nm[0]), np.interp(grid, cycles, told_nm)])
    lead = len(approach)
    off = [
        slice(
            lead + math.floor(cycles[first - 1]) + 1 + OFF_AFTER, lead + math.floor(cycles[first]) - ON_BEFORE
        )
        for first in gaps
    ]
    if target[0] == target[1] and just_on(part, 0):
        off.insert(0, slice(lead - math.ceil(0.5 * STANDING_S / cycle_s), lead - ON_BEFORE))
    off = [each for each in off if each.stop > each.start]
    torque_nm = part.columns.get(Channel.MOTOR_TORQUE.value)
    held = () if torque_nm is None or not holds else ((lead, float(torque_nm[0])),)
    warmth_c = part.columns.get(Channel.TEMPERATURE.value)
    start_c = None if warmth_c is None else float(warmth_c[0])
    return Commands(
        (*map(float, approach), *recorded), lead, cycles, time_s, cycle_s, told_nm, tuple(off), held, start_c
    )


def cycle_of(part: Record, axis: AxisConfig) -> float:
    """Returns a record's cycle in seconds, as 60C2h can express it, or the axis's if they agree."""
    own_ms = 1e3 * float(np.median(np.diff(part.time_s)))
    if not own_ms > 0.0:
        raise InputError(f"{part.source or 'the record'}: its time stands still; expected rising times")
    if abs(own_ms / axis.drive.cycle_ms - 1.0) < 0.02:
        return axis.drive.cycle_s
    rounded = round(own_ms, 1) if own_ms < 25.5 else float(round(own_ms))
    return min(max(rounded, 0.5), 255.0) / 1e3


def _approach(
    truth: Truth, axis: AxisConfig, demand_deg: FloatArray, cycle_s: float, standing_s: float
) -> list[int]:
    """Plans the motion from the switch-on position to the first command and its speed, at the limits."""
    ratio, limits = axis.gear.ratio, axis.limits
    start_counts = truth.motor.encoder.zero_counts
    start_deg = axis.motor_encoder.degrees(start_counts) / ratio
    steps = np.diff(demand_deg[:4]) / ratio / cycle_s
    speed = float(np.median(steps)) if len(steps) and np.all(steps != 0.0) else 0.0
    demand = InputParameter(1)
    demand.current_position = [start_deg]
    demand.target_position = [float(demand_deg[0]) / ratio]
    demand.target_velocity = [speed]
    demand.max_velocity = [max(limits.velocity_deg_s, 1.01 * abs(speed))]
    demand.max_acceleration = [limits.acceleration_deg_s2]
    demand.max_jerk = [limits.jerk_deg_s3]
    trajectory = Trajectory(1)
    if Ruckig(1).calculate(demand, trajectory) not in {Result.Working, Result.Finished}:
        raise InputError(
            f"no way from where the simulated drive is switched on, {start_deg:g} deg, to where the "
            f"recording begins, {demand_deg[0] / ratio:g} deg, within the limits of {axis.path}"
        )
    moving = math.ceil(trajectory.duration / cycle_s)
    standing = math.ceil(standing_s / cycle_s)
    per_load_deg = axis.motor_encoder.counts(1.0) * ratio
    # Backwards from its end, so that the last command before the recording has the recording's speed.
    times = [max(trajectory.duration - (moving - k) * cycle_s, 0.0) for k in range(moving)]
    way = [round(per_load_deg * float(trajectory.at_time(each)[0][0])) for each in times]
    here = round(per_load_deg * start_deg)
    rest = [way[-1] if way else here] if speed else [round(axis.motor_encoder.counts(1.0) * demand_deg[0])]
    return [here] * standing + way + (rest * standing if not speed else [])


def counted_cycles(time_s: FloatArray, cycle_s: float) -> FloatArray:
    """Returns the cycle number of each row, from zero; fractional if the rows do not follow the cycle.

    Rows are counted, because a late stamp does not mean a late command. Gaps count as whole cycles.
    """
    cycles: FloatArray = (time_s - time_s[0]) / cycle_s
    counted: FloatArray = np.concatenate([[0.0], np.cumsum(np.maximum(np.round(np.diff(cycles)), 1.0))])
    off = np.abs(cycles - counted)
    if np.mean(off <= UNEVEN) >= MOSTLY and np.max(off) < 1.0:
        return counted
    return cycles


def legs_of(recording: Recording) -> tuple[Segment, ...]:
    """Returns the recording's legs; if it names none, its motions between rests and reversals."""
    if recording.segments:
        return recording.segments
    return tuple(leg for part in recording.record.parts() for leg in _legs_of_command(part))


def _legs_of_command(part: Record) -> Iterator[Segment]:
    """Yields the legs of a part by its command, or the whole part without one."""
    time_s, target = part.time_s, part.motor_target_deg
    cuts, moved_s = [float(time_s[0])], [float(time_s[-1])]
    if target is not None and len(part) > 2:
        way = np.sign(np.diff(target))
        moving = np.flatnonzero(way)
        for before, after in pairwise(moving.tolist()):
            rests = time_s[after] - time_s[before + 1] >= REST_S
            if (rests or way[before] != way[after]) and time_s[after] - cuts[-1] >= LEAST_LEG_S:
                cuts.append(float(time_s[after]))
                moved_s.insert(-1, float(time_s[before + 1]))
        if len(moving):
            moved_s[-1] = float(time_s[moving[-1] + 1])
    ends = [*cuts[1:], float(time_s[-1])]
    for start_s, end_s, last_s in zip(cuts, ends, moved_s, strict=True):
        yield Segment(kind="motion", start_s=start_s, end_s=max(start_s, min(end_s, last_s + RINGS_S)))


def doubts(recording: Recording, axis: AxisConfig) -> tuple[str, ...]:
    """Returns suspected faults of a recording's torque and command, each in a sentence with a remedy."""
    lags, forward, backward = [], [], []
    for part in recording.record.parts():
        target, torque_nm = part.motor_target_deg, part.columns.get(Channel.MOTOR_TORQUE.value)
        if target is None or len(part) < 3:
            continue
        speed = np.gradient(target, part.time_s)
        moving = np.abs(speed) > MOVING_DEG_S
        lags += [np.stack([target - part.motor_position_deg, speed])[:, moving]]
        if torque_nm is not None:
            forward.append(torque_nm[moving & (speed > 0.0)])
            backward.append(torque_nm[moving & (speed < 0.0)])
    found = []
    if lags and (moved := np.concatenate(lags, axis=1)).size:
        ahead_s = -float(moved[0] @ moved[1]) / float(moved[1] @ moved[1])
        cycle_s = float(np.median(np.diff(recording.record.time_s)))
        if ahead_s > AHEAD_CYCLES * cycle_s:
            found.append(
                f"the motor leads its command by {ahead_s / cycle_s:.1f} cycles; expected it behind: "
                "the command was logged late, move motor_target_deg earlier by as many rows"
            )
    if forward and sum(map(len, forward)) and sum(map(len, backward)):
        ahead, back = np.concatenate(forward), np.concatenate(backward)
        torques = np.abs(np.concatenate([ahead, back]))
        most_nm = 0.01 * axis.limits.torque_percent * axis.drive.rated_torque_nm
        if float(np.mean(ahead) - np.mean(back)) < -2.0 * SIGN_SHARE * float(np.mean(torques)):
            found.append("motor_torque_nm opposes the motion; expected it to drive it: change its sign")
        if float(np.max(torques)) > TORQUE_MARGIN * most_nm:
            found.append(
                f"motor_torque_nm is up to {np.max(torques):.3g} Nm; expected at most {most_nm:.3g} "
                "(limits.torque_percent of drive.rated_torque_nm): convert it to Nm if it is in per cent"
            )
    return tuple(found)
