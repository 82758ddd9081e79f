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

from hdbridge.effects import FloatArray, IntArray, Motion
from hdbridge.errors import InputError
from hdbridge.estimation.samples import ON_THE_WAY, Measured, Samples, observe, of_each
from hdbridge.observations.cuts import observed
from hdbridge.observations.kinematics import settling
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
