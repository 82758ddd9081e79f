"""Statistics over many joints: pure functions of arrays, without files or randomness.

Every rate, scatter and prior is estimated from the fleet itself, so that a joint is compared with the same
diagnosis of other joints on everyday records. If the data do not determine a result, it is None.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaln, chdtrc, chdtri, expit, logsumexp, ndtr, ndtri
from scipy.stats import false_discovery_control

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.readings import median_deviation
from hdbridge.axis.effects import FloatArray, IntArray

Complexes = NDArray[np.complex128]
OUTLIERS_FROM: Final = 8
"""Minimum number of values for a range; below it, the median absolute deviation is uncertain by half."""
DRAWS: Final = 4001
GOLDEN: Final = 0.6180339887498949
INTERVAL: Final = (0.05, 0.95)
"""Quantiles of the 90 % intervals of hours and prevalences."""
SCATTER_SERIES: Final = 200
"""Maximum number of series used to estimate the common scatter; its error is then 5 % or less."""
OWN_SCATTER: Final = 1e-3
"""Prior fraction of joints whose values do not follow a line, for example because of a repair."""
PHASE_STEP_DEG: Final = 0.25
EVERYDAY_SHARE: Final = 0.05
"""Normal relative difference of an order's amplitude between two recordings of one joint."""
AGREE: Final = 1e-4
DISAGREE: Final = 1e-12
"""Chi-square tail probabilities below which orders do not agree, or certainly differ."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Value with its 90 % interval; an infinite bound is open."""

    low: float
    value: float
    high: float


# -- Prevalence


def prevalence(cases: Mapping[str, tuple[int, int]]) -> dict[str, Interval]:
    """Estimates the fraction of joints with a cause in each group from (cases, joints), partially pooled.

    The model is beta-binomial with mean and concentration integrated out over a grid, so a group of three
    joints is drawn towards the others, unlike a group of three hundred.
    """
    if not cases:
        return {}
    hits = np.array([each[0] for each in cases.values()], dtype=float)
    sizes = np.array([each[1] for each in cases.values()], dtype=float)
    mean, strength = np.meshgrid(np.linspace(0.01, 0.99, 50), np.geomspace(1.0, 1000.0, 13), indexing="ij")
    a, b = (mean * strength).ravel(), ((1.0 - mean) * strength).ravel()
    marginal = sum(
        betaln(a + hit, b + size - hit) - betaln(a, b) for hit, size in zip(hits, sizes, strict=True)
    )
    weight = np.exp(marginal - logsumexp(marginal))
    a, b, weight = a[weight > 1e-6], b[weight > 1e-6], weight[weight > 1e-6]
    share = (np.arange(1000) + 0.5) / 1000.0
    odds = np.vstack([np.log(share), np.log1p(-share)])
    result = {}
    for name, hit, size in zip(cases, hits, sizes, strict=True):
        one, other = a + hit, b + size - hit
        density = np.exp(np.column_stack([one - 1.0, other - 1.0]) @ odds - betaln(one, other)[:, np.newaxis])
        below = np.cumsum(weight @ density)
        low, middle, high = (
            float(np.interp(each, below / below[-1], share)) for each in (INTERVAL[0], 0.5, INTERVAL[1])
        )
        result[name] = Interval(low, middle, high)
    return result


# -- Repetition


@dataclass(frozen=True, eq=False)
class Repeats:
    """Prevalence of one cause, and the rates of its findings."""

    probability: FloatArray
    """Probability that each joint has the cause, shape (joints,)."""
    share: float
    """Fraction of joints that have the cause."""
    named: float
    """Rate of findings in recordings of a joint with the cause."""
    wrongly: float
    """Rate of findings in recordings of a joint without the cause."""


def repeats(named: Sequence[Sequence[bool]]) -> Repeats:
    """Estimates which joints have a cause; ``named`` contains its findings by joint and recording, in time
    order.

    Recordings of a joint without the cause have findings at a constant rate; those of a joint with it, at a
    higher rate from an unknown onset on. Prevalence and rates are estimated from the fleet by
    expectation maximisation with weak priors.
    """
    share, often, rarely = 0.05, 0.8, 0.02
    lengths = np.array([len(each) for each in named], dtype=int)
    tables: dict[int, tuple[IntArray, FloatArray]] = {}
    for length in np.unique(lengths[lengths > 0]).tolist():
        own = np.flatnonzero(lengths == length)
        tables[length] = own, np.array([named[place] for place in own.tolist()], dtype=np.float64)
    probability = np.zeros(len(named))
    for _ in range(200):
        hits = hits_of = misses = misses_of = 0.0
        probability[lengths == 0] = share
        for length, (own, y) in tables.items():
            with_it = np.where(y > 0, math.log(often), math.log1p(-often))
            without = np.where(y > 0, math.log(rarely), math.log1p(-rarely))
            # Likelihood ratio of each onset; earlier recordings are like those without the cause.
            onset = np.cumsum((with_it - without)[:, ::-1], axis=1)[:, ::-1]
            whole = logsumexp(onset, axis=1, keepdims=True)
            probability[own] = expit(math.log(share / (1.0 - share)) + whole[:, 0] - math.log(length))
            since = np.cumsum(np.exp(onset - whole), axis=1)  # probability that the onset has passed
            ill = probability[own][:, np.newaxis] * since
            hits += float(np.sum(ill * y))
            hits_of += float(np.sum(ill))
            misses += float(np.sum((1.0 - ill) * y))
            misses_of += float(np.sum(1.0 - ill))
        before = (share, often, rarely)
        share = (float(np.sum(probability)) + 0.5) / (len(named) + 10.0)
        often = min(max((hits + 8.0) / (hits_of + 10.0), 0.5), 0.995)
        rarely = min(max((misses + 0.1) / (misses_of + 10.0), 1e-4), 0.4)
        if max(abs(x - y) for x, y in zip(before, (share, often, rarely), strict=True)) < 1e-5:
            break
    return Repeats(probability, share, often, rarely)


def within_false_discoveries(probability: FloatArray, rate: float) -> FloatArray:
    """Selects the largest set of claims whose expected fraction of wrong claims is at most ``rate``."""
    order = np.argsort(-probability, kind="stable")
    wrong = np.cumsum(1.0 - probability[order]) / np.arange(1, len(order) + 1)
    chosen = np.zeros(len(probability), dtype=bool)
    chosen[order[: int(np.sum(np.maximum.accumulate(wrong) <= rate))]] = True
    return chosen


# -- Normal ranges


def normal_range(values: FloatArray) -> Interval:
    """Returns the median and the 95 % range of normal values, estimated by the median absolute deviation."""
    middle = float(np.median(values))
    half = NORMAL_95 * median_deviation(values - middle)
    return Interval(middle - half, middle, middle + half)


def outliers(values: FloatArray, rate: float = 0.05) -> NDArray[np.bool_]:
    """Selects outliers at a false discovery rate (Benjamini and Hochberg 1995); mask of shape (n,).

    Selects none among fewer than eight values, or if more than half of the values are equal.
    """
    scale = median_deviation(values - np.median(values)) if len(values) else 0.0
    if len(values) < OUTLIERS_FROM or scale == 0.0:
        return np.zeros(len(values), dtype=bool)
    chance = 2.0 * ndtr(-np.abs(values - np.median(values)) / scale)
    return np.asarray(false_discovery_control(chance) <= rate)


# -- Trends


@dataclass(frozen=True, eq=False)
class Series:
    """Values of one quantity of one joint over its operating hours; arrays of shape (n,)."""

    hours: FloatArray
    value: FloatArray
    sd: FloatArray
    """Standard deviation of each value, from the diagnosis."""
    temperature_c: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Trend:
    """Trend of a quantity: the fitted line, with the distribution of the fleet's slopes as its prior."""

    line: FloatArray
    """Level at the last recording, and slope per 1000 hours."""
    covariance: FloatArray
    """Covariance of level and slope without the prior, shape (2, 2)."""
    stay: float
    """Standard deviation of the slopes of joints that do not change."""
    change: tuple[float, float]
    """Mean and standard deviation of the slopes of joints that change."""
    changing: float
    """Probability that the joint changes."""

    @cached_property
    def _slopes(self) -> list[tuple[float, float, float]]:
        """Weight, mean and standard deviation of the slope for an unchanging and for a changing joint."""
        slope, own = float(self.line[1]), float(self.covariance[1, 1])
        result = []
        for weight, centre, deviation in (
            (1.0 - self.changing, 0.0, self.stay),
            (self.changing, *self.change),
        ):
            variance = 1.0 / (1.0 / deviation**2 + 1.0 / own)
            result.append((weight, variance * (centre / deviation**2 + slope / own), math.sqrt(variance)))
        return result

    @cached_property
    def _draws(self) -> tuple[FloatArray, FloatArray]:
        """Posterior levels and slopes, drawn at fixed quantiles so that equal data give equal intervals."""
        slope, cov, changing = float(self.line[1]), self.covariance, round(self.changing * DRAWS)
        drawn = np.concatenate(
            [
                middle + deviation * ndtri((np.arange(number) + 0.5) / max(number, 1))
                for number, (_, middle, deviation) in zip(
                    (DRAWS - changing, changing), self._slopes, strict=True
                )
            ]
        )
        # Level conditional on the slope; its residual variance uses quantiles in a different order.
        level = self.line[0] + cov[0, 1] / cov[1, 1] * (drawn - slope)
        rest = math.sqrt(max(float(cov[0, 0] - cov[0, 1] ** 2 / cov[1, 1]), 0.0))
        return level + rest * ndtri((np.arange(1, DRAWS + 1) * GOLDEN) % 1.0), drawn

    @property
    def per_1000_hours(self) -> Interval:
        """Slope per 1000 hours with its interval."""
        low, middle, high = np.quantile(self._draws[1], (INTERVAL[0], 0.5, INTERVAL[1])).tolist()
        return Interval(low, middle, high)

    def growing(self) -> float:
        """Returns the probability that the slope is positive."""
        return sum(weight * float(ndtr(middle / deviation)) for weight, middle, deviation in self._slopes)

    def hours_to(self, limit: float) -> Interval | None:
        """Returns the hours from the last recording until the line reaches a limit, or None if unknown.

        They are unknown if the line may never reach the limit (infinite upper bound of the interval).
        """
        level, slope = self._draws
        hours = np.full(DRAWS, np.inf)
        np.divide(1000.0 * (limit - level), slope, out=hours, where=slope > 0.0)
        hours = np.maximum(np.where(level >= limit, 0.0, hours), 0.0)
        low, middle, high = (
            float(np.quantile(hours, each, method="lower")) for each in (INTERVAL[0], 0.5, INTERVAL[1])
        )
        return None if math.isinf(high) else Interval(low, middle, high)


def trends(series: Sequence[Series]) -> list[Trend | None]:
    """Fits the trend of one quantity in every joint; None for a joint without two different operating hours.

    The trends are straight lines; the errors are those of the values plus a scatter between recordings that
    is common to all joints. The prior of the slopes is a normal mixture of joints that change and joints that
    do not, fitted to the fleet; it shrinks an uncertain slope from three noisy recordings to zero, but hardly
    a steep one.
    """
    usable = [place for place, each in enumerate(series) if len(np.unique(each.hours)) > 1]
    if not usable:
        return [None] * len(series)
    scatter = _scatter([series[place] for place in usable])
    lines = [_line(series[place], scatter) for place in usable]
    slopes = np.array([mean[1] for mean, _ in lines])
    errors = np.sqrt(np.array([cov[1, 1] for _, cov in lines]))
    stay, change, share = _two_kinds(slopes, errors)
    wide = _log_normal(slopes, change[0], np.hypot(change[1], errors)) + math.log(share)
    narrow = _log_normal(slopes, 0.0, np.hypot(stay, errors)) + math.log1p(-share)
    changing = expit(wide - narrow).tolist()
    result: list[Trend | None] = [None] * len(series)
    for number, (place, (mean, cov)) in enumerate(zip(usable, lines, strict=True)):
        result[place] = Trend(mean, cov, stay, change, changing[number])
    return result


def _log_normal(value: FloatArray, mean: float, deviation: FloatArray) -> FloatArray:
    """Returns the logarithm of the normal density up to a constant."""
    return np.asarray(-0.5 * ((value - mean) / deviation) ** 2 - np.log(deviation))


def _design(each: Series) -> FloatArray:
    """Returns the columns of level at the last recording, slope per 1000 hours and varying temperature."""
    columns = [np.ones(len(each.hours)), (each.hours - each.hours.max()) / 1000.0]
    temperature = each.temperature_c
    if temperature is not None and len(temperature) >= 4 and np.ptp(temperature) > 3.0:
        columns.append(temperature - temperature[-1])
    return np.column_stack(columns)


def _line(each: Series, scatter: float) -> tuple[FloatArray, FloatArray]:
    """Fits a line; returns it with its covariance, which is enlarged if the values do not follow the line."""
    design = _design(each)
    weight = 1.0 / (each.sd**2 + scatter**2)
    cov = np.linalg.pinv(design.T @ (weight[:, np.newaxis] * design))
    best: FloatArray = cov @ (design.T @ (weight * each.value))
    misfit, free = float(weight @ (each.value - design @ best) ** 2), len(weight) - design.shape[1]
    if free > 0 and chdtrc(free, misfit) < OWN_SCATTER:
        cov = cov * (misfit / free)
    return best[:2], np.asarray(cov[:2, :2], dtype=np.float64)


def _scatter(series: Sequence[Series]) -> float:
    """Estimates the common scatter between recordings by restricted maximum likelihood (REML).

    Each series has a scatter of its own with the probability `OWN_SCATTER`, so that a step in one series does
    not affect the common scatter.
    """
    chosen = [each for each in series if len(each.hours) > _design(each).shape[1]]
    chosen = chosen[:: max(1, math.ceil(len(chosen) / SCATTER_SERIES))]
    if not chosen:
        return 0.0
    typical = float(np.median(np.concatenate([each.sd for each in chosen])))
    spread = float(np.median([np.std(each.value) for each in chosen]))
    choices = np.concatenate([[0.0], np.geomspace(0.05, 10.0, 18) * max(typical, spread, 1e-12)])

    def likelihood(each: Series, scatter: float) -> float:
        design = _design(each)
        variance = each.sd**2 + scatter**2
        inner = design.T @ (design / variance[:, np.newaxis])
        best = np.linalg.pinv(inner) @ (design.T @ (each.value / variance))
        rest = each.value - design @ best
        size = float(np.sum(np.log(variance))) + np.linalg.slogdet(inner)[1] + rest @ (rest / variance)
        return -0.5 * float(size)

    common = np.array([[likelihood(each, scatter) for scatter in choices.tolist()] for each in chosen])
    own = np.max(common, axis=1, keepdims=True) + math.log(OWN_SCATTER)
    return float(choices[int(np.argmax(np.sum(np.logaddexp(common, own), axis=0)))])


def _two_kinds(slopes: FloatArray, errors: FloatArray) -> tuple[float, tuple[float, float], float]:
    """Fits the mixture of slopes. Returns the standard deviation of unchanging joints, mean and standard
    deviation of changing joints, and the fraction of changing joints.
    """
    middle = float(np.median(np.abs(slopes)))
    stay = 0.3 * max(middle, float(np.median(errors)))
    mean, deviation, share = 0.0, max(3.0 * float(np.std(slopes)), 3.0 * stay, 1e-12), 0.1
    for _ in range(200):
        narrow = _log_normal(slopes, 0.0, np.hypot(stay, errors)) + math.log(1.0 - share)
        wide = _log_normal(slopes, mean, np.hypot(deviation, errors)) + math.log(share)
        changing = expit(wide - narrow)
        # Expected true slopes of both kinds, and their spread; the priors prevent extremes in a small fleet.
        shrink = deviation**2 / (deviation**2 + errors**2)
        true, left = mean + shrink * (slopes - mean), shrink * errors**2
        total = float(np.sum(changing))
        new_mean = float(changing @ true) / (total + 1.0)
        new_deviation = math.sqrt(
            (float(changing @ ((true - new_mean) ** 2 + left)) + deviation**2) / (total + 1.0)
        )
        shrink = stay**2 / (stay**2 + errors**2)
        true, left = shrink * slopes, shrink * errors**2
        rest = 1.0 - changing
        new_stay = math.sqrt((float(rest @ (true**2 + left)) + stay**2) / (float(np.sum(rest)) + 1.0))
        new_share = min(max((total + 0.5) / (len(slopes) + 5.0), 1e-3), 0.8)
        moved = abs(new_share - share) + abs(new_mean - mean) / deviation
        stay, mean, deviation, share = max(new_stay, 1e-9), new_mean, max(new_deviation, 1e-9), new_share
        if moved < 1e-6:
            break
    return stay, (mean, deviation), share


# -- Identity


@dataclass(frozen=True, slots=True)
class Identity:
    """Reason why the orders of a recording differ from its joint's first recording."""

    kind: str
    """``swapped``: the orders are another joint's; ``turned``: the motor encoder was exchanged or its zero
    set; ``changed``: the orders match no joint."""
    other: int | None = None
    """Number of the joint whose orders match, if ``swapped``."""
    angle_deg: float | None = None
    """Offset of the motor angle, if ``turned``."""


def identities(orders: Complexes, joint: Sequence[int], time: Sequence[Any]) -> list[Identity | None]:
    """Checks by the motor orders that each recording belongs to its joint; returns None for each that does.

    ``orders``, shape (recordings, orders), are amplitude times exp(i phase) of the orders 1, 2, ...; rows
    with NaN are missing. Each recording is compared with the first recording of its joint.
    """
    numbers = np.asarray(joint)
    known = np.all(np.isfinite(orders), axis=1) & (orders.shape[1] > 0)
    first: dict[int, int] = {}
    for place in sorted(range(len(numbers)), key=lambda each: time[each]):
        if known[place]:
            first.setdefault(int(numbers[place]), place)
    result: list[Identity | None] = [None] * len(numbers)
    later = [place for place in range(len(numbers)) if known[place] and first[int(numbers[place])] != place]
    if not later:
        return result
    apart = np.abs(orders[later] - orders[[first[int(numbers[place])] for place in later]])
    absolute = np.maximum(
        np.median(apart, axis=0) / 1.1774, 0.02
    )  # 1.1774: median of a Rayleigh distribution of scale 1
    joints = list(first)
    references = orders[[first[each] for each in joints]]
    scale = np.hypot(absolute, EVERYDAY_SHARE * np.median(np.abs(references), axis=0))
    tree = cKDTree(np.hstack([references.real / scale, references.imag / scale]))
    degrees = 2 * orders.shape[1]
    agree, disagree = float(chdtri(degrees, AGREE)), float(chdtri(degrees, DISAGREE))
    turns = np.radians(np.arange(0.0, 360.0, PHASE_STEP_DEG))
    turned_by = np.exp(1j * np.outer(turns, np.arange(1, orders.shape[1] + 1)))

    def distance(seen: Complexes, reference: Complexes) -> FloatArray:
        spread = np.hypot(absolute, EVERYDAY_SHARE * np.abs(reference))
        return np.asarray(np.sum(np.abs(seen - reference) ** 2 / spread**2, axis=-1))

    for place in later:
        own, seen = orders[first[int(numbers[place])]], orders[place]
        if float(distance(seen, own)) < disagree:
            continue
        _, near = tree.query(np.concatenate([seen.real / scale, seen.imag / scale]), k=min(4, len(joints)))
        others = [each for each in np.atleast_1d(near).tolist() if joints[each] != numbers[place]]
        best = min(others, key=lambda each: float(distance(seen, references[each])), default=None)
        if best is not None and float(distance(seen, references[best])) < agree:
            result[place] = Identity("swapped", other=joints[best])
            continue
        rotated = distance(seen, own * turned_by)
        angle = int(np.argmin(rotated))
        strong = int(np.sum(np.abs(own) > 3.0 * np.hypot(absolute, EVERYDAY_SHARE * np.abs(own))))
        if float(rotated[angle]) < agree and strong >= 3:
            result[place] = Identity("turned", angle_deg=angle * PHASE_STEP_DEG)
        else:
            result[place] = Identity("changed")
    return result
