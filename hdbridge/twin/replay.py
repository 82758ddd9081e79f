"""Replays a recording's commands through a simulated drive, without bus and master.

The state before a recording is unknown. The replay therefore switches the drive on at its angle zero and
moves to the first command at the axis's limits. It repeats this approach before each part that does not
continue the previous one. If the recording begins with the drive holding the axis, the recorded torque sets
the loops' integrals. Between consecutive parts, the drive is switched off, as on the bench, and the load
continues to ring.

External influences are part of a recording, like its commands. A recorded torque on the load acts on the
simulated load in place of its own weight, and the recorded temperature sets its initial temperature.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from ruckig import InputParameter, Result, Ruckig, Trajectory

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.axis.effects import Channel, FloatArray
from hdbridge.errors import InputError
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.machine import Cycles, Machine
from hdbridge.sim.truth import Truth

# ----------------------------------------------------------------
# Stretches: pieces of long recordings that a fit replays separately.

STRETCH_S = 10.0
"""Length of a stretch, long compared with the part at its start whose history is unknown (60 motor degrees,
ringing)."""
LONG_S = 30.0
"""Maximum length of an undivided part."""
GAP_S = 0.5
"""Maximum gap between two consecutive parts, such as two consecutive tasks of a master."""
SAME_DEG = 1e-6
"""Maximum difference between commands that count as equal; motor degrees."""
STOPPED_DEG = 5.0
"""Maximum motor travel from the last row of a procedure to standstill."""
IDLE = 0.002
"""Fraction of a record's largest torque below which a torque counts as zero."""
RUN_IN_S = 2.0
"""Time after which earlier motion is irrelevant: the ringing of a weakly damped load (15 Hz, damping ratio
0.03) has decayed to a three-hundredth."""


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
    """Groups parts that follow each other within `GAP_S`, between which the axis stays in place; returns the
    rows of each group.

    In between, the drive is switched off, as on the bench between two procedures, or holds the command.
    """
    target, motor, time_s = record.motor_target_deg, record.motor_position_deg, record.time_s
    firsts = [0]
    for first in record.starts[1:]:
        gap_s = float(time_s[first] - time_s[first - 1])
        # Records whose times were shifted when they were joined are one sample apart, whatever the real
        # pause, so they do not count as consecutive.
        follows = 1.5 * float(np.median(np.diff(time_s))) < gap_s <= GAP_S
        held = target is not None and abs(float(target[first] - target[first - 1])) <= SAME_DEG
        stood = abs(float(motor[first] - motor[first - 1])) <= STOPPED_DEG
        if not follows or not (held or (stood and just_on(record, first))):
            firsts.append(first)
    return [slice(first, end) for first, end in pairwise([*firsts, len(record)])]


def just_on(record: Record, row: int) -> bool:
    """Returns True if the drive has just been switched on at a row, as the absence of torque shows.

    Also returns True for a record without torque, on the assumption that power is on only during a procedure.
    """
    torque_nm = record.columns.get("motor_torque_nm")
    if torque_nm is None:
        return True
    return bool(abs(torque_nm[row]) <= IDLE * np.max(np.abs(torque_nm)))


# ----------------------------------------------------------------
# Standstill in a recording, the holding torque, and rows with an unknown history.

RINGING_S = 0.25
"""Time after a stop of the command in which the torque still shows the motion; later, the torque depends on
sticking."""
STANDS_COUNTS = 1.5
"""Distance from the rest position within which the motor is at standstill, counts. Its torque is then
constant, or creeps up against friction by an amount that depends on a thousandth of a count."""
HELD_S = 0.1
"""Standstill after which only the integral holds the motor; the loops respond within a few milliseconds."""
LARGEST_UNKNOWN = 0.25
"""Maximum fraction of a recording that is excluded because of its unknown history."""


class Standing(NamedTuple):
    """Rows of a part at which friction may hold the motor, so that its torque depends on the past."""

    stuck: NDArray[np.bool_]
    """Mask of the rows at which the command has been at rest for `RINGING_S`."""
    still: NDArray[np.bool_]
    """Mask of the rows from which command and motor stay at rest until the next command motion."""
    held: NDArray[np.intp]
    """Rows that show the motor's holding torque: one every `HELD_S`, and the last row at rest. The last row
    alone is insufficient, because the integral may have moved until the motor broke away."""


def standing(part: Record, count_deg: float) -> Standing:
    """Returns the rows of a part at which friction may hold the motor; ``count_deg`` is one motor count."""
    target, motor_deg, time_s = part.motor_target_deg, part.motor_position_deg, part.time_s
    assert target is not None  # commands_of has refused it
    moved = np.diff(target, prepend=target[0]) != 0.0
    before_s = time_s[0] if begins_in_motion(part) else -np.inf
    stuck = time_s - np.maximum.accumulate(np.where(moved, time_s, before_s)) > RINGING_S
    rest, rows = np.cumsum(moved), np.arange(len(moved))
    last = np.searchsorted(rest, rest, side="right") - 1
    away = np.abs(motor_deg - motor_deg[last]) > STANDS_COUNTS * count_deg
    still = np.maximum.accumulate(np.where(away | moved, rows, -1)) < rows
    rested_s = time_s - np.maximum.accumulate(np.where(moved, time_s, time_s[0]))
    times = np.floor(rested_s / HELD_S)
    held = still & (times >= 1.0)
    held[1:-1] &= (times[1:-1] > times[:-2]) | moved[2:]
    held[-1:] = False
    return Standing(stuck, still, np.flatnonzero(held))


def begins_in_motion(part: Record) -> bool:
    """Returns True if the command moves before it has rested for `RINGING_S`."""
    target, time_s = part.motor_target_deg, part.time_s
    assert target is not None  # commands_of has refused it
    return bool(np.any(np.diff(target[time_s - time_s[0] < RINGING_S]) != 0.0))


def unknown_rows(record: Record, count_deg: float) -> NDArray[np.bool_]:
    """Returns the mask of rows in which the load may still ring from an unknown motion.

    The motion is unknown before a group of consecutive parts that begins in motion, and before a part whose
    command differs from that at the end of the previous part. ``count_deg`` is one motor count.
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


# ----------------------------------------------------------------
# Commands of a part of a recording, on the grid of its own cycle, preceded by an approach.

STANDING_S = 0.3
"""Duration of the standstill before the approach, and after it if the recording begins at rest."""
SETTLING_S = 0.75
"""Standstill before a recording that begins with the drive on, long enough for loops with a gain of 8/s. At
25/s, halving it changes no residual by more than 2e-5 of the noise."""
UNEVEN = 0.25
"""Maximum deviation of a sample's time from the grid, cycles."""
MOSTLY = 0.95
"""Minimum fraction of samples within `UNEVEN`; a few delayed time stamps do not imply
delayed commands."""
REST_S = 0.1
"""Minimum time for which the command is at rest between two legs; used if the recording does not mark its
legs."""
RINGS_S = 1.0
"""Time from the end of a leg's motion to the end of the leg; a longer standstill is not part of any leg."""
LEAST_LEG_S = 0.4
"""Minimum length of a leg, if the recording does not mark its legs: an acceleration and the ringing of a load
at 15 Hz."""
SIGN_SHARE = 0.2
"""Minimum torque against the motion, as a fraction of the mean absolute torque, for the sign to count as
wrong."""
TORQUE_MARGIN = 1.5
"""Ratio of a torque to the axis's limit above which its unit counts as wrong."""
AHEAD_CYCLES = 0.5
"""Lead of the motor over its command, in cycles, above which the command counts as logged with a delay."""
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
    torque_on_load_nm: FloatArray | None = None
    """Recorded torque on the load by cycle (its first value during the approach); None if not recorded."""
    off: tuple[slice, ...] = ()
    """Cycles in which the drive is switched off."""
    held: tuple[tuple[int, float], ...] = ()
    """Cycles before which the loops' integrals are set to a holding torque, with that torque in Nm."""
    start_c: float | None = None
    """Initial temperature of the axis; None for the value of the truth."""


def commands_of(part: Record, axis: AxisConfig, truth: Truth) -> Commands:
    """Returns the commands of a part on the grid of its own cycle; InputError without usable commands."""
    target = part.motor_target_deg
    name = f"{part.source}: " if part.source else ""
    if target is None or np.isnan(target).any():
        raise InputError(
            f"{name}no commanded motor angle (motor_target_deg); expected one in each row, because a replay "
            "sends the drive's commands to a simulated drive"
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
        # After its last row, a procedure continues to slow down, but not beyond the start of the next
        # procedure.
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
    torque_on_load_nm = part.columns.get(Channel.LOAD_TORQUE.value)
    if torque_on_load_nm is not None:
        torque_on_load_nm = np.concatenate(
            [np.full(len(approach), torque_on_load_nm[0]), np.interp(grid, cycles, torque_on_load_nm)]
        )
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
    held: list[tuple[int, float]] = []
    if torque_nm is not None:
        held += [(lead, float(torque_nm[0]))] if holds else []
        rows = standing(part, 360.0 / axis.motor_encoder.counts_per_turn).held
        known = lead + 1 + np.floor(cycles[rows]).astype(np.intp)
        held += zip(known.tolist(), torque_nm[rows].tolist(), strict=True)
    warmth_c = part.columns.get(Channel.TEMPERATURE.value)
    start_c = None if warmth_c is None else float(warmth_c[0])
    return Commands(
        (*map(float, approach), *recorded),
        lead,
        cycles,
        time_s,
        cycle_s,
        torque_on_load_nm,
        tuple(off),
        tuple(held),
        start_c,
    )


def cycle_of(part: Record, axis: AxisConfig) -> float:
    """Returns a record's cycle time, s: the axis's if both agree, else rounded to a value of 60C2h."""
    own_ms = 1e3 * float(np.median(np.diff(part.time_s)))
    if not own_ms > 0.0:
        raise InputError(
            f"{part.source or 'the record'}: its time does not increase; expected increasing times"
        )
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
            f"no move from the start of the simulated drive, {start_deg:g} deg, to that of the recording, "
            f"{demand_deg[0] / ratio:g} deg, is within the limits of {axis.path}"
        )
    moving = math.ceil(trajectory.duration / cycle_s)
    standing = math.ceil(standing_s / cycle_s)
    per_load_deg = axis.motor_encoder.counts(1.0) * ratio
    # Sampled backwards from its end, so that the last command before the recording has the recording's speed.
    times = [max(trajectory.duration - (moving - k) * cycle_s, 0.0) for k in range(moving)]
    way = [round(per_load_deg * float(trajectory.at_time(each)[0][0])) for each in times]
    here = round(per_load_deg * start_deg)
    rest = [way[-1] if way else here] if speed else [round(axis.motor_encoder.counts(1.0) * demand_deg[0])]
    return [here] * math.ceil(STANDING_S / cycle_s) + way + (rest * standing if not speed else [])


def counted_cycles(time_s: FloatArray, cycle_s: float) -> FloatArray:
    """Returns the cycle number of each row, from zero; fractional if the rows do not follow the cycle.

    Rows are counted, because a delayed time stamp does not imply a delayed command. Gaps count as whole
    cycles.
    """
    cycles: FloatArray = (time_s - time_s[0]) / cycle_s
    counted: FloatArray = np.concatenate([[0.0], np.cumsum(np.maximum(np.round(np.diff(cycles)), 1.0))])
    off = np.abs(cycles - counted)
    if np.mean(off <= UNEVEN) >= MOSTLY and np.max(off) < 1.0:
        return counted
    return cycles


def legs_of(recording: Recording) -> tuple[Segment, ...]:
    """Returns the legs that the recording marks; without them, its motions between rests and reversals."""
    if recording.segments:
        return recording.segments
    return tuple(leg for part in recording.record.parts() for leg in _legs_of_command(part))


def _legs_of_command(part: Record) -> Iterator[Segment]:
    """Yields the legs of a part, as derived from its command; the whole part if it has no command."""
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
    """Returns suspected errors of a recording's torque and command, each in a sentence with a remedy."""
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


# ----------------------------------------------------------------
# Replays.


def replay(recording: Recording, axis: AxisConfig, truth: Truth, seed: int = 0) -> Record:
    """Replays the recording's commands, and returns the simulated drive's record with its rows and times.

    The numbers are those that a bench reads over frames; supervision and speed limits are not applied.
    InputError if the recording has no command.
    """
    records = []
    parts = [recording.record.rows(each.start, each.stop) for each in continuous(recording.record)]
    played = [commands_of(part, axis, truth) for part in parts]
    for part, commands, signals in zip(parts, played, run(played, axis, truth, seed), strict=True):
        for channel in (Channel.TEMPERATURE, Channel.LOAD_TORQUE):
            if channel.value not in part.columns and all(BY_KEY[key] is not channel for key in axis.channels):
                del signals[channel.value]
        columns = {"time_s": commands.time_s, "motor_target_deg": demand_deg(commands, axis), **signals}
        records.append(Record(columns, starts=part.starts))
    return records[0] if len(records) == 1 else concatenate(records)


def run(
    parts: Iterable[Commands], axis: AxisConfig, truth: Truth, seed: int = 0, *, smooth: bool = False
) -> Iterator[dict[str, FloatArray]]:
    """Runs each part's commands through a machine alone; yields a record's columns, unrounded if
    ``smooth``.
    """
    fresh: dict[tuple[float | None, bool], Machine] = {}
    for commands in parts:
        start = commands.start_c, commands.torque_on_load_nm is not None
        if start not in fresh:
            fresh[start] = _machine(commands, axis, truth, seed)
        yield _columns(commands, axis, fresh[start].copy(), smooth=smooth)


def _machine(commands: Commands, axis: AxisConfig, truth: Truth, seed: int) -> Machine:
    """Returns the machine, just switched on, with the temperature and the load of these commands."""
    if commands.start_c is not None:
        heat = truth.temperature.model_copy(update={"start_c": commands.start_c})
        truth = truth.model_copy(update={"temperature": heat})
    mass, loaded = truth.load_.gravity, commands.torque_on_load_nm is not None
    if mass and loaded:
        # The recorded torque contains the weight, so the hanging mass contributes only its inertia.
        upright = mass.model_copy(update={"tilt_deg": 90.0})
        truth = truth.model_copy(update={"load_": truth.load_.model_copy(update={"gravity": upright})})
    machine = Machine(truth, seed, may_compile=True, loaded=loaded)
    # the torque limit that the master sets in the drive
    machine.torque_limit_permille = 10.0 * axis.limits.torque_percent
    return machine


def _columns(
    commands: Commands, axis: AxisConfig, machine: Machine, *, smooth: bool
) -> dict[str, FloatArray]:
    """Returns a record's columns from a run of the machine."""
    outer_nm, load_truth = np.zeros(len(commands.counts)), machine.truth.load_
    if commands.torque_on_load_nm is not None:
        outer_nm = load_truth.torque_sense * commands.torque_on_load_nm
    permille_nm = axis.motor_encoder.direction * axis.drive.rated_torque_nm / 1000.0
    sense = float(axis.motor_encoder.direction)
    substeps = _substeps(len(commands.counts), commands.cycle_s, machine.dt_s)
    measured = _followed(machine, [commands.counts[0], *commands.counts], substeps, commands, outer_nm)
    motor, load = measured.motor_reading, measured.load_reading
    if not smooth:
        motor, load = np.floor(motor + 0.5), np.floor(load + 0.5)
    torque = sense * measured.torque_nm if smooth else measured.torque_permille * permille_nm
    encoder = axis.motor_encoder
    motor = encoder.direction * motor * 360.0 / encoder.counts_per_turn
    load = axis.load_encoder.direction * load * 360.0 / load_truth.encoder.counts_per_turn
    columns = {
        "motor_position_deg": motor,
        "load_position_deg": load,
        "motor_torque_nm": torque,
        Channel.TEMPERATURE.value: measured.temperature_c,
        Channel.LOAD_TORQUE.value: measured.load_torque_nm,
    }
    cycles = np.arange(len(motor))
    return {name: np.interp(commands.row_cycles, cycles, each) for name, each in columns.items()}


@cache
def _substeps(cycles: int, cycle_s: float, dt_s: float) -> tuple[int, ...]:
    """Returns the number of substeps of each cycle; remainders are carried to the next cycle."""
    found, owed_s = [], 0.0
    for _ in range(cycles):
        owed_s += cycle_s
        found.append(int(owed_s / dt_s + 1e-6))
        owed_s -= found[-1] * dt_s
    return tuple(found)


def _followed(
    machine: Machine,
    demand: list[float],
    substeps: Sequence[int],
    commands: Commands,
    outer_nm: FloatArray,
) -> Cycles:
    """Runs the machine through all cycles; returns those after the approach."""
    pieces: list[Cycles] = []
    held_nm = np.full(len(substeps), np.nan)
    for cycle, torque_nm in commands.held:
        held_nm[cycle : cycle + 1] = torque_nm
    done = 0
    for off in (*commands.off, slice(len(substeps), len(substeps))):
        on = slice(done, off.start)
        pieces.append(
            machine.follow_all(demand[done : off.start + 1], substeps[on], outer_nm[on], held_nm[on])
        )
        pieces.append(_coasted(machine, substeps[off], outer_nm[off]))
        demand[off.stop] = demand[min(off.stop + 1, len(demand) - 1)]  # the drive is on again
        done = off.stop
    whole = Cycles(*(np.concatenate(each) for each in zip(*pieces, strict=True)))
    return Cycles(*(each[commands.lead :] for each in whole))


def _coasted(machine: Machine, substeps: Sequence[int], outer_nm: FloatArray) -> Cycles:
    """Runs the machine through cycles with the drive switched off; the brake closes at rest."""
    rows = []
    for count, outer in zip(substeps, outer_nm.tolist(), strict=True):
        at_rest = abs(machine.velocity_counts_s) * count * machine.dt_s < 1.0
        machine.coast(count, at_rest, outer)
        rows.append([getattr(machine, name) for name in Cycles._fields])
    return Cycles(*np.array(rows, dtype=np.float64).reshape(-1, len(Cycles._fields)).T)


def demand_deg(commands: Commands, axis: AxisConfig) -> FloatArray:
    """Returns the commanded motor angle at each row; degrees."""
    counts = np.asarray(commands.counts[commands.lead :], dtype=np.float64)
    encoder = axis.motor_encoder
    deg = encoder.direction * counts * 360.0 / encoder.counts_per_turn
    return np.interp(commands.row_cycles, np.arange(len(counts)), deg)
