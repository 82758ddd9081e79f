"""Parameters of findings with 95 % intervals, including systematic errors that leave no residual.

A sandwich estimate over blocks does not include these errors, because they are constant over the whole
record. Each error is a column of one standard deviation, and shifts the parameters by the amount that the fit
absorbs. Its source is either the uncertainty of an effect's law, or an undetected cause that only a measured
channel separates from the finding. An eccentric mass, for example, winds the gear up once per load turn, like
run-out of the load encoder.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.special import stdtrit

from hdbridge.analysis.acceptance import BLOCKS_S
from hdbridge.analysis.findings import Parameter
from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.intervals import NORMAL_95, half_widths, joined, labelled, leaves
from hdbridge.analysis.linear import FOUND, Column, Effort, Nuisances, of_length, sandwich, sums
from hdbridge.analysis.nuisances import speeds_differ, swing
from hdbridge.analysis.screening import proposed
from hdbridge.analysis.search import lookalikes
from hdbridge.analysis.separable import shape_value
from hdbridge.axis.effects import CATALOGUE, Effect, FloatArray, IntArray, Moves, aliases_of
from hdbridge.axis.effects.orders import RAD_PER_DEG
from hdbridge.units import unit_of


class Confounded(NamedTuple):
    """An undetected cause that may bias a finding."""

    name: str
    shift: FloatArray
    """Shift of the fit's parameters for one standard deviation of the undetected cause, shape (p, k)."""


def confounded(estimator: Estimator, fitted: Fitted, place: int) -> Iterator[Confounded]:
    """Yields causes that, at typical size, would be undetected in the presence of the effect at ``place``."""
    effects, scales = fitted.hypothesis.effects, estimator.scales
    held = zip(fitted.parameters, fitted.information.tolist(), strict=True)
    known = {each.effect for each, information in held if information}  # held by their calibration
    if place in known:
        return
    for other, columns, noise in _alike(estimator, fitted, place):
        theirs = [at for at, each in enumerate(effects) if each.name == other.name]
        if known & set(theirs):
            continue  # its calibration separates the two
        own = np.array([i for i, each in enumerate(fitted.parameters) if each.effect not in theirs])
        fit = fitted.linearised.of(own)
        shift = fit.taken_over(columns)
        left = columns - fit.columns @ shift
        claimed = noise * np.sum(columns**2, axis=0)
        seen, axes = np.linalg.eigh(left.T @ left - np.diag(claimed))
        if seen[0] < scales.enter + scales.penalty:
            moved = np.zeros((fitted.count(), len(seen)))
            moved[own] = shift @ axes / np.sqrt(1.0 + np.maximum(seen, 0.0))
            yield Confounded(other.name, moved)


def systematic(estimator: Estimator, fitted: Fitted) -> FloatArray:
    """Returns the covariance of all parameters due to systematic errors, shape (p, p)."""
    added = np.zeros((fitted.count(), fitted.count()))
    for place, effect in enumerate(fitted.hypothesis.effects):
        shift = fitted.linearised.taken_over(estimator.law_discrepancy(effect, fitted.hypothesis.start))
        added += shift @ shift.T
        own = fitted.places(place)
        for each in confounded(estimator, fitted, place):
            added[np.ix_(own, own)] += each.shift[own] @ each.shift[own].T
    return added


def _alike(estimator: Estimator, fitted: Fitted, place: int) -> Iterator[tuple[Effect, FloatArray, float]]:
    """Yields causes that only a measured channel separates from the effect.

    Each comes with its weighted columns at typical size, and with the fraction of their sum of squares that
    is due to channel noise.
    """
    effect, ratio = fitted.hypothesis.effects[place], estimator.data.ratio
    start = fitted.hypothesis.start
    pairs = [
        (each, type(piece), each)
        for kind, piece in lookalikes(effect, ratio)
        for each in proposed(kind, estimator.data)[:1]
    ]
    look = effect.unmeasured(ratio)
    if look is not None and look.name in aliases_of(effect.name) and look.name in CATALOGUE:
        pairs.append((look, type(look), effect))
    for other, wave, driven in pairs:
        columns = estimator.columns(other, start)
        columns = columns[:, np.ptp(columns, axis=0) > 0.0]
        typical = wave.candidate(ratio).largest_piece_arcsec() / np.maximum(
            np.max(np.abs(columns), axis=0), 1e-9
        )
        square = float(np.sum(estimator.weighted(estimator.columns(driven, start)) ** 2))
        noise = float(np.sum(estimator.channel_noise(driven, start))) / max(square, 1e-300)
        yield other, estimator.weighted(columns * typical), noise


# Final fit of the parameters, including the load oscillation.


def precisely(estimator: Estimator, fitted: Fitted) -> Fitted:
    """Refits a hypothesis with the load oscillation due to its waves, and with more shapes free (`FOUND`).

    At a single speed the oscillation is omitted, because it is not separable from the orders.
    """
    plain = estimator.fit(replace(fitted.hypothesis, nuisances=_shaken(estimator, fitted)))
    found = estimator.fit(plain.hypothesis, moves=FOUND)
    if any(each.violations() for each in found.hypothesis.effects):
        return estimator.fit(plain.hypothesis, FOUND, Effort(steps=1))
    return found


def _shaken(estimator: Estimator, fitted: Fitted) -> Nuisances | None:
    """Returns two columns of the load oscillation: an in-phase one that grows with frequency squared, and a
    lagging one that grows with its cube.

    The lagging column changes sign with the direction of motion. Returns None without orders, or at a single
    speed.
    """
    motion = estimator.data.full.motion
    speed = motion.motor_speed_deg_s
    waves = [wave for each in fitted.hypothesis.effects for wave in each.waves()]
    slow = estimator.motion.motor_speed_deg_s
    moving = np.empty(0) if slow is None else slow[estimator.index]
    moving = moving[moving != 0.0]
    if speed is None or not waves or not speeds_differ(moving, np.ones(len(moving))):
        return None
    angles = ((turns, size, RAD_PER_DEG * (turns * motion.motor_deg + phase)) for turns, size, phase in waves)
    both = ((turns, size * np.cos(angle), size * np.sin(angle)) for turns, size, angle in angles)
    return swing(RAD_PER_DEG * speed, both, estimator.at_points)


# Parameters of a fitted effect with 95 % intervals that allow for coloured noise.


WAVE: Final = ("amplitude_arcsec", "phase_deg")
PARTS: Final = (6, 12)
"""Numbers of equal parts into which a record is divided. Each part contributes one observation."""
STEP_95: Final = 11.03
"""95 % range of the position of the maximum of a Brownian motion with drift -|t| / 2 on either side."""


def covariance(estimator: Estimator, fitted: Fitted) -> FloatArray:
    """Returns the covariance of all parameters, (p, p), such that `NORMAL_95` gives 95 % intervals.

    It is the largest of several sandwich estimates: over blocks of seconds, for correlated noise, and over
    `PARTS` of the record, for errors of the hypothesis that differ between the parts. A variance estimated
    from few parts is inaccurate, so Student's quantile replaces the normal one. Its degrees of freedom are
    the effective number of parts that determine the parameter, less one (Bester, Conley and Hansen 2011;
    Carter, Schnepel and Steigerwald 2017). Systematic errors are added (`systematic`).
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
    """Returns the parameters of one effect, named as in the model file where possible."""
    effect, own = fitted.hypothesis.effects[place], fitted.places(place)
    result = named_parameters(effect, [fitted.parameters[i] for i in own], spread[np.ix_(own, own)])
    for shape in effect.shape:
        if shape.is_frequency and shape.name not in result:
            value = shape_value(effect, shape.name)
            result[shape.name] = Parameter(value, unit_of(shape.name), value, value)
        if shape.moves is Moves.NEVER:
            result = _stepwise(estimator, fitted, effect, result)
    for name, described in type(effect).model_fields.items():
        if described.annotation is int:  # an integer found by search is exact
            number = float(getattr(effect, name))
            result[name] = Parameter(number, unit_of(name), number, number)
    return result


def named_parameters(effect: Effect, columns: Sequence[Column], spread: FloatArray) -> dict[str, Parameter]:
    """Returns an effect's parameters, with intervals from the covariance ``spread`` (c, c) of its columns.

    Omits parameters that do not influence the record.
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
        if shape is not None and shape.logarithmic:  # the interval is limited to the shape's range
            factor = math.exp(min(half / value, math.log(shape.upper / shape.lower)))
            low = min(value, max(value / factor, shape.lower))
            high = max(value, min(value * factor, shape.upper))
        amplitude = result.get(name.replace("phase_deg", "amplitude_arcsec"))
        if amplitude is not None and amplitude.low <= 0.0:  # a zero amplitude has no phase
            low, high = value - 180.0, value + 180.0
        if half > 0.0 and name not in result:  # a shape shared by several parts is reported once
            result[name] = Parameter(value, unit_of(name), low, high, is_size)
    return result


def _stepwise(
    estimator: Estimator, fitted: Fitted, effect: Effect, sizes: Mapping[str, Parameter]
) -> dict[str, Parameter]:
    """Returns the sizes and times of steps, with their intervals.

    A step that is first seen at one sample occurred after the previous sample. Noise may shift its most
    likely position by up to `STEP_95` (sigma / size)^2 samples, the 95 % range for a step in white noise (Yao
    1987).
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
