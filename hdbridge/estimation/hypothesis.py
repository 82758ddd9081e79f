"""A hypothesis: effects and zeros, fitted together by Gauss-Newton on everything that is free.

The baseline is refitted with every candidate, so what the baseline can take over is never called a finding.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hdbridge.effects import (
    Channel,
    DirectionPhase,
    Effect,
    FloatArray,
    Motion,
    Start,
    VelocityWindup,
    refreshed,
)
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import MotorOrder, OrderSeries
from hdbridge.effects.play import stop
from hdbridge.estimation.observed import IntArray, Observed, Series

ITERATIONS = 8
CONVERGED = 0.5
"""A step that gains less than this in chi square is the last."""
ROUGHLY = 2e-5
"""... or less than this share of it: where much is left, exactness is of no use."""
KEPT_FITS = 8
KEPT_COLUMNS = 64
"""What is asked for again and again is kept; so many, for they are large."""
FIXED_SHAPES = frozenset({"time_s", "frequency_hz"})
"""Shapes that a local step cannot improve: found by search over all their values."""
LOOPS = (Hysteresis, HysteresisMemory)
ONE_SIDED = (VelocityWindup,)
"""Effects of which no coefficient is negative. One that is not there would come out on either side of zero
by chance, and half of the time the effect would be refused for it: it is held at zero instead. A loop has the
sign of `Estimator.loop_sign`, for the same reason."""
STOPS_DEG = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Widths of the stop operators of the free-form hysteresis."""
_EPS = 1e-9


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects (the baseline's first) and the elastic state at the first sample."""

    effects: tuple[Effect, ...]
    start: Start = Start.VIRGIN

    def plus(self, effect: Effect) -> Hypothesis:
        """With one more effect."""
        return replace(self, effects=(*self.effects, effect))

    def without(self, place: int) -> Hypothesis:
        """With one effect less."""
        return replace(self, effects=self.effects[:place] + self.effects[place + 1 :])

    def instead(self, place: int, effect: Effect) -> Hypothesis:
        """With one effect exchanged."""
        return replace(self, effects=(*self.effects[:place], effect, *self.effects[place + 1 :]))


@dataclass(frozen=True, slots=True)
class Parameter:
    """What a column of the tangent matrix stands for."""

    effect: int
    """Place of the effect in the hypothesis; -1 for a zero."""
    name: str
    shape: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A hypothesis with its best parameters."""

    hypothesis: Hypothesis
    zeros: FloatArray
    residual: FloatArray
    """Weighted residual of the usable points, shape (m,)."""
    tangent: FloatArray
    """Weighted derivatives, shape (m, p)."""
    parameters: tuple[Parameter, ...]
    chi_square: float
    basis: FloatArray = field(repr=False, default_factory=lambda: np.empty((0, 0)))
    """Orthonormal basis of the tangent's columns."""

    def count(self) -> int:
        """Columns of the tangent matrix."""
        return len(self.parameters)

    def free(self) -> int:
        """Parameters that do anything in this record."""
        return int(np.count_nonzero(np.any(self.tangent != 0.0, axis=0)))

    def places(self, effect: int) -> IntArray:
        """Columns of one effect."""
        return np.array([i for i, each in enumerate(self.parameters) if each.effect == effect], dtype=np.intp)


class Estimator:
    """Fits theories to one body of evidence; keeps columns that are asked for again and again."""

    def __init__(self, data: Observed) -> None:
        points = data.points
        self.data = data
        self.index: IntArray = np.flatnonzero(points.usable)
        self.weight: FloatArray = 1.0 / points.sigma_arcsec[self.index]
        self.observed: FloatArray = points.error_arcsec[self.index]
        self.time_s: FloatArray = _time(points)[self.index]
        self.zero: IntArray = points.zero[self.index]
        self.load_angles = 0
        """How often the predicted load angle was exchanged."""
        self._memo: dict[object, FloatArray] = {}
        self._recent: OrderedDict[object, FloatArray] = OrderedDict()
        self._fits: OrderedDict[object, Fitted] = OrderedDict()
        # About the level that they have in common: an encoder's zero is no part of the physics.
        self.level = float(np.median(self.observed))
        self.loop_sign = 1.0
        """Of the loop's offset: -1 where the load lags."""
        self.nuisance: FloatArray = np.empty((len(self.index), 0))
        """Columns that every fit may use and that mean nothing, shape (m, k)."""

    @property
    def motion(self) -> Motion:
        """What drove the axis, point by point (all points, the elastic state passes through each)."""
        return self.data.points.motion

    def columns(self, effect: Effect, start: Start) -> FloatArray:
        """Regressors of an effect at the usable points, arcsec, shape (m, p): means over their samples."""
        if isinstance(effect, OrderSeries):
            return np.hstack(
                [np.empty((len(self.index), 0)), *(self._order(effect, each) for each in effect.orders)]
            )
        # Columns do not depend on the coefficients; effects carried by another (its loop, its orders) do
        # depend on those, and these are fields of them.
        unit = effect
        if not isinstance(effect, DirectionPhase):  # whose column is that at its present shift
            unit = effect.fitted(np.ones(len(effect.coefficients())))
        recent = (unit, start, self.load_angles if Channel.LOAD_ANGLE in effect.channels else 0)
        if recent in self._recent:
            self._recent.move_to_end(recent)
            return self._recent[recent]
        columns = self.at_points(effect.columns(self.data.full.motion, start))
        self._recent[recent] = columns
        if len(self._recent) > KEPT_COLUMNS:
            self._recent.popitem(last=False)
        return columns

    def _order(self, series: OrderSeries, order: MotorOrder) -> FloatArray:
        """Cosine and sine of one order at the usable points, shape (m, 2)."""
        key = (series.turns_per_motor_turn(), order.order)
        if key not in self._memo:
            alone = series.model_copy(update={"orders": (order,)})
            self._memo[key] = self.at_points(alone.columns(self.data.full.motion))
        return self._memo[key]

    def at_points(self, values: FloatArray) -> FloatArray:
        """Of every sample to the usable points, as the observations are averaged."""
        return np.asarray(self.data.mean(values)[self.index])

    def does(self, effect: Effect, start: Start) -> FloatArray:
        """What an effect does in the usable samples, arcsec; in means a fast one would seem smaller."""
        full = self.data.full
        if len(full) == len(self.data.points):
            return np.asarray(self.columns(effect, start) @ effect.coefficients())
        return effect.predict(full.motion, start)[full.usable]

    def weighted(self, columns: FloatArray) -> FloatArray:
        """Columns in units of the noise."""
        return np.asarray(columns * self.weight[:, np.newaxis])

    def zero_columns(self) -> FloatArray:
        """One column per absolute zero, shape (m, zeros)."""
        own: FloatArray = (self.zero[:, np.newaxis] == np.arange(self.data.zeros)).astype(np.float64)
        return own

    def free_loop(self, start: Start) -> FloatArray:
        """A free-form hysteresis: stop operators of `STOPS_DEG`, which make a loop of any shape with
        memory.
        """
        angle = self.data.full.motion.motor_deg
        return np.stack([self.at_points(stop(angle, each, start)) for each in STOPS_DEG], axis=1)

    def fit(self, hypothesis: Hypothesis, iterations: int = ITERATIONS) -> Fitted:
        """Gauss-Newton from where the hypothesis stands; never worse than where it began."""
        counted = any(Channel.LOAD_ANGLE in each.channels for each in hypothesis.effects)
        key = (
            hypothesis, iterations, self.nuisance.shape[1],
            self.load_angles if counted else 0, self.loop_sign,
        )  # fmt: skip
        if key in self._fits:
            self._fits.move_to_end(key)
            return self._fits[key]
        fitted = self._fit(hypothesis, iterations)
        self._fits[key] = fitted
        if len(self._fits) > KEPT_FITS:
            self._fits.popitem(last=False)
        return fitted

    def _fit(self, hypothesis: Hypothesis, iterations: int) -> Fitted:
        effects = refreshed(hypothesis.effects)
        best: Fitted | None = None
        step = 1.0
        moves = np.empty(0)
        for _ in range(iterations):
            here = self._at(replace(hypothesis, effects=effects))
            if best is None or here.chi_square < best.chi_square:
                gain = math.inf if best is None else best.chi_square - here.chi_square
                best = self.with_shapes(here)
                if gain < max(CONVERGED, ROUGHLY * here.chi_square):
                    break
                step = 1.0
                moves = solve(best.tangent, best.residual)
            else:
                step *= 0.35
                if step < 0.02:
                    break
            effects = moved(best.hypothesis.effects, moves, best.parameters, step)
        assert best is not None
        return replace(best, basis=orthonormal(best.tangent))

    def _at(self, hypothesis: Hypothesis) -> Fitted:
        """Residual at these shapes, with everything linear solved for; shapes have no tangents yet."""
        blocks = [self.zero_columns(), self.nuisance]
        parameters = [Parameter(-1, f"zero{i}") for i in range(self.data.zeros)]
        parameters += [Parameter(-1, f"nuisance{i}") for i in range(self.nuisance.shape[1])]
        for place, effect in enumerate(hypothesis.effects):
            columns = self.columns(effect, hypothesis.start)
            blocks.append(columns)
            parameters += [Parameter(place, str(i)) for i in range(columns.shape[1])]
        linear = self.weighted(np.hstack(blocks))
        observed = (self.observed - self.level) * self.weight
        # Linear in the coefficients: solve for them outright; what is carried elsewhere follows in
        # `refreshed`.
        sign = np.array(
            [0.0 if each.effect < 0 else self._sign(hypothesis.effects[each.effect]) for each in parameters]
        )
        solution = solve(linear, observed)
        while np.any(below := sign * solution < 0.0):
            linear[:, below] = 0.0
            solution = solve(linear, observed)
        effects: list[Effect] = []
        at = self.data.zeros + self.nuisance.shape[1]
        for effect in hypothesis.effects:
            size = len(effect.coefficients())
            effects.append(effect.fitted(solution[at : at + size]))
            at += size
        residual = observed - linear @ solution
        return Fitted(
            replace(hypothesis, effects=tuple(effects)),
            solution[: self.data.zeros],
            residual,
            linear,
            tuple(parameters),
            float(residual @ residual),
        )

    def _sign(self, effect: Effect) -> float:
        """The sign that an effect's coefficients have; 0 where they may have either."""
        if isinstance(effect, LOOPS):
            return self.loop_sign
        return 1.0 if isinstance(effect, ONE_SIDED) else 0.0

    def with_shapes(self, fitted: Fitted, names: Container[str] | None = None) -> Fitted:
        """With the tangents of these shapes, or of all but `FIXED_SHAPES`; the same where there are none."""
        hypothesis, parameters = fitted.hypothesis, list(fitted.parameters)
        shapes: list[FloatArray] = []
        for place, effect in enumerate(hypothesis.effects):
            for each in effect.shape:
                if each.name in FIXED_SHAPES if names is None else each.name not in names:
                    continue
                here = shape_value(effect, each.name)
                delta = 1e-2 * here if each.logarithmic else 2e-3 * (each.upper - each.lower)
                if each.name == "frequency_hz":  # a small part of a period over the whole record
                    delta = 0.02 / max(float(np.ptp(self.time_s)), 1e-9)
                low, high = max(here - delta, each.lower), min(here + delta, each.upper)
                if high <= low:
                    continue
                span = math.log(high / low) if each.logarithmic else high - low
                coefficients = effect.coefficients()
                either = [
                    self.columns(effect.fitted(coefficients, {each.name: value}), hypothesis.start)
                    @ coefficients
                    for value in (low, high)
                ]
                shapes.append(self.weight * (either[1] - either[0]) / span)
                parameters.append(Parameter(place, each.name, shape=True, logarithmic=each.logarithmic))
        if not shapes:
            return fitted
        tangent = np.column_stack([fitted.tangent, *shapes])
        return replace(fitted, tangent=tangent, parameters=tuple(parameters))

    def predicted(self, fitted: Fitted) -> FloatArray:
        """What the hypothesis says for each sample, zeros included, arcsec, shape (n,)."""
        full = self.data.full
        total = fitted.zeros[full.zero] + self.level
        for effect in fitted.hypothesis.effects:
            total = total + effect.predict(full.motion, fitted.hypothesis.start)
        return np.asarray(total)

    def told(self, effects: Sequence[Effect], start: Start) -> FloatArray:
        """What effects say together at the usable points, arcsec, shape (m,)."""
        full = self.data.full.motion
        total = sum((each.predict(full, start) for each in effects), start=np.zeros(len(full)))
        return self.at_points(total)


def shape_value(effect: Effect, name: str) -> float:
    """A shape parameter; where it is not a field, that of the first of its parts."""
    holder = effect if hasattr(effect, name) else effect.parts[0]  # type: ignore[attr-defined]
    return float(getattr(holder, name))


def _time(series: Series) -> FloatArray:
    assert series.motion.time_s is not None
    return series.motion.time_s


def solve(columns: FloatArray, right: FloatArray) -> FloatArray:
    """Least squares through the Gram matrix; directions that the data do not see stay at zero."""
    gram = columns.T @ columns
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > _EPS * max(float(values[-1]), 1e-300)
    moment = (columns.T @ right) / scale
    inner = vectors[:, kept] @ ((vectors[:, kept].T @ moment) / values[kept])
    return np.where(np.diag(gram) > 0.0, inner / scale, 0.0)


def orthonormal(columns: FloatArray) -> FloatArray:
    """An orthonormal basis of what the columns span, shape (m, r)."""
    gram = columns.T @ columns
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > _EPS * max(float(values[-1]), 1e-300)
    return np.asarray(columns @ (vectors[:, kept] / scale[:, np.newaxis] / np.sqrt(values[kept])))


def moved(
    effects: tuple[Effect, ...], moves: FloatArray, parameters: Sequence[Parameter], step: float
) -> tuple[Effect, ...]:
    """The effects with their shapes moved (in the logarithm where it is one), kept in their ranges."""
    result = list(effects)
    for move, parameter in zip(moves, parameters, strict=True):
        if not parameter.shape:
            continue
        effect = result[parameter.effect]
        shape = next(each for each in effect.shape if each.name == parameter.name)
        here = shape_value(effect, shape.name)
        if shape.logarithmic:
            there = here * math.exp(min(max(step * float(move), -0.7), 0.7))
        else:
            reach = 0.15 * (shape.upper - shape.lower)
            there = here + min(max(step * float(move), -reach), reach)
        there = min(max(there, shape.lower), shape.upper)
        result[parameter.effect] = effect.fitted(effect.coefficients(), {shape.name: there})
    return refreshed(tuple(result))
