"""How large the white noise is, from the spectrum of the error itself: never from the residual of a fit.

A noise model fitted to a residual takes an effect for noise. Third differences see nothing that is slow, so a
slow effect of any size leaves them alone; but they take what is fast (a vibration, an encoder's
interpolation error) for noise, and so are an upper bound. What is fast is a few lines of the spectrum: the
level between the lines is the noise's own. Both are taken apart for standing and moving, and quantisation is
a floor. What is slow (wander, drift) is met later by statistics over blocks of seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from hdbridge.analysis.cuts import observed
from hdbridge.analysis.driving import kinematics, reading_of_all, reversals, settling
from hdbridge.analysis.readings import Reading, quantum_deg, third_deviation
from hdbridge.effects import BoolArray, FloatArray, IntArray, Motion, Start
from hdbridge.errors import InputError
from hdbridge.records.record import OPTIONAL, REQUIRED, Record
from hdbridge.records.recording import Segment
from hdbridge.units import ARCSEC_PER_DEG

SEGMENTS = (128, 64, 32)
"""Samples that are transformed together: the longer, the narrower a line; as many as there are enough of."""
ORDINATES = 150
"""So many of the spectrum's ordinates know the level to a tenth."""
LOWEST = 0.125
"""Share of the sampling rate below which a spectrum may be that of something slow."""
QUARTILE = 0.25
"""White noise has less than 0.29 of its mean power at so many frequencies. Lines have more, and where they
fill a third of the spectrum the deviation is found a quarter too large."""


def noise_arcsec(
    error_arcsec: FloatArray,
    still: BoolArray,
    motor_count_arcsec: float,
    load_count_arcsec: float,
    commanded: bool,
    starts: Sequence[int] = (0,),
) -> FloatArray:
    """Standard deviation of the white noise of each sample, shape (n,); ``starts`` are the first samples of
    records that were put together.
    """
    floor = load_count_arcsec / np.sqrt(12.0)
    if not commanded:
        floor = float(np.hypot(floor, motor_count_arcsec / np.sqrt(12.0)))
    third = np.diff(error_arcsec, 3)
    inner = still[1:-2]
    result = np.empty(len(error_arcsec))
    for rows, part in ((still, third[inner]), (~still, third[~inner])):
        size = third_deviation(part) if len(part) >= 20 else 0.0
        result[rows] = max(min(size, between_lines(error_arcsec, rows, starts)), floor, 0.02)
    if np.any(still) and np.any(~still):  # in motion nothing is quieter than at rest
        result[~still] = max(float(result[~still][0]), 0.5 * float(result[still][0]))
    return result


def between_lines(values: FloatArray, rows: BoolArray, starts: Sequence[int] = (0,)) -> float:
    """Standard deviation of the white noise of ``values`` in some rows, by the level between the lines of
    their spectra; infinite where too few rows are together.

    Third differences take away what is slow; their spectrum is divided by that of white noise.
    """
    edge = np.zeros(len(rows) + 1, dtype=bool)
    edge[1:-1] = np.diff(rows)
    edge[[*starts, 0, len(rows)]] = True
    runs = [values[first:last] for first, last in pairwise(np.flatnonzero(edge).tolist()) if rows[first]]
    for size in SEGMENTS:
        segments = [run[at : at + size] for run in runs for at in range(0, len(run) - size + 1, size)]
        if len(segments) * (size // 2 + 1 - round(LOWEST * size)) < ORDINATES:
            continue
        window = np.hanning(size - 1)[1:-1]
        power = np.abs(np.fft.rfft(np.diff(np.stack(segments), 3, axis=1) * window)) ** 2
        # What one sample of size one puts into each frequency, summed over the samples.
        power /= np.sum(np.abs(np.fft.rfft(np.diff(np.eye(size), 3, axis=1) * window)) ** 2, axis=0)
        level = float(np.quantile(power[:, round(LOWEST * size) :], QUARTILE))
        return float(np.sqrt(level / -np.log1p(-QUARTILE)))
    return float("inf")


# What was observed, sample by sample, and what drove it: one table, for calibration and diagnosis alike.


ON_THE_WAY = ("move", "precondition", "step", "settle")
"""Legs whose motion serves only to get somewhere: it carries the elastic state, and only rests are used."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A record, and what is known of its samples; arrays of shape (n,)."""

    record: Record
    """Nothing is known of the axis between what lies before one of its ``starts`` and what begins there."""
    kinds: tuple[str, ...]
    """What the axis may have been doing, by the names of a recording's legs."""
    kind: IntArray
    """Index into ``kinds``."""
    zero: IntArray
    """Number of the absolute zero, 0 .. zeros - 1."""
    states: Mapping[int, Start] = field(default_factory=dict)
    """The elastic state at a start where it is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Consecutive samples through which the elastic state is carried."""

    rows: slice
    start: Start | None
    """None where it has to be found by fit."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples, or means over runs of them; arrays of shape (n,)."""

    ratio: float
    motion: Motion
    """Driving angle, time, speed, acceleration and the channels that were recorded."""
    rested_deg: FloatArray
    """Another driving angle that was read alike (`hdbridge.analysis.driving.Driven`)."""
    load_deg: FloatArray
    """Measured load angle."""
    error_arcsec: FloatArray
    """Observed transmission error, about an arbitrary zero."""
    sigma_arcsec: FloatArray
    """White noise of each."""
    usable: BoolArray
    kinds: tuple[str, ...]
    kind: IntArray
    """Index into ``kinds``."""
    zero: IntArray
    """Number of the absolute zero, 0 .. zeros - 1."""
    chains: tuple[Chain, ...]
    """Of single samples."""
    reading: Reading
    """How finely the motor's angle was read."""
    commanded: bool
    """Whether the record has the command."""

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.error_arcsec)

    @property
    def zeros(self) -> int:
        """Number of absolute zeros."""
        return int(self.zero[-1]) + 1

    @property
    def count_deg(self) -> float:
        """Motor angle of one count of the encoder, 0 where none is seen."""
        return self.reading.count_deg

    @property
    def motor_deg(self) -> FloatArray:
        """The driving angle."""
        return self.motion.motor_deg

    @property
    def time_s(self) -> FloatArray:
        """The record's clock."""
        assert self.motion.time_s is not None
        return self.motion.time_s

    @property
    def speed_deg_s(self) -> FloatArray:
        """Speed of the motor, signed."""
        assert self.motion.motor_speed_deg_s is not None
        return self.motion.motor_speed_deg_s

    def of_kind(self, *names: str) -> BoolArray:
        """The samples of legs of some names."""
        return self.among(self.kind, names)

    def among(self, kind: IntArray, names: Collection[str]) -> BoolArray:
        """Which indices into ``kinds`` are those of some names."""
        return np.isin(kind, [at for at, each in enumerate(self.kinds) if each in names])

    def along(self, chain: Chain) -> Motion:
        """What drove one of the chains."""
        return motion_at(self.motion, chain.rows)

    def delayed(self, delay_s: float) -> Samples:
        """The same if the load was read so much later than the motor: with the motor as it was then."""
        motor = self.motor_deg.copy()
        for chain in self.chains:
            time, angle = self.time_s[chain.rows], self.motor_deg[chain.rows]
            motor[chain.rows] = np.interp(time - delay_s, time, angle)
        motor.setflags(write=False)
        error = self.error_arcsec + (self.motor_deg - motor) / self.ratio * ARCSEC_PER_DEG
        return replace(self, motion=replace(self.motion, motor_deg=motor), error_arcsec=error)


def motion_at(motion: Motion, rows: slice | IntArray) -> Motion:
    """A motion at some of its samples."""
    return of_each(motion, lambda values: values[rows])


def of_each(motion: Motion, change: Callable[[FloatArray], FloatArray]) -> Motion:
    """A motion with each of its arrays changed."""
    given: dict[str, Any] = {each.name: getattr(motion, each.name) for each in fields(motion)}
    changed = {name: change(each) for name, each in given.items() if isinstance(each, np.ndarray)}
    measured = {channel: change(values) for channel, values in motion.measured.items()}
    return replace(motion, **changed, measured=measured)


def observe(
    measured: Measured,
    ratio: float,
    *,
    against_command: bool,
    expected: Callable[[Motion], FloatArray] | None = None,
) -> Samples:
    """Drive, error and noise of all samples, all of them usable.

    ``against_command`` says that the error is that against the driving angle where there is a command, else
    against the encoder's counts; ``expected`` is what a model predicts, taken off before the noise is looked
    at. InputError where the record holds what cannot be computed with, or the ratio is not this gear's.
    """
    record = measured.record
    name = f"{record.source}: " if record.source else ""
    time, position, target = record.time_s, record.motor_position_deg, record.motor_target_deg
    for column in sorted(record.columns.keys() & {*REQUIRED, *OPTIONAL}):
        bad = np.flatnonzero(~np.isfinite(record.columns[column]))
        if len(bad):
            raise InputError(
                f"{name}{column} of sample {bad[0]} is {record.columns[column][bad[0]]}; expected a finite "
                "number: remove the sample or repair the file"
            )
    for row in np.setdiff1d(np.flatnonzero(np.diff(time) < 0.0) + 1, record.starts)[:1].tolist():
        raise InputError(
            f"{name}time_s of sample {row} lies before that of sample {row - 1}; expected time to run "
            "forwards: sort the samples, or make two records of them"
        )
    if not ratio > 0:
        raise InputError(f"{name}the ratio is {ratio:g}; expected more than 0")
    rows_of = [slice(first, last) for first, last in pairwise([*record.starts, len(time)])]
    for part in record.parts():
        part.check_ratio(ratio)
    reading = reading_of_all(position, rows_of)
    if target is not None and np.ptp(target) <= 0.0 and np.ptp(position) > 4.0 * reading.count_deg:
        target = None  # a command that never moves while the motor does is no command
    pieces = [
        kinematics(position[rows], None if target is None else target[rows], time[rows], reading)
        for rows in rows_of
    ]
    driving, speed, acceleration, rested = (np.concatenate(each) for each in zip(*pieces, strict=True))
    for angle in (driving, rested):
        angle.setflags(write=False)  # so that where it reverses is worked out once
    motion = Motion(driving, time, record.measured, speed, acceleration, load_deg=driving / ratio)
    against = driving if against_command and target is not None else position
    error = (record.load_position_deg - against / ratio) * ARCSEC_PER_DEG
    count_arcsec = reading.resolution_deg / ratio * ARCSEC_PER_DEG
    load_count_arcsec = quantum_deg(record.load_position_deg) * ARCSEC_PER_DEG
    known = expected(motion) if expected is not None else 0.0
    sigma = noise_arcsec(
        error - known, speed == 0.0, count_arcsec, load_count_arcsec, target is not None, record.starts
    )
    return Samples(
        ratio=ratio,
        motion=motion,
        rested_deg=rested,
        load_deg=record.load_position_deg,
        error_arcsec=error,
        sigma_arcsec=sigma,
        usable=np.ones(len(time), dtype=np.bool_),
        kinds=measured.kinds,
        kind=measured.kind,
        zero=measured.zero,
        chains=tuple(Chain(rows, measured.states.get(rows.start)) for rows in rows_of),
        reading=reading,
        commanded=target is not None,
    )


# What a diagnosis looks at: the observed error and what drove it, on at most `MOST_POINTS` points.


MOST_POINTS = 100_000
"""A record of more samples is averaged,"""
AVERAGED_POINTS = 50_000
"""to at most about so many points: time and memory go with them, and what is slow needs no more."""
SHORT = 0.77
"""Share of the mean length of a run that every other one has: the rest have 1.6 times as much."""
LEAST_SAMPLES = 60
LEAST_SETTLED = 0.2
"""Of a record with less of it that is not in a fast move, all is used."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """A measurement, prepared."""

    ratio: float
    points: Samples
    """What is fitted."""
    full: Samples
    """Every sample."""
    runs: IntArray
    """First sample of each point's run, shape (points,)."""
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
    if len(record) < LEAST_SAMPLES:
        raise InputError(
            f"{record.source or 'the record'}: {len(record)} samples are too few for a diagnosis; expected "
            f"at least {LEAST_SAMPLES}: record more"
        )
    prepared = observed(record, ratio)
    record = prepared.record
    time = record.time_s
    part_of = np.repeat(np.arange(len(record.starts)), np.diff([*record.starts, len(time)]))
    zero = part_of if independent_zeros else np.zeros_like(part_of)
    full = observe(
        Measured(record, *_kinds(time, legs), zero), ratio, against_command=True, expected=expected
    )
    still = full.speed_deg_s == 0.0
    standstill = float(np.mean(still)) > 0.02 and int(np.sum(still)) > 50
    turns = sum(reversals(full.motor_deg[each.rows], full.reading.jitter_deg) for each in full.chains)
    remarks = list(prepared.remarks)
    if not full.commanded:
        remarks.append("no command (motor_target_deg): the encoder's own counts drive the hysteresis")
    if not standstill:
        remarks.append("no standstill: the noise is taken from differences of neighbouring samples")
    if turns < 2:
        remarks.append("hardly a reversal: hysteresis and all that depends on direction cannot be seen")
    usable = ~settling(full.of_kind(*ON_THE_WAY) & ~still, time)
    full = replace(full, usable=usable if np.mean(usable) >= LEAST_SETTLED else np.ones_like(usable))
    steps = np.diff(time)
    runs = _runs(len(time), record.starts)
    return Observed(
        ratio=ratio,
        points=_averaged(full, runs),
        full=full,
        runs=runs,
        motor_count_arcsec=full.reading.resolution_deg / ratio * ARCSEC_PER_DEG,
        period_s=float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0,
        standstill=standstill,
        reversals=turns,
        remarks=tuple(remarks),
    )


def _kinds(time: FloatArray, legs: Sequence[Segment]) -> tuple[tuple[str, ...], IntArray]:
    """Kind of the leg of each sample."""
    names = tuple(dict.fromkeys(["other", *(each.kind for each in legs)]))
    kind = np.zeros(len(time), dtype=np.intp)
    for each in legs:
        rows = slice(np.searchsorted(time, each.start_s), np.searchsorted(time, each.end_s, "right"))
        kind[rows] = names.index(each.kind)
    return names, kind


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


def _averaged(full: Samples, runs: IntArray) -> Samples:
    """Means over runs of consecutive samples; what is not usable is left out of the means, not of the
    path.
    """
    if len(runs) == len(full):
        return full
    size = np.diff(np.append(runs, len(full)))
    middle = runs + size // 2
    return replace(
        full,
        motion=of_each(full.motion, lambda values: means(values, runs)),
        rested_deg=means(full.rested_deg, runs),
        load_deg=means(full.load_deg, runs),
        error_arcsec=means(full.error_arcsec, runs),
        sigma_arcsec=np.sqrt(means(full.sigma_arcsec**2, runs) / size),
        usable=means(full.usable.astype(np.float64), runs) > 0.999,
        zero=full.zero[middle],
        kind=full.kind[middle],
    )
