"""Parameters of a fitted effect with 95 % intervals that allow for noise which is not white."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy.special import stdtrit

from hdbridge.diagnose.acceptance import BLOCKS_S
from hdbridge.diagnose.result import Parameter
from hdbridge.diagnose.systematic import systematic
from hdbridge.effects import Effect, FloatArray, IntArray, Moves
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.intervals import NORMAL_95, half_widths, joined, labelled, leaves
from hdbridge.estimation.shapes import shape_value
from hdbridge.estimation.stretches import of_length, sandwich, sums
from hdbridge.estimation.terms import Column
from hdbridge.units import unit_of

WAVE: Final = ("amplitude_arcsec", "phase_deg")
PARTS: Final = (6, 12)
"""Numbers of equal parts of a record that count as one observation each."""
STEP_95: Final = 11.03
"""95 % point of where a Brownian motion with the drift -|t| / 2 to either side is largest."""


def covariance(estimator: Estimator, fitted: Fitted) -> FloatArray:
    """Of all parameters, shape (p, p), so that `NORMAL_95` standard deviations are a 95 % interval.

    The sandwich over blocks of time, and of all lengths of blocks the most careful: seconds for noise that
    wanders, and `PARTS` of the whole record for what the hypothesis gets wrong from one part of a bench to
    the next. Few parts tell a variance badly, so Student's quantile stands for the normal one, with as many
    degrees of freedom as parts carry the parameter, less one (Bester, Conley and Hansen 2011; effective
    number of clusters as Carter, Schnepel and Steigerwald 2017). What no residual shows is added
    (`systematic`).
    """
    tangent, residual = fitted.tangent, fitted.residual
    directions, known = fitted.linearised.directions, fitted.linearised.known
    inverse = directions @ directions.T
    best = inverse * max(float(residual @ residual) / max(len(residual) - fitted.count(), 1), 0.25)
    influence = tangent @ inverse
    moved = influence * residual[:, np.newaxis] + inverse @ known[:, 1] / len(residual)  # about their mean
    of_prior = inverse @ np.diag(np.maximum(known[:, 0], 0.0)) @ inverse

    def at_least(number: IntArray, normal: bool) -> FloatArray:
        spread = sandwich(moved, number) + of_prior
        if not normal:
            share = sums(influence**2, number)
            carried = np.sum(share, axis=0) ** 2 / np.maximum(np.sum(share**2, axis=0), 1e-300)
            wider = stdtrit(np.maximum(carried - 1.0, 1.0), 0.975) / NORMAL_95
            spread = spread * np.outer(wider, wider)
        larger = np.sqrt(np.maximum(np.diag(spread), 0.0) / np.maximum(np.diag(best), 1e-300))
        grow = np.maximum(larger, 1.0)
        return np.asarray(best * np.outer(grow, grow))

    for length in BLOCKS_S:
        number = of_length(estimator.time_s, length)
        if int(number[-1]) + 1 >= 20:
            best = at_least(number, normal=True)
    for parts in PARTS:
        best = at_least(np.arange(len(residual)) * parts // len(residual), normal=False)
    return np.asarray(best + systematic(estimator, fitted))


def parameters_of(
    estimator: Estimator, fitted: Fitted, place: int, spread: FloatArray
) -> dict[str, Parameter]:
    """Those of one effect, by the names of the model file where it has them."""
    effect, own = fitted.hypothesis.effects[place], fitted.places(place)
    result = named_parameters(effect, [fitted.parameters[i] for i in own], spread[np.ix_(own, own)])
    for shape in effect.shape:
        if shape.is_frequency and shape.name not in result:
            value = shape_value(effect, shape.name)
            result[shape.name] = Parameter(value, unit_of(shape.name), value, value)
        if shape.moves is Moves.NEVER:
            result = _stepwise(estimator, fitted, effect, result)
    for name, described in type(effect).model_fields.items():
        if described.annotation is int:  # found by search, and exact
            number = float(getattr(effect, name))
            result[name] = Parameter(number, unit_of(name), number, number)
    return result


def named_parameters(effect: Effect, columns: Sequence[Column], spread: FloatArray) -> dict[str, Parameter]:
    """An effect's parameters by the covariance (c, c) of its ``columns``; without what nothing in the record
    depends on.
    """
    names: dict[str, str] = {}
    for each in effect.named_coefficients():
        path = labelled(effect.parameters(), each.path)
        wave = len(each.columns) > 1
        names |= {joined(path, leaf): each.name + leaf for leaf in (WAVE if wave else ("",))}
    shapes = {each.name: each for each in effect.shape}
    values = dict(leaves(effect.parameters()))
    result: dict[str, Parameter] = {}
    for path, half in half_widths(effect, columns, spread).items():
        name, value = names.get(path, path.rpartition(".")[2]), values[path]
        low, high = value - half, value + half
        is_size = path in names and not name.endswith("phase_deg")
        shape = shapes.get(name)
        if shape is not None and shape.logarithmic:  # no further than it may be
            factor = math.exp(min(half / value, math.log(shape.upper / shape.lower)))
            low = min(value, max(value / factor, shape.lower))
            high = max(value, min(value * factor, shape.upper))
        amplitude = result.get(name.replace("phase_deg", "amplitude_arcsec"))
        if amplitude is not None and amplitude.low <= 0.0:  # what may be nothing has any phase
            low, high = value - 180.0, value + 180.0
        if half > 0.0 and name not in result:  # a shape that several parts share is told once
            result[name] = Parameter(value, unit_of(name), low, high, is_size)
    return result


def _stepwise(
    estimator: Estimator, fitted: Fitted, effect: Effect, sizes: Mapping[str, Parameter]
) -> dict[str, Parameter]:
    """Sizes and times of steps.

    A step seen first at one sample happened since the one before. How many samples further off noise may
    have put it is the place of the largest likelihood of a step in white noise, within
    `STEP_95` (sigma / size)^2 samples (Yao 1987).
    """
    result: dict[str, Parameter] = {}
    time_s = estimator.time_s
    scatter = math.sqrt(float(np.mean(fitted.residual**2)))
    for piece, named in zip(effect.pieces(), effect.named_coefficients(), strict=True):
        begin_s, size = shape_value(piece, piece.shape[0].name), float(piece.coefficients()[0])
        if named.name in sizes:
            result[named.name] = sizes[named.name]
        first = min(int(np.searchsorted(time_s, begin_s)), len(time_s) - 1)
        sigmas = max(abs(size) * float(estimator.weight[first]), 1e-9) / max(scatter, 1.0)
        beyond = min(math.ceil(STEP_95 / sigmas**2 - 0.5), len(time_s))
        low, high = (
            float(time_s[max(first - 1 - beyond, 0)]),
            float(time_s[min(first + beyond, len(time_s) - 1)]),
        )
        name = f"{named.name.removesuffix('size_arcsec')}{piece.shape[0].name}"
        result[name] = Parameter(begin_s, "s", min(low, begin_s), max(high, begin_s))
    return result
