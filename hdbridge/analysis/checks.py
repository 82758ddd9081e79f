"""Refuses records that no axis can have made, and says how to read them right."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hdbridge.analysis.cuts import SLOWEST_S, observed
from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.records.columns import CHANNELS, UNITS, Unit, option
from hdbridge.records.record import REQUIRED, Record
from hdbridge.records.wraps import Wraps, count_of, find_wraps, period_in, unwrapped
from hdbridge.units import DEG_PER_TURN

LEAST_WHOLE = 10.0
"""Travel beyond which whole numbers are not a chance."""
SLOWEST_DEG_S = 6.0
"""A motor that is recorded reaches one turn per minute."""
MOST_COUNTS = 2**32
"""Counts of the largest counter that wraps within a record."""
TURNS_SEEN = 4.0
"""Minimum motor turns in which an error is seen to repeat."""
PLACES = 8
"""Places within a motor turn that are counted as different."""
REPEATS_SHARE = 0.5
"""Minimum share of the error's variance that repeats with each turn of the motor."""
FOLLOWS_SHARE = 0.1
"""Maximum share of its distance from the motor that a command keeps when it is unwrapped."""


def check_records(records: Mapping[Path, Record], ratio: float) -> None:
    """Refuse (InputError) records that no axis of this ratio can have made, or that say nothing of one.

    Time has to pass, angles have to be multi-turn, units and ratio have to be right, and in one of the
    records the motor has to move. Each record is named by its path.
    """
    for path, record in records.items():
        if len(record) > 1 and float(np.ptp(record.time_s)) == 0.0:
            raise InputError(
                f"{path}: time_s: {record.time_s[0]:g} in all {len(record)} rows; expected time that passes"
            )
        _check_whole(path, record)
        _check_wrapped(path, record)
        for part in observed(record, ratio).record.parts():
            part.check_ratio(ratio)
        _check_speed(path, record)
        _check_turn(path, record, ratio)
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


def check_once(paths: Sequence[Path], records: Sequence[Record]) -> None:
    """Refuse (InputError) a measurement that is named twice: what it says would count twice."""
    for number, (path, record) in enumerate(zip(paths, records, strict=True)):
        for other, before in zip(paths[:number], records[:number], strict=True):
            if len(record) == len(before) and all(
                np.array_equal(record.columns[name], before.columns[name]) for name in REQUIRED
            ):
                same = "is named twice" if path == other else f"holds the same samples as {other}"
                raise InputError(f"{path}: {same}; expected each measurement once: leave one of them out")


def _moves(record: Record) -> bool:
    return len(record) > 1 and float(np.ptp(record.motor_position_deg)) > 0.0


def _check_whole(path: Path, record: Record) -> None:
    """Refuse a load angle in whole numbers: no encoder reads whole degrees."""
    load, origin = record.load_position_deg, record.origin
    if origin is not None and "load" in origin.stated:
        return
    if len(load) and float(np.ptp(load)) >= LEAST_WHOLE and np.all(load == np.round(load)):
        motor = record.motor_position_deg
        both = {"motor": "counts:M"} if np.all(motor == np.round(motor)) else {}
        how = "multiply by 360, divided by the encoder's counts per turn (look at motor_position_deg, too)"
        if origin is not None:
            how = (
                f"pass {option('--units', {'load': 'counts:N', **both})} with the counts per turn of the "
                f"encoder{'s' if both else ''}"
            )
        raise InputError(
            f"{path}: load_position_deg: whole numbers only ({load[0]:.10g} to {load[-1]:.10g}), which looks "
            f"like counts; expected degrees: {how}"
        )


def _check_wrapped(path: Path, record: Record) -> None:
    """Refuse an angle that jumps by a constant, as a counter that wraps, while the other does not."""
    motor, load, target = record.motor_position_deg, record.load_position_deg, record.motor_target_deg
    found: dict[str, Wraps] = {}
    for channel, angle, other in (("load", load, motor), ("motor", motor, load)):
        if wraps := find_wraps(angle, other, record.starts):
            found[channel] = wraps
    if target is not None and (wraps := find_wraps(target, load, record.starts)):
        apart, left = (np.std(each - motor) for each in (target, unwrapped(target, wraps.period_deg)))
        if "motor" in found or left < FOLLOWS_SHARE * apart:
            found["target"] = wraps
    if not found:
        return
    channel, wraps = next(iter(found.items()))
    name, row = CHANNELS[channel], int(wraps.rows[0])
    angle = record.columns[name]
    origin = record.origin
    unit = origin.units[channel] if origin else Unit.parse("deg", channel)
    period = period_in(unit, wraps, angle)
    before, after = (float(value) / unit.factor for value in angle[row - 1 : row + 1])
    times = round(abs(after - before) / period)
    size = (
        (f"{times} x " if times > 1 else "")
        + f"{period:.12g}"
        + ("" if unit.name == "deg" else f" {unit.name}")
    )
    raise InputError(
        f"{origin.place(row) if origin else path}: {name}: {_shown(after)} after {_shown(before)}, a jump of "
        f"{size} that the other angle does not make ({len(wraps.rows)} such jump"
        f"{'s' * (len(wraps.rows) > 1)}); expected multi-turn "
        f"angles, and this is {_counter(period, unit, angle)}: {_unwrapping(record, channel, found)}"
    )


def _shown(value: float) -> str:
    """A count in full, any other value with six digits."""
    return f"{value:.12g}" if value == round(value) else f"{value:.6g}"


def _counter(period: float, unit: Unit, angle: FloatArray) -> str:
    """Name of a counter or an angle with this period."""
    if abs(period * abs(unit.factor) - DEG_PER_TURN) < 1e-6 * DEG_PER_TURN:
        return "an angle that wraps after a turn"
    counts = period if unit.name == "counts" else period / (count_of(angle / unit.factor) or period)
    plausible = 1.0 < counts <= MOST_COUNTS
    return f"a counter of {counts:.10g} counts that wraps" if plausible else "a counter that wraps"


def _unwrapping(record: Record, channel: str, found: Mapping[str, Wraps]) -> str:
    """How to unwrap what was found."""
    origin = record.origin
    if origin is None:
        return f"unwrap it by {found[channel].period_deg:.10g} deg"
    if channel in origin.unwrapped:
        return (
            "it moves by more than half of that between two samples, so that --unwrap cannot follow it; "
            "record faster, or a multi-turn angle"
        )
    periods = {
        each: f"{period_in(origin.units[each], wraps, record.columns[CHANNELS[each]]):.12g}"
        for each, wraps in found.items()
    }
    return f"pass {option('--unwrap', periods)}"


def _check_speed(path: Path, record: Record) -> None:
    """Refuse milliseconds and radians in columns that are taken for seconds and degrees, unless stated."""
    origin = record.origin
    if origin is None or "time" in origin.stated or not _moves(record):
        return
    steps = np.diff(record.time_s)
    period_s = float(np.median(steps))
    if period_s >= SLOWEST_S:
        unit = origin.units["time"].name
        seconds = UNITS["s"]
        per_unit = period_s / abs(origin.units["time"].factor)
        fast = [each for each in ("ms", "us", "ns") if per_unit * seconds[each].factor < SLOWEST_S]
        finer = fast[0] if fast else "ns"
        raise InputError(
            f"{path}: time_s advances by {period_s:g} s per sample, too slow to see a motor turn; "
            f"the column '{origin.columns['time']}' looks like {finer}: pass "
            f"{option('--units', {'time': finer})}, or {option('--units', {'time': unit})} if it is in "
            f"{unit}"
        )
    speed = np.abs(np.diff(record.motor_position_deg)[steps > 0.0]) / steps[steps > 0.0]
    fastest = float(np.quantile(speed, 0.99))
    if fastest < SLOWEST_DEG_S and "motor" not in origin.stated:
        raise InputError(
            f"{path}: the motor turns by {fastest:.3g} deg/s at most, slower than a bench moves it: if the "
            f"angles are in radians pass {option('--units', {'motor': 'rad', 'load': 'rad'})}, if the time "
            f"is in milliseconds {option('--units', {'time': 'ms'})}, and "
            f"{option('--units', {'time': 's', 'motor': 'deg'})} if they are degrees and seconds"
        )


def _check_turn(path: Path, record: Record, ratio: float) -> None:
    """Refuse angles in radians: the error repeats with each turn of the motor, which is 2 pi then."""
    origin, motor = record.origin, record.motor_position_deg
    if origin is None or "motor" in origin.stated:
        return
    if len(np.unique(np.floor(PLACES / math.tau * motor))) < PLACES * TURNS_SEEN:
        return  # a few places agree with any period
    direction = np.sign(np.gradient(motor))
    base = np.column_stack([np.ones_like(motor), motor, direction])
    turns = np.column_stack([f(order * motor) for order in (1, 2) for f in (np.cos, np.sin)])
    error = record.transmission_error_arcsec(ratio)
    left, repeating = (
        float(np.sum((error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]) ** 2))
        for columns in (base, np.hstack([base, turns]))
    )
    if repeating < (1.0 - REPEATS_SHARE) * left:
        raise InputError(
            f"{path}: the load's error repeats every 6.283 of the motor's angle, which is a turn in radians: "
            f"pass {option('--units', {'motor': 'rad', 'load': 'rad'})}, or "
            f"{option('--units', {'motor': 'deg'})} if the angles are degrees"
        )
