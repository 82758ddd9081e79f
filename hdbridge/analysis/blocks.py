"""Averages samples over short blocks, which reduces a million rows to some ten thousand.

Columns are averaged like the observations, so a linear model of the samples is the same linear model of the
blocks. Only the variation within a block is lost. Blocks are short just after a reversal, where the
hysteresis is steep, and never cross a turning point, a gap or unusable samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from hdbridge.analysis.linear import side_by_side
from hdbridge.analysis.prepared import Samples
from hdbridge.analysis.regressors import Regressors
from hdbridge.axis.effects import BoolArray, Effect, FloatArray, IntArray, Start
from hdbridge.axis.effects.described import Memoryless
from hdbridge.axis.effects.orders import waves
from hdbridge.axis.effects.path import branches, since_reversal_deg
from hdbridge.units import ARCSEC_PER_DEG

TARGET_BLOCKS = 30_000
LONGEST_S = 0.25
FINE_DEG = 0.4
"""Scale of the block length after a reversal. The length of a block is a twentieth of the sum of this angle
and the travel since the reversal."""
REST_DEG_S = 0.05
"""Maximum motor speed at which an axis counts as being at rest."""
AVERAGED_COUNTS_S = 200.0
"""Count rate, counts/s, above which rounding averages out, because a servo passes several counts before it
responds."""
LOCKED_COUNTS = 0.15
"""Standard deviation of a leg's mean rounding error at low speed, counts. If sampling is in step with the
counts, all readings of a leg lie at the same few positions within a count."""
LEAST_LOCKED_COUNTS = 0.03
"""Minimum standard deviation of a leg's mean rounding error at any speed, counts."""


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Blocks of samples; arrays of shape (b,) unless stated otherwise."""

    index: IntArray
    """Indices of the usable samples, shape (u,)."""
    first: IntArray
    """Position in ``index`` of the first sample of each block."""
    weight: FloatArray
    """Weight of each usable sample, shape (u,): 1, or 0 for an outlier."""
    count: FloatArray
    """Sum of the sample weights in a block."""
    time_s: FloatArray
    duration_s: FloatArray
    motor_deg: FloatArray
    travel_deg: FloatArray
    """Motor travel since the first sample; both directions count as positive."""
    extent_deg: FloatArray
    """Motor travel within the block."""
    speed_deg_s: FloatArray
    moving: BoolArray
    heading: FloatArray
    """Direction of motion, 1 or -1; the last direction at rest, 0 before the first motion."""
    kind: IntArray
    zero: IntArray
    chain: IntArray
    middle: IntArray
    """Index of the middle sample of each block."""
    error_arcsec: FloatArray
    leg: IntArray
    """Number of the leg that contains the block. A leg extends from one turning point to the next."""
    locked_arcsec: FloatArray
    """Standard deviation of that part of the motor angle's rounding error that is constant over a leg."""
    since_turn_deg: FloatArray
    """Motor travel since the last turning point."""
    blur: FloatArray
    """Variance of each block due to the uncertainty of the motor's turning points, arcsec squared."""

    def __len__(self) -> int:
        return len(self.first)

    @property
    def sizes(self) -> IntArray:
        """Number of usable samples in each block, including outliers."""
        return np.diff(np.append(self.first, len(self.index)))

    def mean(self, values: FloatArray) -> FloatArray:
        """Averages a per-sample quantity (n,) or (n, p) over each block: (b,) or (b, p)."""
        picked = values[self.index]
        spread = (slice(None), np.newaxis)[: picked.ndim]
        total = np.add.reduceat(picked * self.weight[spread], self.first, axis=0)
        return np.asarray(total / np.maximum(self.count, 1e-300)[spread])

    def picked(self, index: IntArray | BoolArray) -> Blocks:
        """Returns the selected blocks, each represented by its middle sample."""
        own = {"index", "first", "weight"}
        kept = {each.name: getattr(self, each.name)[index] for each in fields(self) if each.name not in own}
        middle = self.middle[index]
        return Blocks(middle, np.arange(len(middle)), np.ones(len(middle)), **kept)


def make_blocks(samples: Samples, weight: FloatArray | None = None) -> Blocks:
    """Divides the usable samples into blocks. ``weight`` is 0 for each outlier and 1 for other samples."""
    index = np.flatnonzero(samples.usable)
    motor, time = samples.motor_deg, samples.time_s
    parts = [motor[each.rows] for each in samples.chains]
    travels = [_travel(each) for each in parts]
    coarsest = float(np.clip(sum(each[-1] for each in travels) / TARGET_BLOCKS, 1.0, 6.0))
    turnings = [branches(each)[0] for each in parts]
    travel, heading = np.concatenate(travels), np.concatenate([_heading(each) for each in parts])
    key = np.concatenate([_cells(*each, coarsest) for each in zip(parts, turnings, strict=True)])
    chain = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
    legs = [
        np.searchsorted(turns[1:-1], np.arange(len(each)))
        for each, turns in zip(parts, turnings, strict=True)
    ]
    before = np.cumsum([0, *(each[-1] + 1 for each in legs[:-1])])
    leg = np.concatenate([each + first for each, first in zip(legs, before, strict=True)])
    resting = np.abs(samples.speed_deg_s) <= REST_DEG_S
    cut = np.diff(index, prepend=-2) != 1
    for each in (key, samples.kind, chain, resting, np.floor(time / LONGEST_S)):
        cut[1:] |= each[index[1:]] != each[index[:-1]]
    first = np.flatnonzero(cut)
    last = np.append(first[1:], len(index)) - 1
    weights = np.ones(len(index)) if weight is None else weight[index]
    count = np.add.reduceat(weights, first)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values[index], first) / (last - first + 1))

    weighted_error = np.add.reduceat(samples.error_arcsec[index] * weights, first) / np.maximum(count, 1e-300)
    middle = index[(first + last) // 2]
    speed, moving = mean(samples.speed_deg_s), ~resting[middle]
    rounding_arcsec = samples.count_deg / samples.ratio * ARCSEC_PER_DEG
    return Blocks(
        index=index,
        first=first,
        weight=weights,
        count=count,
        time_s=mean(time),
        duration_s=time[index[last]] - time[index[first]],
        motor_deg=mean(motor),
        travel_deg=mean(travel),
        extent_deg=travel[index[last]] - travel[index[first]],
        speed_deg_s=speed,
        moving=moving,
        heading=heading[middle],
        kind=samples.kind[middle],
        zero=samples.zero[middle],
        chain=chain[middle],
        middle=middle,
        error_arcsec=weighted_error,
        leg=leg[middle],
        locked_arcsec=moving * locked_counts(speed, samples.count_deg) * rounding_arcsec,
        since_turn_deg=mean(np.concatenate([since_reversal_deg(each) for each in parts])),
        blur=np.zeros(len(first)),
    )


def locked_counts(speed_deg_s: FloatArray, count_deg: float) -> FloatArray:
    """Returns the standard deviation of a leg's constant rounding error, counts, for each motor speed."""
    rate = np.abs(speed_deg_s) / max(count_deg, 1e-12)
    share = np.minimum(1.0, AVERAGED_COUNTS_S / np.maximum(rate, 1.0))
    return np.maximum(LOCKED_COUNTS * share, LEAST_LOCKED_COUNTS)


def _travel(motor_deg: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(motor_deg)))])


def _heading(motor_deg: FloatArray) -> FloatArray:
    steps = np.sign(np.diff(motor_deg, prepend=motor_deg[:1]))
    last = np.maximum.accumulate(np.where(steps != 0, np.arange(len(steps)), 0))
    return np.asarray(steps[last])


def _cells(motor_deg: FloatArray, turning: Sequence[int], coarsest_deg: float) -> IntArray:
    """Divides the travel since the last turning point into cells, and returns each sample's cell number."""
    cells = np.zeros(len(motor_deg), dtype=np.int64)
    edge = 20.0 * coarsest_deg - FINE_DEG  # beyond it, all cells have the coarsest size
    base = 0
    for first, last in pairwise(turning):
        since = np.abs(motor_deg[first + 1 : last + 1] - motor_deg[first])
        near = 20.0 * np.log1p(np.minimum(since, edge) / FINE_DEG)
        number = np.floor(near + np.maximum(since - edge, 0.0) / coarsest_deg).astype(np.int64)
        cells[first + 1 : last + 1] = base + 1 + number
        base = int(cells[last]) + 1
    return cells


# Design of a calibration fit.


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Samples, their blocks, and the elastic state at the start of each chain."""

    samples: Samples
    blocks: Blocks
    starts: tuple[Start, ...]
    regressors: Regressors

    @classmethod
    def of(cls, samples: Samples, blocks: Blocks, starts: Sequence[Start]) -> Design:
        """Creates a design with regressors averaged over these blocks."""
        motions = [samples.along(each) for each in samples.chains]
        return cls(samples, blocks, tuple(starts), Regressors(motions, blocks.mean, len(blocks)))

    def beginning(self, starts: Sequence[Start]) -> Design:
        """Returns the design with the given elastic states at the starts of its chains."""
        return replace(self, starts=tuple(starts))

    def columns(self, effect: Effect) -> FloatArray:
        """Returns the block averages of an effect's regressors, shape (b, p)."""
        return self.regressors.columns(effect, self.starts)

    def predict(self, effects: Sequence[Effect]) -> FloatArray:
        """Returns the transmission error due to all effects, arcsec, shape (b,)."""
        return self.regressors.predict(effects, self.starts)

    def turn_effects(self, effects: Sequence[Effect]) -> tuple[FloatArray, FloatArray, IntArray]:
        """Returns the influence of the last turning point on each block, three arrays of shape (b,).

        The reach is the uncertainty of a turning point: one count plus twice the overshoot between samples.
        The arrays are the change of the transmission error, arcsec, for a shift of the turning point outwards
        by its reach; the fraction of the reach that is due to sampling; and the number of the turning point.
        All turning points are shifted at once. A change on a branch is attributed to the turning point at its
        start.
        """
        change, missed = np.zeros((2, len(self.blocks)))
        turn = np.zeros(len(self.blocks), dtype=np.intp)
        last = 0
        along = zip(self.samples.chains, self.regressors.motions, self.starts, strict=True)
        for number, (chain, motion, start) in enumerate(along):
            turning, signs = branches(motion.motor_deg, Start.VIRGIN)
            inside = self.blocks.chain == number
            middles = self.blocks.middle[inside] - chain.rows.start
            branch = np.searchsorted(turning, middles, "left")
            turn[inside] = last + branch
            last += len(turning) + 1
            between = missed_deg(motion.motor_deg, np.array(turning[1:-1], dtype=np.intp))
            reach = self.samples.count_deg + 2.0 * between
            if not np.any(reach):
                continue
            share = np.concatenate([[0.0], between / np.maximum(reach, 1e-12), [0.0]])
            missed[inside] = share[branch - 1]
            moved_motor = motion.motor_deg.copy()
            moved_motor[turning[1:-1]] += 0.5 * reach * np.array(signs[:-1])
            other = replace(motion, motor_deg=moved_motor)
            for effect in effects:
                if not isinstance(effect.tracker(), Memoryless):
                    change[inside] += (effect.predict(other, start) - effect.predict(motion, start))[middles]
        return 2.0 * change, missed, turn

    def blurred(self, effects: Sequence[Effect]) -> Design:
        """Returns the design with the variance that rounding of the motor angle adds to each block.

        Just after a turning point a hysteresis may be arbitrarily steep, so measurements there get little
        weight.
        """
        change, _, _ = self.turn_effects(effects)
        return replace(self, blocks=replace(self.blocks, blur=change**2 / 12.0))

    def residual(self, effects: Sequence[Effect], rest: FloatArray) -> FloatArray:
        """Returns the residual of each sample, arcsec; NaN for unusable samples.

        The residual is the observed error less the contributions of ``effects`` and, for each block,
        ``rest``.
        """
        left = self.samples.error_arcsec - self.regressors.predicted(effects, self.starts)
        result = np.full(len(left), np.nan)
        index = self.blocks.index
        result[index] = left[index] - np.repeat(rest, self.blocks.sizes)
        return result


def harmonics(design: Design, orders: Sequence[float]) -> FloatArray:
    """Returns block averages of the cosine and sine of each motor order, shape (blocks, 2 * orders).

    Orders need not be integers: 1 / N is one cycle per load turn, and k (1 + 1/N) a flexspline order.
    """
    found = waves(np.deg2rad(design.samples.motor_deg), orders)
    parts = [design.blocks.mean(each.view(np.float64).reshape(-1, 2)) for each in found]
    return side_by_side(parts, len(design.blocks))


def clusters(blocks: Blocks, number: int) -> IntArray:
    """Divides the measured time into about ``number`` stretches, each within one chain.

    Returns the number of each block's stretch.
    """
    gone = np.concatenate([[0.0], np.cumsum(np.clip(np.diff(blocks.time_s), 0.0, 1.0))])
    span_s = max(float(gone[-1]) / number, 1e-9)
    cut = (np.diff(np.floor(gone / span_s)) != 0) | (np.diff(blocks.chain) != 0)
    return np.concatenate([[0], np.cumsum(cut)]).astype(np.intp)


def missed_deg(motor_deg: FloatArray, turns: IntArray) -> FloatArray:
    """Returns the possible motor travel beyond the sample at each turning point, degrees, shape of ``turns``.

    Straight lines through the samples before and after, at constant speed, intersect at this distance beyond
    the sample. The result is 0 for a motor that rests at the turning point.
    """

    def step(way: int) -> FloatArray:
        other = np.clip(turns + way, 0, len(motor_deg) - 1)
        return np.asarray(np.abs(motor_deg[other] - motor_deg[turns]))

    longest = np.minimum(step(-2), step(2))
    return np.asarray(0.5 * np.minimum(np.abs(step(1) - step(-1)), longest))
