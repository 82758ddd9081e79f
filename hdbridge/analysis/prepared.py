"""Prepares records: white noise, motor angle, observed error, averaging.

White noise is estimated from the spectrum of the error, never from the residual of a fit, because a noise
model fitted to a residual absorbs effects. Third differences suppress slow effects of any size. They retain
fast effects (vibration, interpolation error of an encoder), so their standard deviation is an upper bound.
Fast effects are a few lines of the spectrum, and the level between the lines is the noise. Standing and
moving samples are treated separately, with quantisation as a lower bound. Slow noise (drift) is handled later
by statistics over blocks of seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from hdbridge.analysis.cuts import observed
from hdbridge.analysis.driving import kinematics, reading_of_all, reversals, settling
from hdbridge.analysis.readings import Reading, quantum_deg, third_deviation
from hdbridge.axis.effects import BoolArray, FloatArray, IntArray, Motion, Start
from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

SEGMENTS = (128, 64, 32)
"""Segment lengths for the spectrum, samples. The longest one with enough segments is used, because its lines
are narrowest."""
ORDINATES = 150
"""Minimum number of spectral ordinates, which determines the noise level to 10 %."""
LOWEST = 0.125
"""Frequency, relative to the sampling rate, below which the spectrum may contain slow effects."""
QUARTILE = 0.25
"""Quantile of the spectrum from which the noise level is derived. White noise has less than 0.29 of its mean
power at this fraction of the frequencies. If lines fill a third of the spectrum, the standard deviation is
overestimated by a quarter."""


def noise_arcsec(
    error_arcsec: FloatArray,
    still: BoolArray,
    motor_count_arcsec: float,
    load_count_arcsec: float,
    commanded: bool,
    starts: Sequence[int] = (0,),
) -> FloatArray:
    """Returns the standard deviation of the white noise of each sample, shape (n,).

    ``starts`` contains the indices of the first samples of concatenated records.
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
    if np.any(still) and np.any(~still):  # in motion, assume at least half of the noise at rest
        result[~still] = max(float(result[~still][0]), 0.5 * float(result[still][0]))
    return result


def between_lines(values: FloatArray, rows: BoolArray, starts: Sequence[int] = (0,)) -> float:
    """Returns the standard deviation of the white noise of ``values`` in the given rows.

    It is the level between the lines of the spectrum, or infinity if too few rows are consecutive. Third
    differences remove slow effects. Their spectrum is divided by that of the third differences of white
    noise.
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
        # Power of unit white noise at each frequency: the sum of the contributions of unit samples.
        power /= np.sum(np.abs(np.fft.rfft(np.diff(np.eye(size), 3, axis=1) * window)) ** 2, axis=0)
        level = float(np.quantile(power[:, round(LOWEST * size) :], QUARTILE))
        return float(np.sqrt(level / -np.log1p(-QUARTILE)))
    return float("inf")


# Samples: observed error and motion, shared by calibration and diagnosis.


REPEATS = 3
"""Minimum number of recordings that count as repetitions."""
ALIKE = 2.0
"""Maximum ratio of the longest to the shortest duration, and of the travels, of repeated recordings."""
ON_THE_WAY = ("move", "precondition", "step", "settle")
"""Kinds of legs that only move the axis into position. They determine the elastic state, but only their rests
are used."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A record and the known properties of its samples; arrays of shape (n,)."""

    record: Record
    """Measured record. The motion before each of its ``starts`` is unknown."""
    kinds: tuple[str, ...]
    """Names of the kinds of motion, those of a recording's legs."""
    kind: IntArray
    """Index into ``kinds`` of each sample."""
    zero: IntArray
    """Number of the encoder zero to which each sample refers. It changes wherever the encoders may have lost
    their zeros, and the transmission error then has a new zero offset."""
    states: Mapping[int, Start] = field(default_factory=dict)
    """Known elastic states by sample index."""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Consecutive samples over which the elastic state is tracked."""

    rows: slice
    start: Start | None
    """Elastic state at the first sample; None to fit it."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Prepared samples, or points that are means over runs of samples; arrays of shape (n,)."""

    ratio: float
    motion: Motion
    """Motor angle, time, speed, acceleration and the recorded channels."""
    rested_deg: FloatArray
    """Motor angle under a different assumption about its position at rest (`Driven`)."""
    load_deg: FloatArray
    """Measured load angle."""
    error_arcsec: FloatArray
    """Observed transmission error, with an arbitrary zero offset."""
    sigma_arcsec: FloatArray
    """Standard deviation of the white noise of each sample."""
    usable: BoolArray
    kinds: tuple[str, ...]
    kind: IntArray
    """Index into ``kinds`` of each sample."""
    zero: IntArray
    """Number of the encoder zero to which each sample refers (`Measured`), 0 .. zeros - 1."""
    chains: tuple[Chain, ...]
    """Chains of samples with a known motion between them; rows are those of the full record."""
    reading: Reading
    """Resolution of the motor encoder."""
    commanded: bool
    """True if the record contains the command."""

    def __len__(self) -> int:
        return len(self.error_arcsec)

    @property
    def zeros(self) -> int:
        """Number of encoder zeros."""
        return int(self.zero[-1]) + 1

    @property
    def repeated(self) -> bool:
        """True for several recordings of similar duration and travel; False for the tasks of a plan."""
        rows = [each.rows for each in self.chains]
        durations = np.array([np.ptp(self.time_s[each]) for each in rows])
        travels = np.array([np.sum(np.abs(np.diff(self.motor_deg[each]))) for each in rows])
        alike = all(np.max(each) <= ALIKE * np.min(each) for each in (durations, travels))
        return len(rows) >= REPEATS and alike

    @property
    def count_deg(self) -> float:
        """One count of the motor encoder; 0 if counts are not visible."""
        return self.reading.count_deg

    @property
    def motor_deg(self) -> FloatArray:
        """Motor angle at which the effects are evaluated, degrees."""
        return self.motion.motor_deg

    @property
    def time_s(self) -> FloatArray:
        """Record time of each sample, seconds."""
        assert self.motion.time_s is not None
        return self.motion.time_s

    @property
    def speed_deg_s(self) -> FloatArray:
        """Motor speed, signed."""
        assert self.motion.motor_speed_deg_s is not None
        return self.motion.motor_speed_deg_s

    def of_kind(self, *names: str) -> BoolArray:
        """Returns a mask of the samples in legs of these kinds."""
        return np.isin(self.kind, [at for at, each in enumerate(self.kinds) if each in names])

    def along(self, chain: Chain) -> Motion:
        """Returns the motion over the rows of a chain."""
        return motion_at(self.motion, chain.rows)

    def delayed(self, delay_s: float) -> Samples:
        """Corrects a delayed load reading: replaces the motor angle by its value ``delay_s`` earlier."""
        motor = self.motor_deg.copy()
        for chain in self.chains:
            time, angle = self.time_s[chain.rows], self.motor_deg[chain.rows]
            motor[chain.rows] = np.interp(time - delay_s, time, angle)
        motor.setflags(write=False)
        error = self.error_arcsec + (self.motor_deg - motor) / self.ratio * ARCSEC_PER_DEG
        return replace(self, motion=replace(self.motion, motor_deg=motor), error_arcsec=error)


def motion_at(motion: Motion, rows: slice | IntArray) -> Motion:
    """Returns a motion restricted to some of its samples."""
    return of_each(motion, lambda values: values[rows])


def of_each(motion: Motion, change: Callable[[FloatArray], FloatArray]) -> Motion:
    """Returns a motion after applying a function to each of its arrays."""
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
    """Derives motor angle, transmission error and noise of all samples, and marks all samples usable.

    With ``against_command``, the error is relative to the motor angle derived from the command, if there is a
    command, else to the encoder reading. ``expected`` is a model's prediction, which is subtracted before the
    noise is estimated. Raises InputError if the record contains unusable values or the ratio does not match
    it.
    """
    record = measured.record
    time, position, target = record.time_s, record.motor_position_deg, record.motor_target_deg
    record.check_values()
    if not ratio > 0:
        raise InputError(f"the ratio is {ratio:g}; expected a number above 0")
    rows_of = [slice(first, last) for first, last in pairwise([*record.starts, len(time)])]
    for part in record.parts():
        part.check_ratio(ratio)
    reading = reading_of_all(position, rows_of)
    if target is not None and np.ptp(target) <= 0.0 and np.ptp(position) > 4.0 * reading.count_deg:
        target = None  # a constant command with a moving motor is not a command
    pieces = [
        kinematics(position[rows], None if target is None else target[rows], time[rows], reading)
        for rows in rows_of
    ]
    driving, speed, acceleration, rested = (np.concatenate(each) for each in zip(*pieces, strict=True))
    for angle in (driving, rested):
        angle.setflags(write=False)  # a read-only array's reversals can be cached
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


# Data of a diagnosis: observed error and motion at no more than `MOST_POINTS` points.


MOST_POINTS = 100_000
"""Maximum number of samples that are used without averaging."""
AVERAGED_POINTS = 50_000
"""Approximate number of points after averaging, which bounds time and memory and suffices for slow
effects."""
SHORT = 0.77
"""Length of every other run, relative to the mean length. The runs in between are 1.6 times as long."""
LEAST_SAMPLES = 60
LEAST_SETTLED = 0.2
"""Minimum fraction of samples outside fast moves; below it, fast moves are used as well."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """A measurement prepared for diagnosis: all samples, and the points to fit."""

    ratio: float
    points: Samples
    """Points to fit: samples, or means over runs of samples."""
    full: Samples
    """All samples."""
    runs: IntArray
    """Index of the first sample of each point's run, shape (points,)."""
    motor_count_arcsec: float
    """One count of the motor encoder, referred to the load; if not visible, a count with the same noise."""
    load_count_arcsec: float
    """One count of the load encoder; 0 if counts are not visible."""
    noise_arcsec: float
    """Standard deviation of the white noise of a point, rms over all points."""
    period_s: float
    """Median time between samples."""
    standstill: bool
    reversals: int
    """Number of reversals of the motor with sufficient travel on both sides, summed over the chains."""
    remarks: tuple[str, ...]
    """Shortcomings of the record, in words."""
    load_swings: bool = False
    """True if an ordinary load oscillation has been subtracted, or is fitted with every hypothesis."""

    def over(self, runs: IntArray) -> Observed:
        """Returns the same samples averaged over other runs, which are given by their first samples."""
        return replace(self, points=_averaged(self.full, runs), runs=runs)

    def having(self, full: Samples) -> Observed:
        """Returns the measurement with its samples replaced, and averaged over the same runs."""
        return replace(self, full=full, points=_averaged(full, self.runs))

    @property
    def motion(self) -> Motion:
        """Motion of the axis at each point."""
        return self.points.motion

    def mean(self, values: FloatArray) -> FloatArray:
        """Averages a per-sample quantity, (n,) or (n, p), over each point: (points,) or (points, p)."""
        return means(values, self.runs)

    def at_points(self, values: FloatArray) -> FloatArray:
        """Averages a per-sample quantity over each usable point, like the observations."""
        found, usable = self.mean(values), self.points.usable
        return found if usable.all() else np.asarray(found[usable])


def gather(
    record: Record,
    ratio: float,
    legs: Sequence[Segment] = (),
    independent_zeros: bool = False,
    expected: Callable[[Motion], FloatArray] | None = None,
) -> Observed:
    """Prepares a record for diagnosis.

    ``expected`` is a model's prediction, which is subtracted before the noise is estimated. Raises InputError
    if the record is too short or the ratio does not match it.
    """
    if len(record) < LEAST_SAMPLES:
        raise InputError(
            f"{record.source or 'the record'}: {len(record)} samples are too few for a diagnosis; expected "
            f"at least {LEAST_SAMPLES}: record more"
        )
    prepared = observed(record, ratio)
    origin, record = record.origin, prepared.record
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
        remarks.append("too few reversals: hysteresis and other effects of direction are not visible")
    span = float(np.ptp(record.motor_position_deg))
    if origin is not None and "motor" not in origin.stated and span < 2.0 * DEG_PER_TURN:
        remarks.append(f"the motor's angle spans {span:.3g}: too little to check that it is not in radians")
    usable = ~settling(full.of_kind(*ON_THE_WAY) & ~still, time)
    full = replace(full, usable=usable if np.mean(usable) >= LEAST_SETTLED else np.ones_like(usable))
    steps = np.diff(time)
    period_s = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
    runs = _runs(len(time), record.starts)
    points = _averaged(full, runs)
    return Observed(
        ratio=ratio,
        points=points,
        full=full,
        runs=runs,
        motor_count_arcsec=full.reading.resolution_deg / ratio * ARCSEC_PER_DEG,
        load_count_arcsec=quantum_deg(full.load_deg) * ARCSEC_PER_DEG,
        noise_arcsec=float(np.sqrt(np.mean(points.sigma_arcsec**2))),
        period_s=period_s,
        standstill=standstill,
        reversals=turns,
        remarks=tuple(remarks),
    )


def _kinds(time: FloatArray, legs: Sequence[Segment]) -> tuple[tuple[str, ...], IntArray]:
    """Returns the names of the kinds of legs, and the index of each sample's kind."""
    names = tuple(dict.fromkeys(["other", *(each.kind for each in legs)]))
    kind = np.zeros(len(time), dtype=np.intp)
    for each in legs:
        rows = slice(np.searchsorted(time, each.start_s), np.searchsorted(time, each.end_s, "right"))
        kind[rows] = names.index(each.kind)
    return names, kind


def _runs(count: int, starts: Sequence[int]) -> IntArray:
    """Returns the first samples of the runs to average; no run extends across a start.

    Run lengths alternate, so that no periodic effect is averaged out in all runs.
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
    """Averages a per-sample quantity, (n,) or (n, p), over runs, which are given by their first samples."""
    if len(runs) == len(values):
        return values
    size = np.diff(np.append(runs, len(values)))
    total = np.add.reduceat(values, runs, axis=0)
    return np.asarray(total / (size if values.ndim == 1 else size[:, np.newaxis]))


def _averaged(full: Samples, runs: IntArray) -> Samples:
    """Averages samples over runs; a run with unusable samples becomes an unusable point."""
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
