"""All segments laid end to end: what was observed, what drove it, and which samples can be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray, Motion, Start
from hdbridge.effects.base import measured_by_all
from hdbridge.effects.path import branches
from hdbridge.errors import InputError
from hdbridge.estimation.segment import MINIMUM_SAMPLES, Kind, Segment
from hdbridge.observations.cuts import jumps
from hdbridge.observations.kinematics import SETTLE_S, kinematics, reading_of_all, settling
from hdbridge.records.record import Record
from hdbridge.units import ARCSEC_PER_DEG

KINDS = tuple(Kind)
SETTLE_SHARE = 0.2
"""After a turn, where the hysteresis rises too steeply for a load on a spring to follow, no more than this
share of the travel to the next one is left out."""
STANDING_DEG_S = 1e-3
"""Load speed below which an axis stands."""
GENTLE_DEG_S2 = 40.0
"""Load acceleration that a motion of which nothing is known may have."""
ON_THE_WAY = (Kind.MOVE, Kind.STEP)
SLOW = (Kind.SWEEP, Kind.SINE, Kind.REVERSAL)
"""Kinds whose own speed is what is meant by slow."""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Consecutive segments through which the elastic state is carried."""

    rows: slice
    start: Start | None
    """None where it has to be found by fit."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Segments laid end to end; arrays of shape (n,)."""

    ratio: float
    motion: Motion
    """What drove the axis: the driving angle, time, and the channels that all segments have."""
    load_deg: FloatArray
    """Measured load angle."""
    error_arcsec: FloatArray
    """Observed transmission error, load - motor / N, about an arbitrary zero."""
    speed_deg_s: FloatArray
    """Speed of the motor, signed."""
    usable: BoolArray
    """False for fast moves and the settling after them."""
    kind: IntArray
    """Index into `KINDS`."""
    zero: IntArray
    """Index of the absolute zero, 0 .. zeros - 1."""
    zeros: int
    count_deg: float
    """Motor angle of one count of the encoder or the command, 0 where none is seen."""
    chains: tuple[Chain, ...]
    travel_deg: float
    """The largest span of the motor's angle over which a phase is carried."""

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.motion)

    @property
    def motor_deg(self) -> FloatArray:
        """The driving angle."""
        return self.motion.motor_deg

    @property
    def time_s(self) -> FloatArray:
        """The record's clock."""
        assert self.motion.time_s is not None
        return self.motion.time_s

    def along(self, chain: Chain) -> Motion:
        """What drove one of the chains."""
        return motion_at(self.motion, chain.rows)

    def delayed(self, delay_s: float) -> Samples:
        """The same if the load was read so much later than the motor: with the motor as it was then."""
        motor = self.motor_deg.copy()
        for chain in self.chains:
            time, angle = self.time_s[chain.rows], self.motor_deg[chain.rows]
            motor[chain.rows] = np.interp(time - delay_s, time, angle)
        error = self.error_arcsec + (self.motor_deg - motor) / self.ratio * ARCSEC_PER_DEG
        return replace(self, motion=replace(self.motion, motor_deg=motor), error_arcsec=error)


def motion_at(motion: Motion, rows: slice | IntArray) -> Motion:
    """A motion at some of its samples."""
    return Motion(
        motion.motor_deg[rows],
        None if motion.time_s is None else motion.time_s[rows],
        {channel: values[rows] for channel, values in motion.measured.items()},
    )


def gather(
    segments: Sequence[Segment],
    ratio: float,
    start: Start | None = None,
    slow_deg_s: float | None = None,
) -> Samples:
    """Lay segments end to end. InputError where there is too little, or the ratio is not this gear's.

    ``slow_deg_s`` is the load speed up to which samples are used; by default the one of the slow kinds.
    ``start`` is the elastic state at the very first sample; None leaves it to the fit.
    """
    segments = [each for each in segments if len(each)]
    total = sum(len(each) for each in segments)
    if total < MINIMUM_SAMPLES:
        raise InputError(
            f"{total} samples in {len(segments)} segments; expected at least {MINIMUM_SAMPLES}: record more"
        )
    numbers = [each.zero for each in segments]
    names = {number: index for index, number in enumerate(dict.fromkeys(numbers))}
    cuts = [
        index
        for index in range(1, len(segments))
        if numbers[index] != numbers[index - 1] or not follows(segments[index - 1], segments[index])
    ]
    begins = sorted({0, *cuts, *(index for index, each in enumerate(segments) if each.start is not None)})
    edges = np.cumsum([0, *map(len, segments)]).tolist()
    spans = [*pairwise([*begins, len(segments)])]
    starts = [segments[first].start for first in begins]
    starts[0] = start if starts[0] is None else starts[0]
    chains = [
        Chain(slice(edges[first], edges[last]), known)
        for (first, last), known in zip(spans, starts, strict=True)
    ]
    time = np.concatenate([each.time_s for each in segments])
    measured = np.concatenate([_measured(each) for each in segments])
    load = np.concatenate([each.load_deg for each in segments])
    kind, zero = (
        np.repeat(each, np.diff(edges))
        for each in ([KINDS.index(each.kind) for each in segments], [names[number] for number in numbers])
    )
    reading = reading_of_all(measured, [each.rows for each in chains])
    pieces = []
    for (first, last), chain in zip(spans, chains, strict=True):
        own, rows = segments[first:last], chain.rows
        commanded = all(each.commanded for each in own)
        command = np.concatenate([each.motor_deg for each in own]) if commanded else None
        pieces.append(kinematics(measured[rows], command, time[rows], reading))
    driving, speed, acceleration = (np.concatenate(each) for each in zip(*pieces, strict=True))
    turned = np.concatenate([_has_turned(time[each.rows], driving[each.rows]) for each in chains])
    if not ratio > 0:
        raise InputError(f"{segments[0].name}: the ratio is {ratio:g}; expected more than 0")
    first = zero == zero[0]
    columns = {"time_s": time, "motor_position_deg": measured, "load_position_deg": load}
    Record({name: each[first] for name, each in columns.items()}, segments[0].name).check_ratio(ratio)
    error = load - measured / ratio
    for index in range(len(names)):
        error[zero == index] -= np.median(error[zero == index])
    return Samples(
        ratio=ratio,
        motion=Motion(driving, time, measured_by_all([each.measured for each in segments])),
        load_deg=load,
        error_arcsec=error * ARCSEC_PER_DEG,
        speed_deg_s=speed,
        usable=_usable(time, speed / ratio, acceleration / ratio, kind, slow_deg_s) & ~turned,
        kind=kind,
        zero=zero,
        zeros=len(names),
        count_deg=reading.count_deg,
        chains=tuple(chains),
        travel_deg=max(float(np.ptp(each)) for each in np.split(measured, [edges[index] for index in cuts])),
    )


def follows(before: Segment, segment: Segment) -> bool:
    """Whether the axis can have moved straight from one segment to the next."""
    time_s = np.concatenate([before.time_s[-2:], segment.time_s[:2]])
    motor_deg = np.concatenate([_measured(before)[-2:], _measured(segment)[:2]])
    return segment.follows and not len(jumps(motor_deg, time_s))


def _measured(segment: Segment) -> FloatArray:
    return segment.motor_deg if segment.position_deg is None else segment.position_deg


def _usable(
    time: FloatArray,
    load_speed: FloatArray,
    load_acceleration: FloatArray,
    kind: IntArray,
    slow_deg_s: float | None,
) -> BoolArray:
    """Samples at rest and in slow motions, not within `SETTLE_S` after fast ones.

    A motion counts as a whole, from rest or turn to the next: the start of a fast move is no slow motion. Of
    moves and steps only the rests are used. Where nothing is known of a record, what accelerates is left out.
    """
    moving = np.abs(load_speed)
    own = moving[np.isin(kind, [KINDS.index(each) for each in SLOW]) & (moving > 0)]
    if slow_deg_s is None:
        slow_deg_s = 1.2 * float(np.quantile(own, 0.995)) if len(own) else np.inf
    under_way = moving > STANDING_DEG_S
    fast = under_way & np.isin(kind, [KINDS.index(each) for each in ON_THE_WAY])
    fast |= (kind == KINDS.index(Kind.UNKNOWN)) & (np.abs(load_acceleration) > GENTLE_DEG_S2)
    # Motions that follow one another without a rest are distinguished by their kind and direction.
    changes = [np.diff(each) != 0 for each in (under_way, kind, np.sign(load_speed))]
    first = np.append(0, np.flatnonzero(np.any(changes, axis=0)) + 1)
    fastest = np.repeat(np.maximum.reduceat(moving, first), np.diff(np.append(first, len(time))))
    fast |= under_way & (fastest > slow_deg_s)
    return ~settling(fast, time)


def _has_turned(time: FloatArray, motor_deg: FloatArray) -> BoolArray:
    """Samples within `SETTLE_S` after a turn."""
    turned = np.zeros(len(time), dtype=bool)
    turning, _ = branches(motor_deg)
    for first, last in pairwise(turning[1:]):
        settled = time[first] + min(SETTLE_S, SETTLE_SHARE * float(time[last] - time[first]))
        turned[first + 1 : int(np.searchsorted(time, settled, "right"))] = True
    return turned
