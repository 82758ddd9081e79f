"""Replays a recording's commands through a simulated drive, over real frames or directly.

Both give the same numbers. The frames show what a master sees of a twin; direct replays are fast enough for
the hundreds that a fit needs. Over frames the drive knows nothing else: neither an external torque on the
load nor the torque that held the axis before.

External influences are part of a recording like its commands: a recorded torque on the load acts on the
simulated load in place of its own weight, and the recorded temperature sets its initial temperature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.channels import BY_KEY
from hdbridge.control.bench import Bench
from hdbridge.drive.drive import Drive
from hdbridge.effects import Channel, FloatArray
from hdbridge.procedures.moves import AxisView, MotionLimits, Path, Sample, Steps
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.machine import Cycles, Machine
from hdbridge.sim.truth import Truth
from hdbridge.twin.commands import OFF_AFTER, ON_BEFORE, Commands, commands_of
from hdbridge.twin.stretches import continuous

LATENCY_CYCLES = 4
"""Maximum delay until a command appears as the demand; cycles."""


@dataclass(frozen=True, eq=False)
class Traces:
    """Signals of a replay at each row of the recording; unrounded for a smooth replay."""

    motor_deg: FloatArray
    load_deg: FloatArray
    torque_nm: FloatArray
    """Torque of the motor, positive forward."""
    temperature_c: FloatArray
    load_torque_nm: FloatArray


def replay(recording: Recording, axis: AxisConfig, truth: Truth, seed: int = 0) -> Record:
    """Replays the recording's commands over real frames, and returns the simulated drive's record.

    It has the rows and times of the recording. InputError if the recording has no command or exceeds the
    limits of the axis file; SafetyStop if the simulated drive's following error exceeds the axis file's.
    """
    records = []
    for rows in continuous(recording.record):
        part = recording.record.rows(rows.start, rows.stop)
        commands = commands_of(part, axis, truth)
        bench_axis = at_cycle(axis, commands.cycle_s)
        with (
            simulated_bench(
                as_warm(truth, commands),
                axis.eds_path,
                axis.drive.node_id,
                seed,
                load_object=axis.load_encoder.source.address,
            ) as (bus, clock, _),
            Drive(bus, bench_axis, clock) as drive,
        ):
            drive.boot()
            records += _benched(Bench(drive), commands, axis)
    return records[0] if len(records) == 1 else concatenate(records)


def replay_directly(recording: Recording, axis: AxisConfig, truth: Truth, seed: int = 0) -> Record:
    """Replays as `replay` does, without bus and master; the load encoder's noise is another draw.

    The drive's supervision and speed limits are not applied.
    """
    records = []
    for rows in continuous(recording.record):
        part = recording.record.rows(rows.start, rows.stop)
        commands = commands_of(part, axis, truth)
        traces = run(commands, axis, truth, seed)
        target = _between(_degrees(commands.counts[commands.lead :], axis), commands.row_cycles)
        columns = {
            "time_s": commands.time_s,
            "motor_target_deg": target,
            "motor_position_deg": traces.motor_deg,
            "load_position_deg": traces.load_deg,
            "motor_torque_nm": traces.torque_nm,
        }
        known = {
            Channel.TEMPERATURE: traces.temperature_c,
            Channel.LOAD_TORQUE: traces.load_torque_nm,
        }
        for channel, column in known.items():
            if channel.value in part.columns or any(BY_KEY[key] is channel for key in axis.channels):
                columns[channel.value] = column
        records.append(Record(columns, starts=part.starts))
    return records[0] if len(records) == 1 else concatenate(records)


def run(
    commands: Commands,
    axis: AxisConfig,
    truth: Truth,
    seed: int = 0,
    *,
    smooth: bool = False,
) -> Traces:
    """Runs the commands through the machine alone; ``smooth`` returns unrounded signals."""
    truth, outer_nm = as_warm(truth, commands), np.zeros(len(commands.counts))
    if commands.told_nm is not None:
        truth, outer_nm = _weightless(truth), truth.load_.torque_sense * commands.told_nm
    machine = Machine(truth, seed, may_compile=True, loaded=commands.told_nm is not None)
    machine.torque_limit_permille = 10.0 * axis.limits.torque_percent  # as the master tells the drive
    permille_nm = axis.motor_encoder.direction * axis.drive.rated_torque_nm / 1000.0
    sense = float(axis.motor_encoder.direction)
    substeps = _substeps(len(commands.counts), commands.cycle_s, machine.dt_s)
    told = _told(machine, [commands.counts[0], *commands.counts], substeps, commands, outer_nm)
    motor, load = told.motor_reading, told.load_reading
    if not smooth:
        motor, load = np.floor(motor + 0.5), np.floor(load + 0.5)
    torque = sense * told.torque_nm if smooth else told.torque_permille * permille_nm
    warmth, outer = told.temperature_c, told.load_torque_nm
    encoder = axis.motor_encoder
    motor = encoder.direction * motor * 360.0 / encoder.counts_per_turn
    load = axis.load_encoder.direction * load * 360.0 / truth.load_.encoder.counts_per_turn
    place = commands.row_cycles
    return Traces(*(_between(each, place) for each in (motor, load, torque, warmth, outer)))


@cache
def _substeps(cycles: int, cycle_s: float, dt_s: float) -> tuple[int, ...]:
    """Returns the number of substeps of each cycle; the remainder of one is added to the next."""
    found, owed_s = [], 0.0
    for _ in range(cycles):
        owed_s += cycle_s
        found.append(int(owed_s / dt_s + 1e-6))
        owed_s -= found[-1] * dt_s
    return tuple(found)


def _benched(bench: Bench, commands: Commands, axis: AxisConfig) -> list[Record]:
    """Runs the commands on the bench; returns one record for each period in which the drive is on."""
    load_deg = _degrees(commands.counts, axis) / axis.gear.ratio
    starts = [0, *(each.stop + ON_BEFORE for each in commands.off)]
    ends = [*(each.start for each in commands.off), len(load_deg)]
    found = []
    for start, end in zip(starts, ends, strict=True):
        # In the first cycles after switching on, the drive has no commands.
        path = load_deg[start + (OFF_AFTER if start else 0) : end]
        if end == len(load_deg):
            path = np.append(path, np.full(LATENCY_CYCLES, load_deg[-1]))
        measured = bench.run(_Again(path, commands.cycle_s)).record
        if end > commands.lead:
            found.append(_at_rows(measured, slice(start, end), commands, axis))
    return found


def _told(
    machine: Machine,
    demand: list[float],
    substeps: Sequence[int],
    commands: Commands,
    outer_nm: FloatArray,
) -> Cycles:
    """Runs the machine through all cycles; returns those after the approach."""
    told: list[Cycles] = []
    held_nm = np.full(len(substeps), np.nan)
    for cycle, torque_nm in commands.held:
        held_nm[cycle : cycle + 1] = torque_nm
    done = 0
    for off in (*commands.off, slice(len(substeps), len(substeps))):
        on = slice(done, off.start)
        told.append(machine.follow_all(demand[done : off.start + 1], substeps[on], outer_nm[on], held_nm[on]))
        told.append(_coasted(machine, substeps[off], outer_nm[off]))
        demand[off.stop] = demand[min(off.stop + 1, len(demand) - 1)]  # where the drive is on again
        done = off.stop
    whole = Cycles(*(np.concatenate(each) for each in zip(*told, strict=True)))
    return Cycles(*(each[commands.lead :] for each in whole))


def _coasted(machine: Machine, substeps: Sequence[int], outer_nm: FloatArray) -> Cycles:
    """Runs the machine through cycles with the drive switched off; the brake closes at rest."""
    rows = []
    for count, outer in zip(substeps, outer_nm.tolist(), strict=True):
        at_rest = abs(machine.velocity_counts_s) * count * machine.dt_s < 1.0
        machine.coast(count, at_rest, outer)
        rows.append([getattr(machine, name) for name in Cycles._fields])
    return Cycles(*np.array(rows, dtype=np.float64).reshape(-1, len(Cycles._fields)).T)


def as_warm(truth: Truth, commands: Commands) -> Truth:
    """Returns the truth with the initial temperature of these commands, if they have one."""
    if commands.start_c is None:
        return truth
    heat = truth.temperature.model_copy(update={"start_c": commands.start_c})
    return truth.model_copy(update={"temperature": heat})


def _weightless(truth: Truth) -> Truth:
    """Returns the truth with the inertia of the hanging mass but without its weight."""
    mass = truth.load_.gravity
    if mass is None:
        return truth
    upright = truth.load_.model_copy(update={"gravity": mass.model_copy(update={"tilt_deg": 90.0})})
    return truth.model_copy(update={"load_": upright})


def at_cycle(axis: AxisConfig, cycle_s: float) -> AxisConfig:
    """Returns the axis with another SYNC period."""
    if cycle_s == axis.drive.cycle_s:
        return axis
    cycle_ms = round(1e3 * cycle_s, 1)
    heartbeat_ms = max(axis.drive.heartbeat_ms, math.ceil(2 * cycle_ms))
    drive = axis.drive.model_copy(update={"cycle_ms": cycle_ms, "heartbeat_ms": heartbeat_ms})
    return axis.model_copy(update={"drive": drive})


class _Again:
    """Procedure that repeats recorded commands, one for each cycle."""

    def __init__(self, load_deg: FloatArray, cycle_s: float) -> None:
        self._leg = _Leg(load_deg, cycle_s, "replay")

    def moves(self, axis: AxisView) -> Steps[None]:
        """Yields the commands as one leg."""
        yield self._leg


class _Leg:
    """Leg of recorded commands, one for each cycle."""

    def __init__(self, load_deg: FloatArray, cycle_s: float, kind: str) -> None:
        self.kind = kind
        self._load_deg: list[float] = load_deg.tolist()
        self._cycle_s = cycle_s

    def path(self, start_deg: float, limits: MotionLimits) -> Path:
        """Returns the recorded commands as the path, without applying the limits."""
        points, cycle_s, last = self._load_deg, self._cycle_s, len(self._load_deg) - 1

        def at(time_s: float) -> float:
            return points[min(round(time_s / cycle_s), last)]

        return Path((last - 0.5) * cycle_s, at, min(points), max(points))

    def ended(self, samples: Sequence[Sample]) -> bool:
        """Returns True: the leg ends with its last command."""
        return True


def _at_rows(measured: Record, on: slice, commands: Commands, axis: AxisConfig) -> Record:
    """Interpolates a bench run of some cycles at the rows of the recording in these cycles."""
    cycles = commands.row_cycles + commands.lead
    inside = (cycles >= on.start) & (cycles < on.stop)
    first = max(on.start, commands.lead)
    wanted = np.array(commands.counts[first : math.ceil(cycles[inside][-1]) + 1], dtype=np.float64)
    target = measured.motor_target_deg
    assert target is not None  # the bench records it
    demand = np.round(axis.motor_encoder.counts(1.0) * target)[first - on.start :]
    off = [
        float(np.sum(np.abs(demand[late:][: len(wanted)] - wanted)))
        for late in range(min(LATENCY_CYCLES, len(demand) - len(wanted)) + 1)
    ]
    begin = first - on.start + int(np.argmin(off))
    columns = {
        name: _between(column[begin:][: len(wanted)], cycles[inside] - first)
        for name, column in measured.columns.items()
    }
    return Record(columns | {"time_s": commands.time_s[inside]})


def _between(column: FloatArray, cycles: FloatArray) -> FloatArray:
    """Interpolates a column, one value for each cycle, at fractional cycles."""
    return np.interp(cycles, np.arange(len(column)), column)


def _degrees(counts: Sequence[float], axis: AxisConfig) -> FloatArray:
    encoder = axis.motor_encoder
    return encoder.direction * np.asarray(counts, dtype=np.float64) * 360.0 / encoder.counts_per_turn
