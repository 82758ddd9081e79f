"""Log evidence of theories of one record: linearised at the best parameters with all priors in.

The columns of what stays (zeros, what every axis has, discrepancies of the loop, effects without shapes) are
whitened once per point of the noise grid; those of loops and causes at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from evidence import noise
from evidence.discrepancy import of_loops, of_timing, of_turns, smooth_functions
from evidence.gaussian import Moments, Posterior, posterior
from evidence.scales import Scales
from evidence.smooth import unknown_columns
from evidence.theory import IN_TIME, Parameter, Theory, parameters
from scipy.special import logsumexp

from hdbridge.effects import CATALOGUE, Effect, FloatArray, IntArray, Start, causes, refreshed, unmet
from hdbridge.estimation.calibration import calibrated
from hdbridge.estimation.hypothesis import Estimator
from hdbridge.estimation.observed import gather
from hdbridge.estimation.shapes import free_shapes, moved, shape_value, tangent
from hdbridge.estimation.terms import FOUND
from hdbridge.model import TransmissionModel
from hdbridge.records.record import Record

ZERO_ARCSEC = 1e3
"""An encoder's zero may be anywhere; the same in every theory."""
MOST_POINTS = 5000
"""Longer records are averaged, columns alike: time goes with the points."""
KEPT = 24
"""Whitened columns are kept for so many points of the grid: some megabytes each."""
STEPS = 8
Slack = tuple[float, float]
"""Scale of the discrepancy of the loop, arcsec, and of the laws of causes, share."""
ENOUGH = 0.2
"""A step that gains less, in nats, is the last."""


@dataclass(frozen=True, slots=True, eq=False)
class Fixed:
    """Columns that no parameter moves."""

    columns: FloatArray
    deviation: FloatArray
    """Prior, but for loops' discrepancies: of those the share of their scale."""
    group: IntArray
    """0, or 1 for a discrepancy of the loop."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """A theory about its parameters, at one point of the noise grid."""

    moments: Moments
    mean: FloatArray
    deviation: FloatArray
    group: IntArray
    split: int
    """Columns from here on, up to the discrepancies of laws, are parameters' ..."""
    parameters: tuple[Parameter, ...]
    steady: FloatArray
    """The first columns, which are the same in every step, (m, s)."""
    added: FloatArray
    """The others."""
    residual: FloatArray
    """Of what the parameters say where they stand, (m,)."""

    def columns(self) -> FloatArray:
        """All, (m, p)."""
        return np.hstack([self.steady, self.added])

    def against(self, others: FloatArray) -> FloatArray:
        """Products with other columns (m, g), shape (p, g)."""
        return np.concatenate([self.steady.T @ others, self.added.T @ others])

    def left(self, coefficients: FloatArray) -> FloatArray:
        """The residual with so much of the columns taken off, (m,)."""
        split = self.steady.shape[1]
        return np.asarray(
            self.residual - self.steady @ coefficients[:split] - self.added @ coefficients[split:]
        )

    def posterior(self, slack: Slack) -> Posterior:
        """Under one pair of scales of the discrepancies."""
        deviation = self.deviation * np.array([1.0, *slack])[self.group]
        return posterior(self.moments, self.mean, deviation)

    def objective(self, slack: Slack) -> float:
        """Log posterior density of the parameters where they stand; all else is integrated out."""
        deviation = self.deviation * np.array([1.0, *slack])[self.group]
        own = slice(self.split, self.split + len(self.parameters))
        off = np.divide(
            self.mean[own], deviation[own], out=np.zeros(len(self.parameters)), where=deviation[own] > 0
        )
        deviation[own] = 0.0
        mean = self.mean.copy()
        mean[own] = 0.0
        return posterior(self.moments, mean, deviation).log_evidence - 0.5 * float(off @ off)


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A theory with its best parameters and its log evidence, odds included."""

    theory: Theory
    log_evidence: float
    wander: noise.Wander
    """Most likely point of the noise grid."""
    slack: Slack
    """Most likely scales of the discrepancies."""


def averaging(count: int, most: int) -> IntArray:
    """First samples of runs of two lengths, so that no period is averaged out in all of them."""
    size = -(-count // most)
    if size == 1:
        return np.arange(count, dtype=np.intp)
    starts = np.add.outer(np.arange(0, count, 2 * size - 1), (0, size - 1)).ravel()
    return np.asarray(starts[starts < count], dtype=np.intp)


class Evidence:
    """One record, and the theories of it."""

    def __init__(self, record: Record, model: TransmissionModel, scales: Scales | None = None) -> None:
        self.scales = scales or Scales()
        self.model = model
        data = gather(record, model.ratio, expected=lambda motion: model.predict(motion, Start.VIRGIN))
        self.data = data.over(averaging(len(data.full), MOST_POINTS))
        self.estimator = Estimator(self.data)
        self.parts = calibrated(
            model.effects, model.uncertainty,
            lambda effect: self.estimator.columns(effect, Start.VIRGIN), self.estimator.scales,
        )  # fmt: skip
        turns = of_turns(model.effects, self.data.full.motion, Start.FORWARD)
        white = self.data.points.sigma_arcsec[self.estimator.index]
        timing = self.scales.timing_arcsec * of_timing(self.data.full.motion)
        self.sigma = np.hypot(white, self.estimator.at_points(np.hypot(turns, timing)))
        self.fits = 0
        self._noise: dict[noise.Wander, noise.Noise] = {}
        self._fixed: dict[object, Fixed] = {}
        self._solved: dict[object, tuple[FloatArray, FloatArray, FloatArray]] = {}

    @cached_property
    def smooth(self) -> FloatArray:
        """What a law may have got wrong, of the usable points."""
        return self.estimator.at_points(smooth_functions(self.data.full.motion))

    def noise(self, wander: noise.Wander) -> noise.Noise:
        """One point of the grid."""
        if wander not in self._noise:
            self._noise[wander] = noise.Noise(self.sigma, self.estimator.time_s, wander)
        return self._noise[wander]

    def grid(self, theory: Theory) -> list[noise.Wander]:
        """The wanders that a theory sums over."""
        return noise.unknown(self.scales) if theory.unknown == IN_TIME else noise.ordinary(self.scales)

    def slacks(self, theory: Theory) -> list[Slack]:
        """The scales of the discrepancies that it sums over."""
        scales = self.scales
        loops = (scales.loop_arcsec, scales.loose_arcsec)
        if theory.lawless:
            loops = (scales.other_arcsec, scales.lawless_arcsec)
        laws = (scales.law, scales.rough_law) if theory.causes else (scales.law,)
        return list(product(loops, laws))

    def shapeless(self, theory: Theory) -> list[int]:
        """The model's effects whose columns stay."""
        return [at for at in range(theory.base) if not free_shapes(theory.effects[at], FOUND)]

    def fixed(self, theory: Theory) -> tuple[object, Fixed]:
        """Columns that stay, and what they depend on."""
        loops = tuple(self.model.effects if not theory.lawless else theory.effects)[: theory.base]
        key = (theory.start, theory.replaced, theory.unknown, loops if theory.lawless else ())
        if key not in self._fixed:
            if len(self._fixed) > KEPT:
                self._fixed.clear()
            self._fixed[key] = self._made(theory, refreshed(loops))
        return key, self._fixed[key]

    def _made(self, theory: Theory, loops: Sequence[Effect]) -> Fixed:
        estimator, motion, start = self.estimator, self.data.full.motion, theory.start
        columns = [(estimator.zero[:, np.newaxis] == np.arange(self.data.full.zeros)).astype(np.float64)]
        sizes = [np.full(self.data.full.zeros, ZERO_ARCSEC)]
        for name in causes():
            kind = CATALOGUE[name]
            if kind.ordinary_arcsec and not kind.shape:
                for each in kind.proposals(self.data, self.model.effects):
                    if not unmet([each], motion.available()):
                        columns.append(estimator.columns(each, start))
                        peak = np.maximum(np.max(np.abs(columns[-1]), axis=0), 1e-12)
                        sizes.append(self.scales.ordinary * kind.ordinary_arcsec / peak)
        plain = sum(each.shape[1] for each in columns)
        if theory.unknown and theory.unknown != IN_TIME:
            added = unknown_columns(self.data, theory.unknown)
            columns.append(estimator.at_points(added))
            sizes.append(np.full(added.shape[1], self.scales.size_arcsec))
            plain += added.shape[1]
        columns.append(estimator.at_points(of_loops(loops, motion, start)))
        sizes.append(np.ones(columns[-1].shape[1]))
        whole = np.hstack(columns)
        return Fixed(whole, np.concatenate(sizes), (np.arange(whole.shape[1]) >= plain).astype(np.intp))

    def linearised(self, theory: Theory, wander: noise.Wander) -> Linearised:
        """About the parameters that the theory has."""
        estimator, start = self.estimator, theory.start
        key, fixed = self.fixed(theory)
        steady = self.shapeless(theory)
        told = np.zeros(len(estimator.index))
        found: list[list[Parameter]] = [[], []]
        matrices: list[list[FloatArray]] = [[], []]
        laws = [np.empty((len(told), 0))]
        scales = self.scales
        for at, effect in enumerate(theory.effects):
            columns = estimator.columns(effect, start)
            own = columns @ effect.coefficients()
            told += own
            kind = 0 if at in steady else 1
            peaks = np.max(np.abs(columns), axis=0, initial=0.0)
            found[kind] += parameters(theory, at, self.parts, peaks, scales.size_arcsec, scales.changed)
            tangents = [
                tangent(lambda one: estimator.columns(one, start), effect, each)[:, np.newaxis]
                for each in free_shapes(effect, FOUND)
            ]
            matrices[kind] += [columns, *tangents]
            if at >= theory.base and np.any(own):
                laws.append(own[:, np.newaxis] * self.smooth)
        kernel = self.noise(wander)
        cached = (wander, key, tuple(steady))
        if cached not in self._solved:
            if len(self._solved) > KEPT:
                self._solved.clear()
            columns = np.hstack([fixed.columns, *matrices[0]])
            solved = kernel.solve(columns)
            self._solved[cached] = columns, solved, columns.T @ solved
        columns, solved, gram = self._solved[cached]
        law = np.hstack(laws)
        added = np.hstack([np.empty((len(told), 0)), *matrices[1], law])
        residual = estimator.observed - estimator.level - told
        white = kernel.solve(residual)
        cross = solved.T @ added
        inner = added.T @ kernel.solve(added)
        ordered = (*found[0], *found[1])
        count, split = len(ordered), fixed.columns.shape[1]
        laws_count = law.shape[1]
        moments = Moments(
            np.block([[gram, cross], [cross.T, inner]]),
            np.concatenate([columns.T @ white, added.T @ white]),
            float(residual @ white),
            -0.5 * (kernel.log_determinant + len(residual) * np.log(2.0 * np.pi)),
        )
        nothing, ones = np.zeros(laws_count), np.ones(laws_count)
        mean = np.array([each.mean - each.value for each in ordered])
        deviation = np.array([each.deviation for each in ordered])
        return Linearised(
            moments,
            np.concatenate([np.zeros(split), np.where(deviation > 0.0, mean, 0.0), nothing]),
            np.concatenate([fixed.deviation, deviation, ones]),
            np.concatenate([fixed.group, np.repeat((0, 2), (count, laws_count))]),
            split, ordered, columns, added, residual,
        )  # fmt: skip

    def step(self, here: Linearised, slack: Slack) -> FloatArray:
        """Change of the parameters to their posterior mean, cut at their bounds."""
        mean, deviation = here.mean.copy(), here.deviation.copy()
        for _ in range(4):
            trial = replace(here, mean=mean, deviation=deviation).posterior(slack).mean
            change = trial[here.split : here.split + len(here.parameters)]
            cut = False
            for i, each in enumerate(here.parameters):
                there = min(max(each.value + change[i], each.lower), each.upper)
                if not each.shape and there != each.value + change[i] and deviation[here.split + i] > 0.0:
                    mean[here.split + i], deviation[here.split + i], cut = there - each.value, 0.0, True
            if not cut:
                break
        return np.asarray(change)

    def stepped(self, theory: Theory, here: Linearised, change: FloatArray) -> Theory:
        """The theory with its parameters changed."""
        effects = list(theory.effects)
        for at, effect in enumerate(effects):
            own = [
                (each, float(move))
                for each, move in zip(here.parameters, change, strict=True)
                if each.effect == at
            ]
            coefficients = np.array([each.value + move for each, move in own if not each.shape])
            shapes = {each.name: each for each in effect.shape}
            where = [(0, shapes[each.name]) for each, _ in own if each.shape]
            there: dict[str, float] | None = None
            if where and np.any(effect.coefficients()):
                (other,) = moved([effect], where, np.array([move for each, move in own if each.shape]))
                there = {shape.name: shape_value(other, shape.name) for _, shape in where}
            effects[at] = effect.fitted(coefficients, there)
        return replace(theory, effects=refreshed(effects))

    def fit(self, theory: Theory, wander: noise.Wander | None = None, slack: Slack | None = None) -> Fitted:
        """The best parameters near those of a theory, and its evidence summed over noise and scales."""
        self.fits += 1
        grid, slacks = self.grid(theory), self.slacks(theory)
        wander = wander if wander in grid else grid[-1]
        slack = slack if slack in slacks else slacks[0]
        here = self.linearised(theory, wander)
        value = here.objective(slack)
        for _ in range(STEPS):
            change = self.step(here, slack)
            share, better = 1.0, False
            while share > 0.05 and not better:
                trial = self.stepped(theory, here, share * change)
                there = self.linearised(trial, wander)
                reached = there.objective(slack)
                better = reached > value
                share *= 0.4
            if not better:
                break
            gained, value = reached - value, reached
            theory, here = trial, there
            if gained < ENOUGH:
                break
        table = np.array(
            [[each.posterior(scale).log_evidence for scale in slacks]
             for each in (here if one == wander else self.linearised(theory, one) for one in grid)]
        )  # fmt: skip
        best = np.unravel_index(int(np.argmax(table)), table.shape)
        total = float(logsumexp(table)) - np.log(table.size) + self.log_odds(theory)
        if any(each.violations() or each.implausible(self.data) or each.unidentifiable(self.data)
               for each in theory.causes):  # fmt: skip
            total = -np.inf
        return Fitted(theory, total, grid[best[0]], slacks[best[1]])

    def peek(self, theory: Theory, like: Fitted) -> float:
        """Evidence where the parameters stand, at the noise of another fit, the loop's best scale."""
        here = self.linearised(theory, like.wander)
        return self.log_odds(theory) + max(here.posterior(each).log_evidence for each in self.slacks(theory))

    def log_odds(self, theory: Theory) -> float:
        """Prior of a theory: the odds of each of its causes, and of the places where each may be."""
        strange = bool(theory.unknown) + theory.lawless
        known = len(theory.causes) + len(theory.changed) + bool(theory.replaced)
        # Beside what no law describes the likelihood is wrong, and evidence counts for less.
        known_for = known / self.scales.tempering if strange else known
        return (known_for + strange) * float(np.log(self.scales.odds)) - float(np.sum(np.log(theory.places)))
