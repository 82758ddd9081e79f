"""What a diagnosis looks at: the observed error and what drove it, on at most `MOST_POINTS` points.

The angle that drives the effects is the command's where the record has one, plus what the motor encoder shows
against it as a smooth line in speed and acceleration: neither encoder counts nor a following error are
findings.
Longer records are averaged over runs of consecutive samples. What is fitted to them is averaged alike
(`Observed.mean`), so that a law is as large there as in the samples. The full rate stays at hand for that,
and for what is fast (vibration, interpolation errors of an encoder).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray, Motion
from hdbridge.errors import InputError
from hdbridge.estimation.white_noise import noise_arcsec
from hdbridge.observations.cuts import observed
from hdbridge.observations.kinematics import kinematics, reading_of_all, settling
from hdbridge.observations.reading import quantum_deg
from hdbridge.observations.reversals import reversals
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.units import ARCSEC_PER_DEG

MOST_POINTS = 100_000
"""A record of more samples is averaged,"""
AVERAGED_POINTS = 50_000
"""to at most about so many points: time and memory go with them, and what is slow needs no more."""
SHORT = 0.77
"""Share of the mean length of a run that every other one has: the rest have 1.6 times as much."""
LEAST_SAMPLES = 60
LEAST_SETTLED = 0.2
"""Of a record with less of it that is not in a fast move, all is used."""
FAST_KINDS = frozenset({"move", "precondition", "step"})
"""Legs whose motion serves only to get somewhere: the load's own dynamics are not what is asked about."""


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A record as a diagnosis needs it; arrays of shape (n,)."""

    motion: Motion
    """Driving angle, time, speed, acceleration and the channels that were recorded."""
    error_arcsec: FloatArray
    sigma_arcsec: FloatArray
    """White noise of each point."""
    usable: BoolArray
    """False in fast moves between the legs of a bench plan, and just after them."""
    zero: IntArray
    """Number of the absolute zero of each point."""
    kind: IntArray
    """Index into `Observed.kinds`."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.error_arcsec)

    @property
    def time_s(self) -> FloatArray:
        """Time of each point on the record's clock."""
        assert self.motion.time_s is not None
        return self.motion.time_s


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """A measurement, prepared."""

    ratio: float
    points: Series
    """What is fitted."""
    full: Series
    """Every sample."""
    runs: IntArray
    """First sample of each point's run, shape (points,)."""
    kinds: tuple[str, ...]
    zeros: int
    commanded: bool
    """Whether the record has the command."""
    motor_count_arcsec: float
    """One count of the motor encoder at the load; where none is seen, the one that would jitter as much."""
    period_s: float
    """Median time between samples."""
    standstill: bool
    reversals: int
    """Turns of the driving angle with travel on both sides, each within one record."""
    remarks: tuple[str, ...]
    """What the record lacks, in words."""

    def over(self, runs: IntArray) -> Observed:
        """The same samples averaged over other runs, given by their first samples."""
        return replace(self, points=_averaged(self.full, runs), runs=runs)

    @property
    def motion(self) -> Motion:
        """What drove the axis, point by point."""
        return self.points.motion

    def mean(self, values: FloatArray) -> FloatArray:
        """Means of a quantity of every sample, (n,) or (n, p), over the points: (points,) or (points, p)."""
        return means(values, self.runs)


def gather(
    record: Record,
    ratio: float,
    legs: Sequence[Segment] = (),
    independent_zeros: bool = False,
    expected: Callable[[Motion], FloatArray] | None = None,
) -> Observed:
    """Prepare a record; ``expected`` is what a model predicts, taken off before the noise is looked at.
    InputError where there is too little of it, or the ratio is not this gear's.
    """
    count = len(record)
    if count < LEAST_SAMPLES:
        raise InputError(
            f"{record.source or 'the record'}: {count} samples are too few for a diagnosis; expected at "
            f"least {LEAST_SAMPLES}: record more"
        )
    prepared = observed(record, ratio)
    record = prepared.record
    time, position, target = record.time_s, record.motor_position_deg, record.motor_target_deg
    for part in record.parts() if independent_zeros or prepared.cuts else (record,):
        part.check_ratio(ratio)
    steps = np.diff(time)
    period = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
    rows_of = [slice(first, last) for first, last in pairwise([*record.starts, len(time)])]
    reading = reading_of_all(position, rows_of)
    if target is not None and np.ptp(target) <= 0.0 and np.ptp(position) > 4.0 * reading.count_deg:
        target = None  # a command that never moves while the motor does is no command
    pieces = [
        kinematics(position[rows], None if target is None else target[rows], time[rows], reading)
        for rows in rows_of
    ]
    driving, speed, acceleration = (np.concatenate(each) for each in zip(*pieces, strict=True))
    driving.setflags(write=False)  # so that where it reverses is worked out once
    motion = Motion(
        motor_deg=driving,
        time_s=time,
        measured=record.measured,
        motor_speed_deg_s=speed,
        motor_acceleration_deg_s2=acceleration,
        load_deg=driving / ratio,
    )
    part_of = np.repeat(np.arange(len(rows_of)), [rows.stop - rows.start for rows in rows_of])
    kind, names = _kinds(time, speed, legs)
    # Without a command the error is that of the counts as they are; only what drives the loop is steadied.
    error = (record.load_position_deg - (position if target is None else driving) / ratio) * ARCSEC_PER_DEG
    still = speed == 0.0
    standstill = float(np.mean(still)) > 0.02 and int(np.sum(still)) > 50
    turns = sum(reversals(each, reading.jitter_deg) for each, _, _ in pieces)
    remarks = list(prepared.remarks)
    if target is None:
        remarks.append("no command (motor_target_deg): the encoder's own counts drive the hysteresis")
    if not standstill:
        remarks.append("no standstill: the noise is taken from differences of neighbouring samples")
    if turns < 2:
        remarks.append("hardly a reversal: hysteresis and all that depends on direction cannot be seen")
    counts = (
        reading.resolution_deg / ratio * ARCSEC_PER_DEG,
        quantum_deg(record.load_position_deg) * ARCSEC_PER_DEG,
    )
    known = expected(motion) if expected is not None else 0.0
    sigma = noise_arcsec(error - known, still, *counts, target is not None, record.starts)
    zero = part_of if independent_zeros else np.zeros_like(part_of)
    fast_kind = np.isin(kind, [i for i, each in enumerate(names) if each in FAST_KINDS])
    usable = ~settling(fast_kind & ~still, time)
    if np.mean(usable) < LEAST_SETTLED:
        usable[:] = True
    full = Series(motion, error, sigma, usable, zero, kind)
    runs = _runs(len(time), record.starts)
    return Observed(
        ratio=ratio,
        points=_averaged(full, runs),
        full=full,
        runs=runs,
        kinds=names,
        zeros=int(zero[-1]) + 1,
        commanded=target is not None,
        motor_count_arcsec=counts[0],
        period_s=period,
        standstill=standstill,
        reversals=turns,
        remarks=tuple(remarks),
    )


def _kinds(time: FloatArray, speed: FloatArray, legs: Sequence[Segment]) -> tuple[IntArray, tuple[str, ...]]:
    """Kind of the leg of each sample; without legs by whether it stands, is slow or fast."""
    if legs:
        names = tuple(dict.fromkeys(["other", *(each.kind for each in legs)]))
        kind = np.zeros(len(time), dtype=np.intp)
        for each in legs:
            rows = slice(np.searchsorted(time, each.start_s), np.searchsorted(time, each.end_s, "right"))
            kind[rows] = names.index(each.kind)
        return kind, names
    magnitude = np.abs(speed)
    moving = magnitude[magnitude > 0.0]
    border = float(np.median(moving)) if len(moving) else 1.0
    kind = np.where(magnitude == 0.0, 0, np.where(magnitude <= border, 1, 2)).astype(np.intp)
    return kind, ("standing", "slow", "fast")


def _runs(count: int, starts: Sequence[int]) -> IntArray:
    """Where runs of consecutive samples begin; none reaches over a start.

    Their lengths alternate, so that no period is averaged out in all of them.
    """
    if count <= MOST_POINTS:
        return np.arange(count, dtype=np.intp)
    size = -(-count // AVERAGED_POINTS)
    short = round(SHORT * size)
    pair = np.add.outer(np.arange(0, count, 2 * size), (0, short)).ravel()
    return np.concatenate(
        [first + pair[: np.searchsorted(pair, last - first)] for first, last in pairwise([*starts, count])]
    ).astype(np.intp)


def means(values: FloatArray, runs: IntArray) -> FloatArray:
    """Means of a quantity of every sample, (n,) or (n, p), over runs of samples given by their first ones."""
    if len(runs) == len(values):
        return values
    size = np.diff(np.append(runs, len(values)))
    total = np.add.reduceat(values, runs, axis=0)
    return np.asarray(total / (size if values.ndim == 1 else size[:, np.newaxis]))


def _averaged(full: Series, runs: IntArray) -> Series:
    """Means over runs of consecutive samples; what is not usable is left out of the means, not of the
    path.
    """
    if len(runs) == len(full):
        return full
    size = np.diff(np.append(runs, len(full)))
    middle = runs + size // 2

    def mean(values: FloatArray | None) -> Any:
        return None if values is None else means(values, runs)

    motion = full.motion
    return Series(
        Motion(
            motor_deg=mean(motion.motor_deg),
            time_s=mean(motion.time_s),
            measured={channel: mean(values) for channel, values in motion.measured.items()},
            motor_speed_deg_s=mean(motion.motor_speed_deg_s),
            motor_acceleration_deg_s2=mean(motion.motor_acceleration_deg_s2),
            load_deg=mean(motion.load_deg),
        ),
        mean(full.error_arcsec),
        np.sqrt(mean(full.sigma_arcsec**2) / size),
        mean(full.usable.astype(np.float64)) > 0.999,
        full.zero[middle],
        full.kind[middle],
    )
