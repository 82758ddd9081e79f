"""Rejects implausible records, and suggests the units or options with which to read them correctly."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hdbridge.analysis.cuts import SLOWEST_S, observed
from hdbridge.axis.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.records.columns import CHANNELS, UNITS, Unit, option
from hdbridge.records.record import REQUIRED, Record
from hdbridge.records.wraps import Wraps, count_of, find_wraps, period_in, unwrapped
from hdbridge.units import DEG_PER_TURN

LEAST_WHOLE = 10.0
"""Minimum travel for the whole-number check. Over so long a travel, whole numbers are no coincidence."""
SLOWEST_DEG_S = 6.0
"""Minimum peak motor speed of a plausible record, equal to one motor turn per minute."""
MOST_COUNTS = 2**32
"""Maximum plausible range of a wrapping counter, counts."""
TURNS_SEEN = 4.0
"""Minimum number of motor turns for testing whether the error repeats."""
PLACES = 8
"""Number of sectors into which a motor turn is divided. The visited sectors are counted."""
REPEATS_SHARE = 0.5
"""Minimum fraction of the error's variance that repeats with each motor turn, for `TURNS_SEEN` turns. For
more turns the minimum is smaller, because a chance repetition explains less."""
LEAST_REPEATS_SHARE = 0.1
"""Lower bound of the required repeating fraction, reached in records of many turns."""
FOLLOWS_SHARE = 0.1
"""Maximum ratio of the deviations between command and motor after and before unwrapping of the command."""


def check_records(records: Mapping[Path, Record], ratio: float, stated_by: str = "") -> None:
    """Raises InputError if an axis of this ratio cannot have produced the records, or if it never moved.

    Time must increase, angles must be multi-turn, units and ratio must be right, and the motor must move in
    at least one record. The paths, and the file that states the ratio, are used in the messages.
    """
    for path, record in records.items():
        record.check_values()
        if len(record) > 1 and float(np.ptp(record.time_s)) == 0.0:
            raise InputError(
                f"{path}: time_s: {record.time_s[0]:g} in all {len(record)} rows; expected increasing times"
            )
        _check_whole(path, record)
        _check_wrapped(path, record)
        for part in observed(record, ratio).record.parts():
            part.check_ratio(ratio, stated_by)
        _check_speed(path, record)
        _check_turn(path, record, ratio)
    counts = sum(len(each) for each in records.values())
    if counts and not any(_moves(each) for each in records.values()):
        raise InputError(
            f"{', '.join(map(str, records))}: the motor never moves in {counts} samples; expected a move: "
            "record sweeps in both directions"
        )


def zeros_apart_arcsec(records: Sequence[Record], ratio: float) -> float | None:
    """Returns the spread of the zero offsets of records with the same direction of motion, arcsec.

    Returns None if the spread does not exceed the variation within the records, or if each direction has at
    most one record. Directions are compared separately, because hysteresis shifts their mean errors.
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
    """Raises InputError if a measurement is given twice, because its evidence would count twice."""
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
    """Raises InputError for a load angle in whole numbers, because no encoder reads whole degrees."""
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
    """Raises InputError if one angle jumps by a constant (a wrapping counter) and the other does not."""
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
        f"{'s' * (len(wraps.rows) > 1)}); expected a multi-turn angle, but this looks like "
        f"{_counter(period, unit, angle)}: {_unwrapping(record, channel, found)}"
    )


def _shown(value: float) -> str:
    """Formats a whole number in full, and any other value with six significant digits."""
    return f"{value:.12g}" if value == round(value) else f"{value:.6g}"


def _counter(period: float, unit: Unit, angle: FloatArray) -> str:
    """Describes the counter or angle that wraps with this period."""
    if abs(period * abs(unit.factor) - DEG_PER_TURN) < 1e-6 * DEG_PER_TURN:
        return "an angle that wraps after a turn"
    counts = period if unit.name == "counts" else period / (count_of(angle / unit.factor) or period)
    plausible = 1.0 < counts <= MOST_COUNTS
    return f"a counter of {counts:.10g} counts that wraps" if plausible else "a counter that wraps"


def _unwrapping(record: Record, channel: str, found: Mapping[str, Wraps]) -> str:
    """Returns an instruction for unwrapping the angles in ``found``."""
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
    """Raises InputError if milliseconds or radians appear to have been read as seconds or degrees."""
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
            f"{path}: the motor turns at no more than {fastest:.3g} deg/s, slower than on any bench: if the "
            f"angles are in radians pass {option('--units', {'motor': 'rad', 'load': 'rad'})}, if the time "
            f"is in milliseconds {option('--units', {'time': 'ms'})}, and "
            f"{option('--units', {'time': 's', 'motor': 'deg'})} if they are degrees and seconds"
        )


def _check_turn(path: Path, record: Record, ratio: float) -> None:
    """Raises InputError if the angles are in radians.

    The error then repeats every 2 pi of the motor angle instead of every 360.
    """
    origin, motor = record.origin, record.motor_position_deg
    if origin is None or "motor" in origin.stated:
        return
    step = np.gradient(motor) if len(motor) > 1 else np.zeros(len(motor))
    shown = (step != 0.0) & (np.abs(step) < math.tau / PLACES)  # longer steps would alias other periods
    run = np.cumsum(np.diff(shown, prepend=False))
    begins = np.flatnonzero(np.diff(run, prepend=-1))
    spans = np.maximum.reduceat(motor, begins) - np.minimum.reduceat(motor, begins)
    shown &= np.repeat(spans >= math.tau, np.diff(begins, append=len(motor)))  # keep runs over a whole period
    places = len(np.unique(np.floor(PLACES / math.tau * motor[shown])))
    if places < PLACES * TURNS_SEEN:
        return  # too few sectors to distinguish the periods
    base = np.column_stack([np.ones_like(motor), motor, np.sign(step)])
    error = record.transmission_error_arcsec(ratio)[shown]

    def left(*periods: float) -> float:
        waves = [
            f(order * math.tau / period * motor)
            for period in periods
            for order in (1, 2)
            for f in (np.cos, np.sin)
        ]
        columns = np.column_stack([base, *waves])[shown]
        return float(np.sum((error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]) ** 2))

    share = max(LEAST_REPEATS_SHARE, REPEATS_SHARE * PLACES * TURNS_SEEN / places)
    if left(math.tau) < min((1.0 - share) * left(), left(DEG_PER_TURN)):
        raise InputError(
            f"{path}: the load's error repeats every 6.283 of the motor's angle, which is a turn in radians: "
            f"pass {option('--units', {'motor': 'rad', 'load': 'rad'})}, or "
            f"{option('--units', {'motor': 'deg'})} if the angles are degrees"
        )
