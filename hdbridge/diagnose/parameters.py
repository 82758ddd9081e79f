"""Parameters of a fitted effect with 95 % intervals that allow for noise which is not white."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from hdbridge.diagnose.gates import BLOCKS_S, blocks
from hdbridge.diagnose.result import Parameter
from hdbridge.diagnose.theory import Fitted, Workshop, shape_value
from hdbridge.effects import CountLoss, Creep, Effect, FloatArray, SubdivisionalError, Vibration
from hdbridge.effects.base import Linear
from hdbridge.effects.orders import OrderSeries

NORMAL_95: Final = 1.96
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


def covariance(workshop: Workshop, fitted: Fitted) -> FloatArray:
    """Of all parameters, shape (p, p): the sandwich over blocks of time, the more careful of their
    lengths.
    """
    tangent, residual = fitted.tangent, fitted.residual
    gram = tangent.T @ tangent
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > 1e-9 * float(values[-1])
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    inverse[np.diag(gram) <= 0.0] = 0.0
    inverse[:, np.diag(gram) <= 0.0] = 0.0
    best = inverse * max(float(residual @ residual) / max(len(residual) - fitted.count(), 1), 0.25)
    scores = tangent * residual[:, np.newaxis]
    for length in (*BLOCKS_S, 20.0):
        number = blocks(workshop.time_s, length)
        count = int(number[-1]) + 1
        if count < 20:
            continue
        sums = np.stack([np.bincount(number, each) for each in scores.T], axis=1)
        spread = inverse @ (sums.T @ sums) @ inverse * (count / (count - 1))
        larger = np.sqrt(np.maximum(np.diag(spread), 0.0) / np.maximum(np.diag(best), 1e-300))
        grow = np.maximum(larger, 1.0)
        best = best * np.outer(grow, grow)
    return np.asarray(best)


def parameters_of(fitted: Fitted, place: int, spread: FloatArray) -> dict[str, Parameter]:
    """Those of one effect, by the names of the model file where it has them."""
    effect = fitted.theory.effects[place]
    own = fitted.places(place)
    linear = [i for i in own if not fitted.parameters[i].shape]
    result = _linear(effect, spread[np.ix_(linear, linear)])
    for i in own:
        parameter = fitted.parameters[i]
        if not parameter.shape:
            continue
        value = shape_value(effect, parameter.name)
        half = NORMAL_95 * math.sqrt(max(float(spread[i, i]), 0.0))
        if parameter.logarithmic:
            low, high = value * math.exp(-min(half, 20.0)), value * math.exp(min(half, 20.0))
        else:
            low, high = value - half, value + half
        result[parameter.name] = Parameter(value, unit_of(parameter.name), low, high)
    if isinstance(effect, Vibration):
        result["frequency_hz"] = Parameter(
            effect.frequency_hz, "Hz", effect.frequency_hz, effect.frequency_hz
        )
    if isinstance(effect, SubdivisionalError):
        lines = float(effect.lines_per_turn)
        result["lines_per_turn"] = Parameter(lines, "1", lines, lines)
    return result


def _linear(effect: Effect, spread: FloatArray) -> dict[str, Parameter]:
    values = effect.coefficients()
    deviation = np.sqrt(np.maximum(np.diag(spread), 0.0))

    def plain(name: str, i: int) -> Parameter:
        half = NORMAL_95 * float(deviation[i])
        return Parameter(float(values[i]), unit_of(name), float(values[i]) - half, float(values[i]) + half)

    if isinstance(effect, OrderSeries | SubdivisionalError):
        result: dict[str, Parameter] = {}
        for i, order in enumerate(effect.orders):
            result |= _polar(
                f"order_{order.order}_",
                values[2 * i : 2 * i + 2],
                spread[2 * i : 2 * i + 2, 2 * i : 2 * i + 2],
            )
        return result
    if isinstance(effect, Vibration):
        return _polar("", values[:2], spread[:2, :2])
    if isinstance(effect, CountLoss):
        lost: dict[str, Parameter] = {}
        for i, step in enumerate(effect.steps):
            lost[f"step_{i + 1}_size_arcsec"] = plain("size_arcsec", i)
            lost[f"step_{i + 1}_time_s"] = Parameter(step.time_s, "s", step.time_s, step.time_s)
        return lost
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


def _polar(prefix: str, pair: FloatArray, spread: FloatArray) -> dict[str, Parameter]:
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
            amplitude, "arcsec", max(amplitude - half, 0.0), amplitude + half
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
