"""Parameters of a fitted effect with 95 % intervals that allow for noise which is not white."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from scipy.stats import t as student

from hdbridge.diagnose.acceptance import BLOCKS_S, blocks
from hdbridge.diagnose.result import Parameter
from hdbridge.effects import CountLoss, Creep, Effect, FloatArray, SubdivisionalError, Vibration
from hdbridge.effects.base import Linear
from hdbridge.effects.orders import OrderSeries
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.observed import IntArray
from hdbridge.estimation.shapes import shape_value

NORMAL_95: Final = 1.96
PARTS: Final = (6, 12)
"""Numbers of equal parts of a record that count as one observation each."""
STEP_95: Final = 11.03
"""95 % point of where a Brownian motion with the drift -|t| / 2 to either side is largest."""
_UNITS: Final = {
    "arcsec_per_kiloturn": "arcsec/kiloturn",
    "arcsec_s_per_deg": "arcsec s/deg",
    "arcsec_per_turn": "arcsec/turn",
    "arcsec_per_nm": "arcsec/Nm",
    "arcsec_per_k": "arcsec/K",
    "percent_per_nm": "%/Nm",
    "percent_per_k": "%/K",
    "stiffness_s2": "s^2",
    "percent": "%",
    "arcsec": "arcsec",
    "deg_s2": "deg/s^2",
    "deg_s": "deg/s",
    "deg": "deg",
    "ms2": "ms^2",
    "ms": "ms",
    "hz": "Hz",
    "nm": "Nm",
    "s": "s",
}


def covariance(estimator: Estimator, fitted: Fitted) -> FloatArray:
    """Of all parameters, shape (p, p), so that `NORMAL_95` standard deviations are a 95 % interval.

    The sandwich over blocks of time, and of all lengths of blocks the most careful: seconds for noise that
    wanders, and `PARTS` of the whole record for what the hypothesis gets wrong from one part of a bench to
    the next. Few parts tell a variance badly, so Student's quantile stands for the normal one, with as many
    degrees of freedom as parts carry the parameter, less one (Bester, Conley and Hansen 2011; effective
    number of clusters as Carter, Schnepel and Steigerwald 2017).
    """
    tangent, residual = fitted.tangent, fitted.residual
    gram = tangent.T @ tangent + np.diag(fitted.information)
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > 1e-9 * float(values[-1])
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    inverse[np.diag(gram) <= 0.0] = 0.0
    inverse[:, np.diag(gram) <= 0.0] = 0.0
    best = inverse * max(float(residual @ residual) / max(len(residual) - fitted.count(), 1), 0.25)
    scores = tangent * residual[:, np.newaxis] + fitted.pull / len(residual)  # about their mean

    of_prior = inverse @ np.diag(np.maximum(fitted.information, 0.0)) @ inverse

    def at_least(number: IntArray, normal: bool) -> FloatArray:
        sums, count = _sums(scores, number), int(number[-1]) + 1
        spread = inverse @ (sums.T @ sums) @ inverse * (count / (count - 1)) + of_prior
        if not normal:
            share = _sums((tangent @ inverse) ** 2, number)
            carried = np.sum(share, axis=0) ** 2 / np.maximum(np.sum(share**2, axis=0), 1e-300)
            wider = student.ppf(0.975, np.maximum(carried - 1.0, 1.0)) / NORMAL_95
            spread = spread * np.outer(wider, wider)
        larger = np.sqrt(np.maximum(np.diag(spread), 0.0) / np.maximum(np.diag(best), 1e-300))
        grow = np.maximum(larger, 1.0)
        return np.asarray(best * np.outer(grow, grow))

    for length in (*BLOCKS_S, 20.0):
        number = blocks(estimator.time_s, length)
        if int(number[-1]) + 1 >= 20:
            best = at_least(number, normal=True)
    for parts in PARTS:
        best = at_least(np.arange(len(residual)) * parts // len(residual), normal=False)
    return np.asarray(best)


def _sums(rows: FloatArray, number: IntArray) -> FloatArray:
    """Sums of rows by their number, shape (numbers, p)."""
    return np.stack([np.bincount(number, each) for each in rows.T], axis=1)


def parameters_of(
    estimator: Estimator, fitted: Fitted, place: int, spread: FloatArray
) -> dict[str, Parameter]:
    """Those of one effect, by the names of the model file where it has them."""
    effect = fitted.hypothesis.effects[place]
    own = fitted.places(place)
    linear = [i for i in own if not fitted.parameters[i].shape]
    result = _linear(effect, spread[np.ix_(linear, linear)])
    for i in own:
        parameter = fitted.parameters[i]
        if not parameter.shape or spread[i, i] <= 0.0:
            continue  # nothing in the record depends on it
        value = shape_value(effect, parameter.name)
        half = NORMAL_95 * math.sqrt(max(float(spread[i, i]), 0.0))
        if parameter.logarithmic:
            low, high = value * math.exp(-min(half, 20.0)), value * math.exp(min(half, 20.0))
        else:
            low, high = value - half, value + half
        result[parameter.name] = Parameter(value, unit_of(parameter.name), low, high)
    if isinstance(effect, Vibration) and "frequency_hz" not in result:
        result["frequency_hz"] = Parameter(
            effect.frequency_hz, "Hz", effect.frequency_hz, effect.frequency_hz
        )
    if isinstance(effect, CountLoss):
        result = _lost(estimator, fitted, effect, linear, spread)
    if isinstance(effect, SubdivisionalError):
        lines = float(effect.lines_per_turn)
        result["lines_per_turn"] = Parameter(lines, "1", lines, lines)
    return result


def _linear(effect: Effect, spread: FloatArray) -> dict[str, Parameter]:
    values = effect.coefficients()
    deviation = np.sqrt(np.maximum(np.diag(spread), 0.0))

    def plain(name: str, i: int) -> Parameter:
        half = NORMAL_95 * float(deviation[i])
        value = float(values[i])
        return Parameter(value, unit_of(name), value - half, value + half, is_size=True)

    if isinstance(effect, OrderSeries | SubdivisionalError):
        result: dict[str, Parameter] = {}
        for i, order in enumerate(effect.orders):
            result |= polar(
                f"order_{order.order}_",
                values[2 * i : 2 * i + 2],
                spread[2 * i : 2 * i + 2, 2 * i : 2 * i + 2],
            )
        return result
    if isinstance(effect, Vibration):
        return polar("", values[:2], spread[:2, :2])
    if isinstance(effect, Creep):
        return {f"part_{i + 1}_amplitude_arcsec": plain("amplitude_arcsec", i) for i in range(len(values))}
    if isinstance(effect, Linear):
        return {name: plain(name, i) for i, name in enumerate(effect.linear) if deviation[i] > 0.0}
    names = {
        "hysteresis": "offset_arcsec",
        "hysteresis_memory": "offset_arcsec",
        "direction_phase": "shift_deg",
    }
    if effect.name in names and len(values) == 1:
        return {names[effect.name]: plain(names[effect.name], 0)}
    return {f"coefficient_{i + 1}_arcsec": plain("arcsec", i) for i in range(len(values))}


def _lost(
    estimator: Estimator, fitted: Fitted, effect: CountLoss, columns: list[int], spread: FloatArray
) -> dict[str, Parameter]:
    """Sizes and times of steps.

    A step seen first at one sample happened since the one before. How many samples further off noise may
    have put it is the place of the largest likelihood of a step in white noise, within
    `STEP_95` (sigma / size)^2 samples (Yao 1987).
    """
    result: dict[str, Parameter] = {}
    time_s = estimator.time_s
    scatter = math.sqrt(float(np.mean(fitted.residual**2)))
    for i, (step, column) in enumerate(zip(effect.steps, columns, strict=True)):
        half = NORMAL_95 * math.sqrt(max(float(spread[column, column]), 0.0))
        size = step.size_arcsec
        result[f"step_{i + 1}_size_arcsec"] = Parameter(
            size, "arcsec", size - half, size + half, is_size=True
        )
        first = min(int(np.searchsorted(time_s, step.time_s)), len(time_s) - 1)
        sigmas = max(abs(size) * float(estimator.weight[first]), 1e-9) / max(scatter, 1.0)
        beyond = min(math.ceil(STEP_95 / sigmas**2 - 0.5), len(time_s))
        low, high = (
            float(time_s[max(first - 1 - beyond, 0)]),
            float(time_s[min(first + beyond, len(time_s) - 1)]),
        )
        result[f"step_{i + 1}_time_s"] = Parameter(
            step.time_s, "s", min(low, step.time_s), max(high, step.time_s)
        )
    return result


def polar(prefix: str, pair: FloatArray, spread: FloatArray) -> dict[str, Parameter]:
    """Amplitude and phase of a cosine and a sine, from their covariance."""
    cosine, sine = map(float, pair)
    amplitude = math.hypot(cosine, sine)
    phase = math.degrees(math.atan2(-sine, cosine))
    along = np.array([cosine, sine]) / max(amplitude, 1e-12)
    across = np.array([-along[1], along[0]])
    half = NORMAL_95 * math.sqrt(max(float(along @ spread @ along), 0.0))
    turn = math.degrees(
        min(NORMAL_95 * math.sqrt(max(float(across @ spread @ across), 0.0)) / max(amplitude, 1e-12), math.pi)
    )
    return {
        f"{prefix}amplitude_arcsec": Parameter(
            amplitude, "arcsec", max(amplitude - half, 0.0), amplitude + half, is_size=True
        ),
        f"{prefix}phase_deg": Parameter(phase, "deg", phase - turn, phase + turn),
    }


def unit_of(name: str) -> str:
    """The unit that a parameter's name ends with; 1 where it has none."""
    return next(
        (unit for ending, unit in _UNITS.items() if name == ending or name.endswith("_" + ending)), "1"
    )


def half_widths(effect: Effect, values: Mapping[str, Parameter]) -> dict[str, Any]:
    """95 % half widths nested like the parameters of the model file; whole numbers stand as they are."""
    halves = {
        name: float(f"{0.5 * (each.high - each.low):.4g}")
        for name, each in values.items()
        if math.isfinite(each.high - each.low)
    }
    fields = type(effect).model_fields
    nested: dict[str, Any] = {name: half for name, half in halves.items() if name in fields}
    if isinstance(effect, OrderSeries | SubdivisionalError):
        nested["orders"] = [
            {"order": each.order}
            | {
                name: halves[f"order_{each.order}_{name}"]
                for name in ("amplitude_arcsec", "phase_deg")
                if f"order_{each.order}_{name}" in halves
            }
            for each in effect.orders
        ]
    if isinstance(effect, CountLoss):
        nested["steps"] = [
            {"size_arcsec": halves.get(f"step_{i + 1}_size_arcsec", 0.0)} for i in range(len(effect.steps))
        ]
    if isinstance(effect, Creep):
        nested["parts"] = [
            {"amplitude_arcsec": halves.get(f"part_{i + 1}_amplitude_arcsec", 0.0)}
            for i in range(len(effect.parts))
        ]
    return nested
