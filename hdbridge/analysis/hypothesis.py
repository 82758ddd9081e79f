"""Hypotheses (effects and zero offsets) and the joint fit of all their free parameters (`separable`).

The baseline is refitted with every candidate, so an error that the baseline can absorb does not become a
finding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hdbridge.analysis.blocks import missed_deg
from hdbridge.analysis.calibrated import CalibratedPart, priors
from hdbridge.analysis.driving import CHATTER_COUNTS
from hdbridge.analysis.linear import (
    LOCAL,
    Column,
    Effort,
    Linearised,
    Nuisances,
    Prior,
    Terms,
    about_zeros,
    solve_symmetric,
    unknown,
)
from hdbridge.analysis.noise import White
from hdbridge.analysis.nuisances import COUNTS, zeros
from hdbridge.analysis.prepared import Observed
from hdbridge.analysis.regressors import Regressors
from hdbridge.analysis.scales import Scales
from hdbridge.analysis.separable import Separable, Solution, unit
from hdbridge.axis.effects import Channel, Effect, FloatArray, IntArray, Motion, Moves, Part, Start
from hdbridge.axis.effects.kinematics import direction_of
from hdbridge.axis.effects.path import branches
from hdbridge.axis.effects.play import stop
from hdbridge.units import ARCSEC_PER_DEG

ENOUGH = Effort(steps=8, converged=0.5, roughly=2e-5)
"""Reduced accuracy of fits in a search, which suffices because the compared chi squares differ by tens."""
NOISY = frozenset({Channel.LOAD_TORQUE, Channel.MOTOR_TORQUE})
"""Measured channels whose noise enters a design-matrix column directly."""
SMOOTH = 15
"""Window of the parabolas that smooth a noisy channel, samples."""
WHITE = 1.17
"""Ratio of a channel's noise variance to the variance that smoothing removes. The theoretical value is 6/5;
it is reduced by 3 %, the accuracy to which it is known."""
MOST_TURNS = 100
"""Maximum number of turning points that have individual error columns. With more turning points, their mean
error is known accurately."""
SHORT = 10_000
"""Record length, samples, below which the number of excluded extreme samples is reduced in proportion."""
MOST_PARTS = 20
"""Maximum number of parts of a record whose initial elastic states are fitted."""
STOPS_DEG = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Widths of the stop operators of the free-form hysteresis."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects (the baseline's first), elastic state at the first sample, and optional nuisances."""

    effects: tuple[Effect, ...]
    start: Start = Start.VIRGIN
    nuisances: Nuisances | None = None
    """Columns at the usable points, in addition to those common to all hypotheses; compared by identity."""

    def plus(self, effect: Effect) -> Hypothesis:
        """Returns the hypothesis with an effect appended."""
        return replace(self, effects=(*self.effects, effect))

    def without(self, place: int) -> Hypothesis:
        """Returns the hypothesis without the effect at ``place``."""
        return replace(self, effects=self.effects[:place] + self.effects[place + 1 :])

    def instead(self, place: int, effect: Effect) -> Hypothesis:
        """Returns the hypothesis with the effect at ``place`` replaced."""
        return replace(self, effects=(*self.effects[:place], effect, *self.effects[place + 1 :]))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted hypothesis."""

    hypothesis: Hypothesis
    zeros: FloatArray
    residual: FloatArray
    """Residual at the usable points, in standard deviations of the noise, shape (m,)."""
    parameters: tuple[Column, ...]
    """Parameter of each column of the tangent matrix."""
    chi_square: float
    _solution: Solution = field(repr=False)
    _weight: FloatArray = field(repr=False)

    def having(self, effects: tuple[Effect, ...]) -> Fitted:
        """Returns the fit with its effects replaced by these, in the same order, and all else unchanged."""
        return replace(self, hypothesis=replace(self.hypothesis, effects=effects))

    @cached_property
    def linearised(self) -> Linearised:
        """Fit linearised at its minimum; rows in standard deviations of the noise."""
        weighted = self._solution.jacobian * self._weight[:, np.newaxis]
        return Linearised(weighted, self.residual, self._solution.known)

    @property
    def tangent(self) -> FloatArray:
        """Tangent matrix: weighted derivatives of the prediction by the parameters, shape (m, p)."""
        return self.linearised.columns

    @property
    def information(self) -> FloatArray:
        """Prior information (inverse variance) of each parameter, shape (p,)."""
        return self.linearised.known[:, 0]

    def count(self) -> int:
        """Returns the number of columns of the tangent matrix."""
        return len(self.parameters)

    def free(self) -> int:
        """Returns the number of parameters that affect this record."""
        return self._solution.free()

    def places(self, effect: int) -> IntArray:
        """Returns the column indices of one effect's parameters."""
        return np.array([i for i, each in enumerate(self.parameters) if each.effect == effect], dtype=np.intp)

    def without_parts(self, number: int) -> Linearised:
        """Returns the linearised fit without its first ``number`` effects, those of the model."""
        others = [at for at, each in enumerate(self.parameters) if not 0 <= each.effect < number]
        return self.linearised.of(np.array(others, dtype=np.intp))


class Estimator:
    """Fits hypotheses to one record; caches design-matrix columns."""

    def __init__(self, data: Observed, scales: Scales | None = None) -> None:
        points = data.points
        self.data = data
        self.scales = scales or Scales()
        """Decision thresholds."""
        self.index: IntArray = np.flatnonzero(points.usable)
        self.weight: FloatArray = 1.0 / points.sigma_arcsec[self.index]
        self.observed: FloatArray = points.error_arcsec[self.index]
        self.time_s: FloatArray = points.time_s[self.index]
        self.zero: IntArray = points.zero[self.index]
        self.at_points = data.at_points  # a method of this class would form a reference cycle with the cache
        self._regressors = Regressors([data.full.motion], self.at_points, len(self.index))
        self._noise: dict[object, FloatArray] = {}
        self._free_loops: dict[Start, Nuisances] = {}
        # The median is subtracted, because an encoder's zero is arbitrary.
        self.level = float(np.median(self.observed))
        self.loop_sign = 1.0
        """Sign of the loop's offset; -1 if the load lags."""
        self.calibrated: tuple[CalibratedPart, ...] = ()
        """Priors from the calibration for the first effects of each hypothesis."""
        self.unknown: Nuisances = zeros(self.zero, data.full.zeros)
        """Nuisances common to all hypotheses: zero offsets, motion between samples, initial states."""

    @property
    def motion(self) -> Motion:
        """Motion at all points, usable or not, because the elastic state depends on all of them."""
        return self.data.points.motion

    @property
    def rare(self) -> float:
        """Fraction of extreme values excluded at either end when a span is computed."""
        return self.scales.rare / max(len(self.data.full), SHORT)

    @property
    def count_arcsec(self) -> float:
        """One count of the motor encoder, referred to the load, arcsec; 0 if no count is visible."""
        return self.data.full.count_deg / self.data.ratio * ARCSEC_PER_DEG

    @property
    def floor_arcsec(self) -> float:
        """Smallest relevant peak. It includes the rounding of both encoders, which is constant at rest."""
        rounded = math.hypot(self.count_arcsec, self.data.load_count_arcsec) / math.sqrt(12.0)
        return max(self.scales.floor_arcsec, rounded, 0.5 * self.data.noise_arcsec)

    def half_span(self, values: FloatArray) -> float:
        """Returns half the peak-to-peak span of values, excluding rare extremes (`rare`)."""
        low, high = np.quantile(values, [self.rare, 1.0 - self.rare])
        return 0.5 * float(high - low)

    def columns(self, effect: Effect, start: Start) -> FloatArray:
        """Returns an effect's columns at the usable points (means over samples), arcsec, shape (m, p)."""
        return self._regressors.columns(effect, (start,))

    def contribution(self, effect: Effect, start: Start) -> FloatArray:
        """Returns an effect's contribution to each usable sample, arcsec.

        Averages over points would reduce the apparent size of fast effects.
        """
        full = self.data.full
        if len(full) == len(self.data.points):
            return np.asarray(self.columns(effect, start) @ effect.coefficients())
        return effect.predict(full.motion, start)[full.usable]

    def weighted(self, columns: FloatArray) -> FloatArray:
        """Divides the rows of columns by the standard deviation of the noise."""
        return np.asarray(columns * self.weight[:, np.newaxis])

    def law_discrepancy(self, effect: Effect, start: Start) -> FloatArray:
        """Returns an effect's law error as weighted columns (m, k), one standard deviation each."""
        return self.weighted(self.at_points(effect.law_discrepancy(self.data.full.motion, start)))

    def angle_discrepancy(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """Returns the change of the error due to the motor angle's uncertainty within a count, shape (m, 1).

        The change is weighted. The transmission error is relative to that angle, and a loop is steepest where
        the motor stops.
        """
        full = self.data.full
        other = replace(full.motion, motor_deg=full.rested_deg)
        change = (full.rested_deg - full.motor_deg) * (ARCSEC_PER_DEG / full.ratio)
        for each in with_memory(effects):
            change = change + each.predict(other, start) - each.predict(full.motion, start)
        return self.weighted(self.at_points(change)[:, np.newaxis])

    def turn_discrepancy(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """Returns the effect of turning-point errors within a count, as weighted columns (m, k).

        Each column is one standard deviation. A motor with friction stops short of every turning point, by a
        common and an individual amount. One column is common to all turning points. If there are at most
        `MOST_TURNS`, each also has a column of its own.
        """
        turns, change = self.turned(effects, start)
        if not len(turns):
            return np.empty((len(self.index), 0))
        columns = [self.at_points(change)]
        if len(turns) <= MOST_TURNS:
            leg = np.searchsorted(turns, self.data.runs[self.index], "right")
            columns += [np.where(leg == each, columns[0], 0.0) for each in range(1, len(turns) + 1)]
        return self.weighted(np.column_stack(columns))

    def turned(self, effects: Sequence[Effect], start: Start) -> tuple[IntArray, FloatArray]:
        """Returns the turning points, and the change of each sample due to their errors, arcsec, (n,)."""
        full, loops = self.data.full, with_memory(effects)
        change = np.zeros(len(full))
        if not loops:
            return np.empty(0, dtype=np.intp), change
        turning, signs = branches(full.motor_deg, start)
        turns = np.array(turning[1:-1], dtype=np.intp)
        count = full.reading.resolution_deg if full.commanded else CHATTER_COUNTS * full.reading.unaided_deg
        error = max(COUNTS * count, full.reading.jitter_deg)
        beyond = (error + missed_deg(full.motor_deg, turns)) * np.array(signs[:-1])
        later, earlier = full.motor_deg.copy(), full.motor_deg.copy()
        later[turns] += beyond
        earlier[turns - 1] = full.motor_deg[turns] + beyond
        for moved in (later, earlier):
            motion = replace(full.motion, motor_deg=moved)
            moved_by = sum(each.predict(motion, start) - each.predict(full.motion, start) for each in loops)
            change = np.where(np.abs(moved_by) > np.abs(change), moved_by, change)
        return turns, change

    def crept(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """Returns the change of each sample at rest if the motor has crept back within a count, arcsec, (n,).

        A servo creeps until friction holds it, which no reading shows. A loop is steepest where the motor
        turns. The backward travel is the rms of a uniform distribution over a count.
        """
        full, loops = self.data.full, with_memory(effects)
        still = full.speed_deg_s == 0.0
        back_deg = full.reading.resolution_deg / math.sqrt(3.0) * direction_of(full.motion)
        motion = replace(full.motion, motor_deg=full.motor_deg - np.where(still, back_deg, 0.0))
        change = sum((each.predict(motion, start) - each.predict(full.motion, start) for each in loops), 0.0)
        return np.where(still, change, 0.0)

    def begun(self, effects: Sequence[Effect]) -> FloatArray:
        """Returns half the range of each sample over all possible initial elastic states, arcsec, (n,)."""
        change, loops = np.zeros(len(self.data.full)), with_memory(effects)
        for chain in self.data.full.chains if loops else ():
            motion = self.data.full.along(chain)
            for each in loops:
                ends = [each.predict(motion, start) for start in (Start.FORWARD, Start.BACKWARD)]
                change[chain.rows] += 0.5 * (ends[0] - ends[1])
        return change

    def first_branch(self, effects: Sequence[Effect]) -> FloatArray:
        """Returns the standard deviation of the error on each part's first branch, arcsec, shape (n,).

        The initial elastic state is fitted, but its decay along the branch depends on the unknown motion
        before.
        """
        begun, result = np.abs(self.begun(effects)), np.zeros(len(self.data.full))
        for chain in self.data.full.chains:
            first = chain.rows.start
            turns, _ = branches(self.data.full.motor_deg[chain.rows])
            rows = slice(first, first + turns[min(1, len(turns) - 1)] + 1)
            result[rows] = np.minimum(begun[rows], begun[first] - begun[rows])
        return result

    def begins_of(self, effects: Sequence[Effect]) -> Nuisances:
        """Returns a column for the elastic state at the start of each part; no columns without a loop.

        Each state lies between saturation in one direction and saturation in the other.
        """
        change, columns = self.begun(effects), []
        for chain in self.data.full.chains[:MOST_PARTS]:
            if np.any(change[chain.rows]):
                column = np.zeros(len(change))
                column[chain.rows] = change[chain.rows]
                columns.append(self.at_points(column))
        names = tuple(f"state {each}" for each in range(len(columns)))
        found = np.array(columns).reshape(len(columns), len(self.index)).T
        return Nuisances(found, names, (Prior(0.0, 1.0),) * len(names))

    def free_loop(self, start: Start) -> Nuisances:
        """Returns a free-form hysteresis: stop operators of widths `STOPS_DEG`, which form any loop shape."""
        if start not in self._free_loops:
            angle = self.data.full.motion.motor_deg
            stops = {f"stop of {each:g} deg": self.at_points(stop(angle, each, start)) for each in STOPS_DEG}
            self._free_loops[start] = unknown(np.stack([*stops.values()], axis=1), [*stops])
        return self._free_loops[start]

    def fit(self, hypothesis: Hypothesis, moves: frozenset[Moves] = LOCAL, effort: Effort = ENOUGH) -> Fitted:
        """Fits a hypothesis, starting from its own parameters; the result is never worse than the start.

        ``moves`` selects the shape parameters to fit. Initially all calibrated parts have their priors. Parts
        whose deviation (`strain`) exceeds the cost of a change are freed one by one.
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

    def lawful(self, fitted: Fitted) -> Fitted:
        """Refits without a free-form loop, which a model cannot contain."""
        return self.fit(replace(fitted.hypothesis, nuisances=None))

    def _prior(
        self, hypothesis: Hypothesis, parts: Sequence[CalibratedPart]
    ) -> tuple[dict[tuple[int, str], Prior], float]:
        """Returns the priors, corrected for channel noise, and the resulting offset of chi square."""
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
        """Returns the weighted sum of squares that channel noise adds to each column of an effect, (p,).

        With errors in variables, a fit improves spuriously as the coefficient of a noisy column shrinks. The
        correction (Fuller 1987, 2.2) applies to calibrated coefficients only. With it, any other coefficient
        could take any size if its column contained little but noise.
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
        """Fits with the priors of ``parts``, and adds the ``costs`` of the freed parts to chi square."""
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
        """Returns the nuisances common to all hypotheses, followed by those of this one."""
        own = hypothesis.nuisances
        return self.unknown if own is None else self.unknown.and_also(own)

    def _sign(self, effect: Effect) -> float:
        """Returns the sign required of an effect's coefficients; 0 for either sign."""
        if effect.part is Part.LOOP:
            return self.loop_sign
        return 1.0 if effect.nonnegative else 0.0

    def predicted(self, fitted: Fitted) -> FloatArray:
        """Returns the prediction for each sample, including the zero offset, arcsec, shape (n,)."""
        effects, start = fitted.hypothesis.effects, fitted.hypothesis.start
        return fitted.zeros[self.data.full.zero] + self.level + self._regressors.predicted(effects, (start,))

    def predict(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """Returns the transmission error due to the effects at the usable points, arcsec, shape (m,)."""
        return self._regressors.predict(effects, (start,))

    def residual_of(self, effects: Sequence[Effect]) -> tuple[FloatArray, Start]:
        """Returns the residual at the usable points, arcsec, (m,), and the initial elastic state.

        Zero offsets and initial state are those that fit best.
        """
        left = {
            start: about_zeros(self.observed - self.predict(effects, start), self.zero, self.weight**2)
            for start in Start
        }
        best = min(left, key=lambda start: float(left[start] @ left[start]))
        return left[best], best

    def residual_with_nuisances(self, effects: Sequence[Effect]) -> FloatArray:
        """Returns the residual at the usable points, arcsec, (m,), after a fit of the nuisances alone."""
        columns = self.weighted(self.unknown.columns)
        information = np.diag([each.information for each in self.unknown.prior])
        gram = columns.T @ columns + information
        best: tuple[float, FloatArray] = (math.inf, np.empty(0))
        for start in Start:
            left = self.weight * (self.observed - self.level - self.predict(effects, start))
            values = solve_symmetric(gram, columns.T @ left)
            left = left - columns @ values
            best = min(
                best, (float(left @ left + values @ information @ values), left), key=lambda each: each[0]
            )
        return best[1] / self.weight

    def with_load_angle(self, load_deg: FloatArray) -> None:
        """Replaces the predicted load angle (n,), which the effects of the load encoder's lines use."""
        data = self.data
        full = replace(data.full, motion=replace(data.full.motion, load_deg=load_deg))
        points = replace(data.points, motion=replace(data.points.motion, load_deg=data.mean(load_deg)))
        self.data = replace(data, full=full, points=points)
        self._regressors.along([full.motion])


def with_memory(effects: Sequence[Effect]) -> list[Effect]:
    """Returns the effects that depend on earlier motion."""
    return [each for each in effects if each.tracker().memory_deg > 0.0]


def _smooth(values: FloatArray) -> FloatArray:
    """Smooths a channel by parabolas over `SMOOTH` samples, which leaves a sixth of the noise variance.

    This is a Savitzky-Golay filter. It is not taken from scipy.signal, which takes a second to import.
    """
    if len(values) <= SMOOTH:
        return values
    half = SMOOTH // 2
    parabolas = np.linalg.qr(np.vander(np.arange(-half, half + 1.0), 3))[0]
    fit = parabolas @ parabolas.T
    inside = np.convolve(values, fit[half], "valid")
    return np.concatenate([fit[:half] @ values[:SMOOTH], inside, fit[-half:] @ values[-SMOOTH:]])
