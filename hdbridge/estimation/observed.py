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

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray, Motion
from hdbridge.errors import InputError
from hdbridge.estimation.white_noise import noise_arcsec
from hdbridge.observations.cuts import observed
from hdbridge.observations.driving import reversals
from hdbridge.observations.kinematics import kinematics
from hdbridge.observations.reading import Reading, quantum_deg, reading_of
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
SPEED_WINDOW_S = 0.03
SETTLE_S = 0.15
"""After a fast move the load is left this much time to come to rest."""
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
    leg: IntArray
    """Number of the leg; a new one wherever the kind of motion changes."""
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
    load_count_arcsec: float
    period_s: float
    """Median time between samples."""
    standstill: bool
    reversals: int
    """Turns of the driving angle with travel on both sides, each within one record."""
    travel_deg: float
    """The largest span of the motor's angle over which a phase is carried: no further than to a cut."""
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
    count = len(record)
    for part in record.parts() if independent_zeros or prepared.cuts else (record,):
        part.check_ratio(ratio)
    seen = _as_recorded(record, ratio, legs, independent_zeros)
    full, motion = seen.full, seen.motion
    remarks = list(prepared.remarks)
    if not seen.commanded:
        remarks.append("no command (motor_target_deg): the encoder's own counts drive the hysteresis")
    still = motion.motor_speed_deg_s == 0.0 if motion.motor_speed_deg_s is not None else np.zeros(count, bool)
    standstill = float(np.mean(still)) > 0.02 and int(np.sum(still)) > 50
    if not standstill:
        remarks.append("no standstill: the noise is taken from differences of neighbouring samples")
    if seen.reversals < 2:
        remarks.append("hardly a reversal: hysteresis and all that depends on direction cannot be seen")
    known = expected(motion) if expected is not None else 0.0
    sigma = noise_arcsec(
        full.error_arcsec - known,
        still,
        seen.motor_count_arcsec,
        seen.load_count_arcsec,
        seen.commanded,
        record.starts,
    )
    seen = replace(
        seen,
        full=replace(full, sigma_arcsec=sigma),
        standstill=standstill,
        travel_deg=prepared.travel_deg(independent_zeros),
        remarks=tuple(remarks),
    )
    return seen.over(_runs(count, record.starts))


def _as_recorded(record: Record, ratio: float, legs: Sequence[Segment], independent: bool) -> Observed:
    """Every sample as a point; its noise is not known yet."""
    time = record.time_s
    steps = np.diff(time)
    period = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
    fresh = np.zeros(len(time), dtype=bool)
    fresh[list(record.starts)] = True
    window = max(1, round(SPEED_WINDOW_S / period)) | 1
    edges = [*record.starts, len(time)]
    rows_of = [slice(first, last) for first, last in pairwise(edges)]
    reading = _reading(record.motor_position_deg, rows_of)
    count = reading.count_deg
    target = record.motor_target_deg
    if target is not None and np.ptp(target) <= 0.0 and np.ptp(record.motor_position_deg) > 4.0 * count:
        target = None  # a command that never moves while the motor does is no command
    pieces = [
        kinematics(
            record.motor_position_deg[rows],
            None if target is None else target[rows],
            time[rows],
            window,
            reading,
        )
        for rows in rows_of
    ]
    driving, speed, acceleration = (np.concatenate(each) for each in zip(*pieces, strict=True))
    driving.setflags(write=False)  # so that where it reverses is worked out once
    # Without a command the error is that of the counts as they are; only what drives the loop is steadied.
    angle = driving if target is not None else record.motor_position_deg
    error = (record.load_position_deg - angle / ratio) * ARCSEC_PER_DEG
    zero = np.cumsum(fresh) - 1 if independent else np.zeros(len(time), dtype=np.intp)
    kind, leg, names = _kinds(time, speed, fresh, legs)
    usable = np.ones(len(time), dtype=bool)
    if legs:
        fast = np.isin(kind, [i for i, each in enumerate(names) if each in FAST_KINDS]) & (speed != 0.0)
        reach = round(SETTLE_S / period)
        recent = np.convolve(fast.astype(np.float64), np.ones(reach + 1))[: len(fast)] > 0.5
        usable = ~(fast | recent)
        if np.mean(usable) < 0.2:
            usable[:] = True
    motion = Motion(
        motor_deg=driving,
        time_s=time,
        measured=record.measured,
        motor_speed_deg_s=speed,
        motor_acceleration_deg_s2=acceleration,
        load_deg=driving / ratio,
    )
    series = Series(
        motion, error, np.ones(len(time)), usable, zero.astype(np.intp), leg.astype(np.intp), kind
    )
    return Observed(
        ratio=ratio,
        points=series,
        full=series,
        runs=np.arange(len(time), dtype=np.intp),
        kinds=names,
        zeros=int(zero[-1]) + 1,
        commanded=target is not None,
        motor_count_arcsec=reading.resolution_deg / ratio * ARCSEC_PER_DEG,
        load_count_arcsec=quantum_deg(record.load_position_deg) * ARCSEC_PER_DEG,
        period_s=period,
        standstill=False,
        reversals=sum(reversals(piece[0], reading.jitter_deg) for piece in pieces),
        travel_deg=0.0,
        remarks=(),
    )


def _kinds(
    time: FloatArray, speed: FloatArray, fresh: BoolArray, legs: Sequence[Segment]
) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Kind and number of the leg of each sample; without legs by whether it stands, is slow or fast."""
    if legs:
        names = tuple(dict.fromkeys(["other", *(each.kind for each in legs)]))
        kind = np.zeros(len(time), dtype=np.intp)
        leg = np.zeros(len(time), dtype=np.intp)
        for number, each in enumerate(legs, 1):
            rows = slice(np.searchsorted(time, each.start_s), np.searchsorted(time, each.end_s, "right"))
            kind[rows] = names.index(each.kind)
            leg[rows] = number
        return kind, leg, names
    magnitude = np.abs(speed)
    moving = magnitude[magnitude > 0.0]
    border = float(np.median(moving)) if len(moving) else 1.0
    kind = np.where(magnitude == 0.0, 0, np.where(magnitude <= border, 1, 2)).astype(np.intp)
    leg = np.cumsum(fresh) + 0
    return kind, leg, ("standing", "slow", "fast")


def _reading(angle_deg: FloatArray, parts: Sequence[slice]) -> Reading:
    """How finely the motor's angle was read: one encoder for all parts, so the one that saw it best tells."""
    largest = max(parts, key=lambda rows: rows.stop - rows.start)
    return replace(reading_of(angle_deg[largest]), count_deg=quantum_deg(angle_deg))


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

    def mean(values: FloatArray) -> FloatArray:
        return means(values, runs)

    motion = full.motion
    channels = {
        name: None if (value := getattr(motion, name)) is None else mean(value)
        for name in (
            "motor_deg", "time_s", "motor_speed_deg_s", "motor_acceleration_deg_s2", "load_deg",
        )
    }  # fmt: skip
    measured = {channel: mean(values) for channel, values in motion.measured.items()}
    return Series(
        Motion(**channels, measured=measured),  # type: ignore[arg-type]
        mean(full.error_arcsec),
        np.sqrt(mean(full.sigma_arcsec**2) / size),
        mean(full.usable.astype(np.float64)) > 0.999,
        full.zero[middle],
        full.leg[middle],
        full.kind[middle],
    )
