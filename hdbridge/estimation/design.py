"""Calibration's observations: samples, their blocks, and the elastic state in which each chain begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdbridge.effects import Effect, FloatArray, IntArray, Start
from hdbridge.effects.base import Memoryless
from hdbridge.effects.path import branches
from hdbridge.estimation.blocks import Blocks
from hdbridge.estimation.linear import side_by_side
from hdbridge.estimation.regressors import Regressors
from hdbridge.estimation.samples import Samples


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Samples, their blocks, and the elastic state in which each chain begins."""

    samples: Samples
    blocks: Blocks
    starts: tuple[Start, ...]
    regressors: Regressors

    @classmethod
    def of(cls, samples: Samples, blocks: Blocks, starts: Sequence[Start]) -> Design:
        """Prepare columns for these blocks."""
        motions = [samples.along(each) for each in samples.chains]
        return cls(samples, blocks, tuple(starts), Regressors(motions, blocks.mean, len(blocks)))

    def beginning(self, starts: Sequence[Start]) -> Design:
        """The same with other states at the start."""
        return replace(self, starts=tuple(starts))

    def columns(self, effect: Effect) -> FloatArray:
        """Regressors of an effect, block averages, shape (b, p)."""
        return self.regressors.columns(effect, self.starts)

    def told(self, effects: Sequence[Effect]) -> FloatArray:
        """What effects say together, shape (b,)."""
        return self.regressors.told(effects, self.starts)

    def turn_effects(self, effects: Sequence[Effect]) -> tuple[FloatArray, FloatArray, IntArray]:
        """What a reach further at the turn before would change, arcsec (b,), what share of that reach may lie
        between two samples (b,), and which turn it is (b,).

        The reach is within what a turn is known: the count, and twice what may lie between two samples.
        Every turn is moved outwards at once; what is seen on a branch is put down to the turn that began it.
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
        """The same, each block's variance raised by what rounding of the driving angle does to the effects.

        Just after a turn a hysteresis may rise without bound: what is measured there says little, and should
        not say much.
        """
        change, _, _ = self.turn_effects(effects)
        return replace(self, blocks=replace(self.blocks, blur=change**2 / 12.0))

    def residual(self, effects: Sequence[Effect], rest: FloatArray) -> FloatArray:
        """Observation minus effects per sample, minus ``rest`` per block; NaN where not usable."""
        left = self.samples.error_arcsec - self.regressors.predicted(effects, self.starts)
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
