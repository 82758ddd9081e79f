"""A hypothesis: effects and zeros, fitted together with everything that is free (`separable`).

The baseline is refitted with every candidate, so what the baseline can take over is never called a finding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hdbridge.analysis.blocks import missed_deg
from hdbridge.analysis.calibrated import CalibratedPart, priors
from hdbridge.analysis.driving import CHATTER_COUNTS
from hdbridge.analysis.linear import LOCAL, Column, Effort, Linearised, Nuisances, Prior, Terms, unknown
from hdbridge.analysis.noise import White
from hdbridge.analysis.nuisances import COUNTS, zeros
from hdbridge.analysis.prepared import Observed
from hdbridge.analysis.regressors import Regressors
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.separable import Separable, Solution, unit
from hdbridge.effects import Channel, Effect, FloatArray, IntArray, Motion, Moves, Part, Start
from hdbridge.effects.path import branches
from hdbridge.effects.play import stop
from hdbridge.units import ARCSEC_PER_DEG

ENOUGH = Effort(steps=8, converged=0.5, roughly=2e-5)
"""A search compares hypotheses whose chi squares are tens and more apart."""
NOISY = frozenset({Channel.LOAD_TORQUE, Channel.MOTOR_TORQUE})
"""Measured channels of which each reading has its own noise that goes into a column as it is."""
SMOOTH = 15
"""Samples about whose parabola a reading of such a channel is noise,"""
WHITE = 1.17
"""... of which that shows five sixths; less 3 %, as well as it is known."""
MOST_TURNS = 100
"""Maximum number of turning points with an error of their own; of more, the mean is known well enough."""
SHORT = 10_000
"""Samples: what is rare in a shorter record is rarer in proportion."""
STOPS_DEG = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Widths of the stop operators of the free-form hysteresis."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects (the baseline's first), the elastic state at the first sample, and what may be fitted in
    addition to them.
    """

    effects: tuple[Effect, ...]
    start: Start = Start.VIRGIN
    nuisances: Nuisances | None = None
    """In addition to the zeros, rows of the usable points; the same only where it is the same object."""

    def plus(self, effect: Effect) -> Hypothesis:
        """With one more effect."""
        return replace(self, effects=(*self.effects, effect))

    def without(self, place: int) -> Hypothesis:
        """With one effect less."""
        return replace(self, effects=self.effects[:place] + self.effects[place + 1 :])

    def instead(self, place: int, effect: Effect) -> Hypothesis:
        """With one effect exchanged."""
        return replace(self, effects=(*self.effects[:place], effect, *self.effects[place + 1 :]))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis with its best parameters."""

    hypothesis: Hypothesis
    zeros: FloatArray
    residual: FloatArray
    """Weighted residual of the usable points, shape (m,)."""
    parameters: tuple[Column, ...]
    """What the columns of the tangent matrix stand for."""
    chi_square: float
    _solution: Solution = field(repr=False)
    _weight: FloatArray = field(repr=False)

    @cached_property
    def linearised(self) -> Linearised:
        """In units of the noise."""
        weighted = self._solution.jacobian * self._weight[:, np.newaxis]
        return Linearised(weighted, self.residual, self._solution.known)

    @property
    def tangent(self) -> FloatArray:
        """Weighted derivatives, shape (m, p)."""
        return self.linearised.columns

    @property
    def information(self) -> FloatArray:
        """What was known of each column beforehand: one over its variance, shape (p,)."""
        return self.linearised.known[:, 0]

    def count(self) -> int:
        """Columns of the tangent matrix."""
        return len(self.parameters)

    def free(self) -> int:
        """Parameters that do anything in this record."""
        return self._solution.free()

    def places(self, effect: int) -> IntArray:
        """Columns of one effect."""
        return np.array([i for i, each in enumerate(self.parameters) if each.effect == effect], dtype=np.intp)


class Estimator:
    """Fits theories to one body of evidence; keeps columns that are asked for again and again."""

    def __init__(self, data: Observed, scales: Scales | None = None) -> None:
        points = data.points
        self.data = data
        self.scales = scales or Scales()
        """The numbers that decide what is named."""
        self.index: IntArray = np.flatnonzero(points.usable)
        self.weight: FloatArray = 1.0 / points.sigma_arcsec[self.index]
        self.observed: FloatArray = points.error_arcsec[self.index]
        self.time_s: FloatArray = points.time_s[self.index]
        self.zero: IntArray = points.zero[self.index]
        self._regressors = Regressors([data.full.motion], self.at_points, len(self.index))
        self._noise: dict[object, FloatArray] = {}
        self._free_loops: dict[Start, Nuisances] = {}
        # About the level that they have in common: an encoder's zero is no part of the physics.
        self.level = float(np.median(self.observed))
        self.loop_sign = 1.0
        """Of the loop's offset: -1 where the load lags."""
        self.calibrated: tuple[CalibratedPart, ...] = ()
        """What is known of the first effects of each hypothesis beforehand."""

    @property
    def motion(self) -> Motion:
        """What drove the axis, point by point (all points, the elastic state passes through each)."""
        return self.data.points.motion

    @property
    def rare(self) -> float:
        """Share of the record in which a quantity may be larger, and in which smaller, than it is said to
        be.
        """
        return self.scales.rare / max(len(self.data.full), SHORT)

    def half_span(self, values: FloatArray) -> float:
        """Half the span of values, but for what is rare at either end."""
        low, high = np.quantile(values, [self.rare, 1.0 - self.rare])
        return 0.5 * float(high - low)

    def columns(self, effect: Effect, start: Start) -> FloatArray:
        """Regressors of an effect at the usable points, arcsec, shape (m, p): means over their samples."""
        return self._regressors.columns(effect, (start,))

    def at_points(self, values: FloatArray) -> FloatArray:
        """Of every sample to the usable points, as the observations are averaged."""
        means = self.data.mean(values)
        return means if len(means) == len(self.index) else np.asarray(means[self.index])

    def does(self, effect: Effect, start: Start) -> FloatArray:
        """What an effect does in the usable samples, arcsec; in means a fast one would seem smaller."""
        full = self.data.full
        if len(full) == len(self.data.points):
            return np.asarray(self.columns(effect, start) @ effect.coefficients())
        return effect.predict(full.motion, start)[full.usable]

    def weighted(self, columns: FloatArray) -> FloatArray:
        """Columns in units of the noise."""
        return np.asarray(columns * self.weight[:, np.newaxis])

    def law_discrepancy(self, effect: Effect, start: Start) -> FloatArray:
        """What an effect's law may be wrong by, a weighted column per standard deviation, shape (m, k)."""
        return self.weighted(self.at_points(effect.law_discrepancy(self.data.full.motion, start)))

    def angle_discrepancy(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """What the driving angle may be wrong by within its counts, a weighted column, shape (m, 1).

        The error is against that angle, and a loop is steepest where the motor stops.
        """
        full = self.data.full
        other = replace(full.motion, motor_deg=full.rested_deg)
        change = (full.rested_deg - full.motor_deg) * (ARCSEC_PER_DEG / full.ratio)
        for each in effects:
            if each.tracker().memory_deg > 0.0:
                change = change + each.predict(other, start) - each.predict(full.motion, start)
        return self.weighted(self.at_points(change)[:, np.newaxis])

    def turn_discrepancy(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """Errors of turning points within their counts, a weighted column per standard deviation, (m, k).

        A motor with friction stops short of all turns alike, and of each by its own amount. One column is for
        all turns, and unless there are more than `MOST_TURNS`, one for each.
        """
        full, loops = self.data.full, [each for each in effects if each.tracker().memory_deg > 0.0]
        turning, signs = branches(full.motor_deg, start)
        turns = np.array(turning[1:-1], dtype=np.intp)
        if not loops or not len(turns):
            return np.empty((len(self.index), 0))
        count = full.reading.resolution_deg if full.commanded else CHATTER_COUNTS * full.reading.unaided_deg
        moved = full.motor_deg.copy()
        moved[turns] += (COUNTS * count + missed_deg(full.motor_deg, turns)) * np.array(signs[:-1])
        other = replace(full.motion, motor_deg=moved)
        change = sum(each.predict(other, start) - each.predict(full.motion, start) for each in loops)
        columns = [self.at_points(np.asarray(change))]
        if len(turns) <= MOST_TURNS:
            leg = np.searchsorted(turns, self.data.runs[self.index], "right")
            columns += [np.where(leg == each, columns[0], 0.0) for each in range(1, len(turns) + 1)]
        return self.weighted(np.column_stack(columns))

    def free_loop(self, start: Start) -> Nuisances:
        """A free-form hysteresis: stop operators of `STOPS_DEG`, which make a loop of any shape with
        memory.
        """
        if start not in self._free_loops:
            angle = self.data.full.motion.motor_deg
            stops = {f"stop of {each:g} deg": self.at_points(stop(angle, each, start)) for each in STOPS_DEG}
            self._free_loops[start] = unknown(np.stack([*stops.values()], axis=1), [*stops])
        return self._free_loops[start]

    def fit(self, hypothesis: Hypothesis, moves: frozenset[Moves] = LOCAL, effort: Effort = ENOUGH) -> Fitted:
        """The minimum near where the hypothesis stands, and never worse; shapes move as ``moves`` says.

        Every part is as calibrated at first; those that cost less as changed ones become free one by one.
        """
        parts, costs = list(self.calibrated), 0.0
        while True:
            fitted = self._with_parts(hypothesis, parts, costs, moves, effort)
            effects = fitted.hypothesis.effects
            most = max(parts, key=lambda each: each.strain(effects) - each.change_cost, default=None)
            if most is None or most.strain(effects) <= most.change_cost:
                return fitted
            parts.remove(most)
            costs += most.change_cost
            hypothesis = fitted.hypothesis

    def _prior(
        self, hypothesis: Hypothesis, parts: Sequence[CalibratedPart]
    ) -> tuple[dict[tuple[int, str], Prior], float]:
        """With what the noise of measured channels claims taken back, and what that adds to chi square."""
        known, offset = priors(parts), 0.0
        for place in {each.place for each in parts}:
            claimed = self.channel_noise(hypothesis.effects[place], hypothesis.start)
            for number in np.flatnonzero(claimed).tolist():
                mean, information = known[place, str(number)]
                left = information - float(claimed[number])
                known[place, str(number)] = Prior(mean * information / left, left)
                offset -= information * mean**2 * float(claimed[number]) / left
        return known, offset

    def channel_noise(self, effect: Effect, start: Start) -> FloatArray:
        """Squares that the noise of measured channels puts into an effect's columns, weighted, shape (p,).

        Errors in variables: a fit looks better the smaller the coefficient is that multiplies such noise.
        What a coefficient of one gains by it is taken back (Fuller 1987, 2.2) where its calibration holds it:
        without one, what only noise distinguishes would have any size.
        """
        motion = self.data.full.motion
        channels = sorted(effect.needs() & NOISY & motion.measured.keys(), key=lambda each: each.value)
        if not channels:
            return np.zeros(len(effect.coefficients()))
        key = (unit(effect), start)
        if key not in self._noise:
            noisy = {each: _smooth(motion.measured[each]) for each in channels}
            other = effect.columns(replace(motion, measured={**motion.measured, **noisy}), start)
            apart = self.weighted(self.at_points(other) - self.columns(effect, start))
            self._noise[key] = np.asarray(WHITE * np.sum(apart**2, axis=0))
        return self._noise[key]

    def _with_parts(
        self,
        hypothesis: Hypothesis,
        parts: Sequence[CalibratedPart],
        costs: float,
        moves: frozenset[Moves],
        effort: Effort,
    ) -> Fitted:
        """The minimum where these ``parts`` are as calibrated, and changes of others have their ``costs``."""
        start = hypothesis.start
        prior, offset = self._prior(hypothesis, parts)
        costs += offset
        terms = Terms(
            self.observed - self.level,
            lambda effect: self.columns(effect, start),
            White(self.weight),
            self._nuisances(hypothesis),
            prior,
            self._sign,
            moves,
        )
        found = Separable(terms).fit(hypothesis.effects, effort)
        return Fitted(
            replace(hypothesis, effects=found.effects),
            found.nuisances[: self.data.full.zeros],
            found.residual * self.weight,
            found.columns,
            found.chi_square + costs,
            found,
            self.weight,
        )

    def _nuisances(self, hypothesis: Hypothesis) -> Nuisances:
        """A zero for each absolute zero, and what the hypothesis has in addition."""
        own = zeros(self.zero, self.data.full.zeros)
        return own if hypothesis.nuisances is None else own.and_also(hypothesis.nuisances)

    def _sign(self, effect: Effect) -> float:
        """The sign that an effect's coefficients have; 0 where they may have either."""
        if effect.part is Part.LOOP:
            return self.loop_sign
        return 1.0 if effect.nonnegative else 0.0

    def predicted(self, fitted: Fitted) -> FloatArray:
        """What the hypothesis says for each sample, zeros included, arcsec, shape (n,)."""
        effects, start = fitted.hypothesis.effects, fitted.hypothesis.start
        return fitted.zeros[self.data.full.zero] + self.level + self._regressors.predicted(effects, (start,))

    def told(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """What effects say together at the usable points, arcsec, shape (m,)."""
        return self._regressors.told(effects, (start,))

    def with_load_angle(self, load_deg: FloatArray) -> None:
        """Make a predicted load angle (n,) what effects of the load encoder's lines count on."""
        data = self.data
        full = replace(data.full, motion=replace(data.full.motion, load_deg=load_deg))
        points = replace(data.points, motion=replace(data.points.motion, load_deg=data.mean(load_deg)))
        self.data = replace(data, full=full, points=points)
        self._regressors.along([full.motion])


def _smooth(values: FloatArray) -> FloatArray:
    """A channel without the noise of its readings, of which parabolas through `SMOOTH` keep a sixth.

    Savitzky and Golay's filter; scipy.signal has it, and takes a second to load.
    """
    if len(values) <= SMOOTH:
        return values
    half = SMOOTH // 2
    parabolas = np.linalg.qr(np.vander(np.arange(-half, half + 1.0), 3))[0]
    fit = parabolas @ parabolas.T
    inside = np.convolve(values, fit[half], "valid")
    return np.concatenate([fit[:half] @ values[:SMOOTH], inside, fit[-half:] @ values[-SMOOTH:]])
