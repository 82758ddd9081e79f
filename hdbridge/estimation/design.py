"""Columns of a fit, averaged over blocks, for effects that know nothing of blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hdbridge.effects import Effect, FloatArray, IntArray, Start
from hdbridge.effects.base import Memoryless
from hdbridge.effects.path import branches
from hdbridge.estimation.blocks import Blocks
from hdbridge.estimation.linear import side_by_side
from hdbridge.estimation.samples import Samples, motion_at
from hdbridge.estimation.shapes import unit


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Samples, their blocks, and the elastic state in which each chain begins."""

    samples: Samples
    blocks: Blocks
    starts: tuple[Start, ...]
    sketch: tuple[tuple[IntArray, IntArray], ...]
    """Per chain: samples that stand for all (blocks' middles and turns), and which are middles."""

    memo: dict[Effect, FloatArray] = field(default_factory=dict)
    """Columns of effects without shape or memory, which are asked for again and again."""

    @classmethod
    def of(cls, samples: Samples, blocks: Blocks, starts: Sequence[Start]) -> Design:
        """Prepare columns for these blocks."""
        return cls(samples, blocks, tuple(starts), tuple(_sketches(samples, blocks)))

    def beginning(self, starts: Sequence[Start]) -> Design:
        """The same with other states at the start."""
        return replace(self, starts=tuple(starts))

    def roughly(self, effect: Effect) -> FloatArray:
        """Columns in which the middles of the blocks stand for all samples."""
        return self.columns(effect, exact=False)

    def columns(self, effect: Effect, exact: bool = True) -> FloatArray:
        """Columns of an effect, shape (b, p); ``exact`` averages all samples, else middles stand for them."""
        if exact and not effect.shape and isinstance(effect.tracker(), Memoryless):
            return side_by_side([self._kept(unit(each)) for each in effect.pieces()], len(self.blocks))
        width = len(effect.coefficients())
        result = np.empty((len(self.samples) if exact else len(self.blocks), width))
        for number, (chain, start) in enumerate(zip(self.samples.chains, self.starts, strict=True)):
            motion = self.samples.along(chain)
            if exact:
                result[chain.rows] = effect.columns(motion, start)
            else:
                picked, middles = self.sketch[number]
                inside = self.blocks.chain == number
                result[inside] = effect.columns(motion_at(motion, picked), start)[middles]
        return self.blocks.mean(result) if exact else result

    def _kept(self, piece: Effect) -> FloatArray:
        if piece not in self.memo:
            self.memo[piece] = self.blocks.mean(piece.columns(self.samples.motion))
        return self.memo[piece]

    def told(self, effects: Sequence[Effect], exact: bool = True) -> FloatArray:
        """What effects say together, shape (b,)."""
        parts = (self.columns(each, exact) @ each.coefficients() for each in effects)
        return np.asarray(sum(parts, start=np.zeros(len(self.blocks))))

    def turn_effects(self, effects: Sequence[Effect]) -> tuple[FloatArray, FloatArray, IntArray]:
        """What a reach further at the turn before would change, arcsec (b,), what share of that reach may lie
        between two samples (b,), and which turn it is (b,).

        The reach is within what a turn is known: the count, and twice what may lie between two samples.
        Every turn is moved outwards at once; what is seen on a branch is put down to the turn that began it.
        """
        change, missed = np.zeros((2, len(self.blocks)))
        turn = np.zeros(len(self.blocks), dtype=np.intp)
        last = 0
        for number, (chain, start) in enumerate(zip(self.samples.chains, self.starts, strict=True)):
            picked, middles = self.sketch[number]
            motion = motion_at(self.samples.along(chain), picked)
            turning, signs = branches(motion.motor_deg, Start.VIRGIN)
            inside = self.blocks.chain == number
            branch = np.searchsorted(turning, middles, "left")
            turn[inside] = last + branch
            last += len(turning) + 1
            at = picked[turning[1:-1]]
            between = missed_deg(self.samples.motor_deg[chain.rows], at)
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
        """The same, each block's variance raised by what rounding of the driving angle does to the effects.

        Just after a turn a hysteresis may rise without bound: what is measured there says little, and should
        not say much.
        """
        change, _, _ = self.turn_effects(effects)
        return replace(self, blocks=replace(self.blocks, blur=change**2 / 12.0))

    def residual(self, effects: Sequence[Effect], rest: FloatArray) -> FloatArray:
        """Observation minus effects per sample, minus ``rest`` per block; NaN where not usable."""
        left = self.samples.error_arcsec.copy()
        for chain, start in zip(self.samples.chains, self.starts, strict=True):
            for effect in effects:
                left[chain.rows] -= effect.predict(self.samples.along(chain), start)
        result = np.full(len(left), np.nan)
        index = self.blocks.index
        result[index] = left[index] - np.repeat(rest, self.blocks.sizes)
        return result


def harmonics(design: Design, orders: Sequence[float]) -> FloatArray:
    """Cosine and sine of each order of the motor angle, block averages, shape (blocks, 2 * orders).

    Orders need not be whole numbers: 1 / N is once per load turn, k (1 + 1/N) the flexspline's.
    """
    angles = (np.deg2rad(each) * design.samples.motor_deg for each in orders)
    parts = [design.blocks.mean(np.stack([np.cos(each), np.sin(each)], axis=1)) for each in angles]
    return side_by_side(parts, len(design.blocks))


def _sketches(samples: Samples, blocks: Blocks) -> list[tuple[IntArray, IntArray]]:
    result = []
    for number, chain in enumerate(samples.chains):
        middles = blocks.middle[blocks.chain == number] - chain.rows.start
        motor_deg = samples.motor_deg[chain.rows]
        turning, _ = branches(motor_deg, Start.VIRGIN)
        first_moves = np.flatnonzero(np.diff(motor_deg))[:1]
        picked = np.unique(np.concatenate([middles, turning, first_moves]).astype(np.intp))
        result.append((picked, np.searchsorted(picked, middles)))
    return result


def clusters(blocks: Blocks, number: int) -> IntArray:
    """Blocks in about so many stretches of measured time, each of one chain; a number per block."""
    gone = np.concatenate([[0.0], np.cumsum(np.clip(np.diff(blocks.time_s), 0.0, 1.0))])
    span_s = max(float(gone[-1]) / number, 1e-9)
    cut = (np.diff(np.floor(gone / span_s)) != 0) | (np.diff(blocks.chain) != 0)
    return np.concatenate([[0], np.cumsum(cut)]).astype(np.intp)


def missed_deg(motor_deg: FloatArray, turns: IntArray) -> FloatArray:
    """How much further than at the sample of each turn the motor may have been, shape of ``turns``.

    Between two samples at one speed each way the lines before and after meet so far outside. A motor that
    rests where it turns was read there.
    """

    def step(way: int) -> FloatArray:
        other = np.clip(turns + way, 0, len(motor_deg) - 1)
        return np.asarray(np.abs(motor_deg[other] - motor_deg[turns]))

    longest = np.minimum(step(-2), step(2))
    return np.asarray(0.5 * np.minimum(np.abs(step(1) - step(-1)), longest))
