"""Findings within the model's own parts: the elastic law, its parameters, the first two orders of the motor.

Calibrations are a few per cent off as a rule, and that is no finding: the change has to be larger than that.
"""

from __future__ import annotations

import math

import numpy as np

from hdbridge.diagnose.experiment import next_experiment
from hdbridge.diagnose.holdout import held_out, held_out_change
from hdbridge.diagnose.parameters import parameters_of, polar
from hdbridge.diagnose.result import Finding, Parameter
from hdbridge.diagnose.search import EXTRAPOLATED, PENALTY, Trail
from hdbridge.effects import (
    DirectionPhase,
    Effect,
    FloatArray,
    HysteresisParameters,
    Loop,
    MotorEncoderEccentricity,
    Synchronous,
)
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import MotorOrder
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.model import TransmissionModel

LAW_GAIN = 60.0
"""Chi square by which another elastic law has to be better."""
LAW_ARCSEC = 0.5
"""... and the root mean square by which the two predictions differ there."""
LOOP_SHARE = 0.12
LOOP_ARCSEC = 1.5
"""A loop has changed when it differs by this share of itself, root mean square, and by this much."""
CALIBRATED = 0.04
CALIBRATIONS = 4.0
"""... or, since width and exponent show only after a reversal, when its parameters are so many standard
deviations away: those of a calibration, this share of each, and of the fit together."""
ORDER_SHARE = 0.15
ORDER_ARCSEC = 0.8
"""The same for an order of the motor."""


def findings(
    estimator: Estimator, model: TransmissionModel, trail: Trail, precise: Fitted, spread: FloatArray
) -> list[Finding]:
    """What has changed within the baseline, as the fit for parameters has it, with their covariance."""
    result: list[Finding] = []
    for place, (given, now) in enumerate(zip(model.effects, precise.hypothesis.effects, strict=False)):
        if isinstance(given, Hysteresis | HysteresisMemory):
            if estimator.data.reversals < 2:
                continue  # a loop shows only where the axis reverses
            found = _law(estimator, trail, precise, place, given, now, spread)
        elif isinstance(given, Synchronous):
            found = _orders(estimator, precise, place, given, now, spread)
        else:
            found = None
        if found is not None:
            result.append(found)
    return result


def _law(
    estimator: Estimator,
    trail: Trail,
    precise: Fitted,
    place: int,
    given: Effect,
    now: Effect,
    spread: FloatArray,
) -> Finding | None:
    fitted = trail.fitted
    start = fitted.hypothesis.start

    def values(effect: Effect) -> FloatArray:
        return estimator.columns(effect, start) @ effect.coefficients()

    if type(given) is not type(now):
        if trail.law_gain < LAW_GAIN or not isinstance(now, HysteresisMemory):
            return None
        old = estimator.fit(fitted.hypothesis.instead(place, type(given)(**now.parameters())))
        apart = (old.residual - fitted.residual) / estimator.weight
        if (
            float(np.sqrt(np.mean(apart**2))) < 0.25 * LAW_ARCSEC
            or float(np.max(np.abs(apart))) < 2.0 * LAW_ARCSEC
        ):
            return None
        gain = held_out(estimator, fitted, old)
        return Finding(
            "hysteresis_memory", 0.95, (), parameters_of(estimator, precise, place, spread),
            gain, next_experiment("hysteresis_memory", ()),
            float(np.quantile(np.abs(apart), 0.998)),
            robust=trail.law_gain, effect=now,
        )  # fmt: skip
    before, after = values(given), values(now)
    change, peak = float(np.std(after - before)), 0.5 * float(np.ptp(after - before))
    as_a_whole = change >= max(LOOP_ARCSEC, LOOP_SHARE * float(np.std(after)))
    lawless = _lawless_arcsec(estimator, fitted)
    if (
        not as_a_whole
        and not lawless
        and (peak < LOOP_ARCSEC or _away(precise, place, given, now, spread) < CALIBRATIONS)
    ):
        return None
    loop = Loop(**given.parameters(), memory=isinstance(given, HysteresisMemory))
    assert isinstance(now, Hysteresis | HysteresisMemory)
    effect = HysteresisParameters(
        base=loop, offset_arcsec=now.offset_arcsec, width_deg=now.width_deg, exponent=now.exponent
    )
    # A loop that obeys neither law may have memory in part of it, or in none.
    aliases = ("hysteresis_memory",) if lawless else ()
    residual = fitted.residual / estimator.weight
    apart = after - before - float(np.mean(after - before))
    taken = math.sqrt(max(float(np.mean((residual + apart) ** 2 - residual**2)), 0.0))
    moved = values(fitted.hypothesis.effects[place]) - before
    return Finding(
        "hysteresis_parameters", 0.9, aliases, parameters_of(estimator, precise, place, spread),
        held_out_change(estimator, fitted, fitted.places(place), moved),
        next_experiment("hysteresis_parameters", aliases), max(peak, lawless), taken_arcsec=taken,
        robust=float(np.sum((estimator.weight * (after - before - np.mean(after - before))) ** 2)),
        effect=effect, note="the baseline's own loop takes over the new parameters",
    )  # fmt: skip


def _lawless_arcsec(estimator: Estimator, fitted: Fitted) -> float:
    """What a loop of free form does in addition to the law, peak; 0 where the law does as well."""
    searched = estimator.nuisance
    if not searched.shape[1]:
        return 0.0
    estimator.nuisance = searched[:, :0]
    plain = estimator.fit(fitted.hypothesis)
    estimator.nuisance = searched
    apart = float(np.quantile(np.abs(plain.residual - fitted.residual) / estimator.weight, 0.998))
    gained = plain.chi_square - fitted.chi_square > LAW_GAIN + PENALTY * searched.shape[1]
    return apart if gained and apart > 2.0 * LAW_ARCSEC else 0.0


def _away(fitted: Fitted, place: int, given: Effect, now: Effect, spread: FloatArray) -> float:
    """How far offset, width and exponent - 1 are from the given ones, in standard deviations."""
    own = fitted.places(place)
    names = [fitted.parameters[i].name if fitted.parameters[i].shape else "offset_arcsec" for i in own]

    sign = -1.0 if given.parameters()["offset_arcsec"] < 0.0 else 1.0

    def sizes(effect: Effect) -> FloatArray:
        values = effect.parameters()
        values["offset_arcsec"] *= sign
        return np.array([float(values[name]) - (1.0 if name == "exponent" else 0.0) for name in names])

    here = sizes(now)
    if np.any(here <= 0.0) or np.any(sizes(given) <= 0.0):
        return math.inf
    moved = np.log(here / sizes(given))
    logarithmic = np.array([fitted.parameters[i].logarithmic for i in own])
    scale = np.where(logarithmic, 1.0, here)
    covariance = spread[np.ix_(own, own)] / np.outer(scale, scale) + CALIBRATED**2 * np.eye(len(own))
    return float(np.sqrt(moved @ np.linalg.solve(covariance, moved)))


def _orders(
    estimator: Estimator, fitted: Fitted, place: int, given: Synchronous, now: Effect, spread: FloatArray
) -> Finding | None:
    assert isinstance(now, Synchronous)
    columns = [i for i in fitted.places(place) if not fitted.parameters[i].shape]
    changed: list[MotorOrder] = []
    which: list[int] = []
    parameters: dict[str, Parameter] = {}
    weight = 0.0
    # Flanks that are a shift apart have a mean that is less than either, by the cosine of the shift.
    shift = next(
        (
            math.radians(each.shift_deg)
            for each in fitted.hypothesis.effects
            if isinstance(each, DirectionPhase)
        ),
        0.0,
    )
    for number, (old, new) in enumerate(zip(given.orders, now.orders, strict=True)):
        one, other = _phasor(old), _phasor(new)
        apart = other - one
        if shift and abs(other - one * math.cos(old.order * shift)) < max(ORDER_ARCSEC, 0.5 * abs(apart)):
            continue
        pair = columns[2 * number : 2 * number + 2]
        deviation = math.sqrt(max(float(np.trace(spread[np.ix_(pair, pair)])), 0.0))
        if abs(apart) < max(ORDER_ARCSEC, ORDER_SHARE * abs(one), 5.0 * deviation):
            continue
        phase = math.degrees(math.atan2(apart.imag, apart.real))
        changed.append(
            MotorOrder.model_construct(order=old.order, amplitude_arcsec=abs(apart), phase_deg=phase)
        )
        parameters |= polar(
            f"order_{old.order}_", np.array([apart.real, -apart.imag]), spread[np.ix_(pair, pair)]
        )
        weight += abs(apart) ** 2
        which.append(number)
    if not changed:
        return None
    change = now.fitted(now.coefficients() - given.coefficients())
    seen = 0.5 * float(np.ptp(estimator.does(change, fitted.hypothesis.start)))
    if max(each.amplitude_arcsec for each in changed) > EXTRAPOLATED * seen:
        return None  # on an arc of their turn orders take any size
    low = {each.order for each in changed} <= {1, 2}
    size = sum(each.amplitude_arcsec for each in changed)
    pairs = np.concatenate([columns[2 * number : 2 * number + 2] for number in which])
    difference = now.model_copy(update={"orders": tuple(changed)})
    moved = estimator.columns(difference, fitted.hypothesis.start) @ difference.coefficients()
    cause, aliases = ("motor_encoder_eccentricity", ("motor_order",)) if low else ("motor_order", ())
    return Finding(
        cause, 0.9, aliases, parameters, held_out_change(estimator, fitted, pairs, moved),
        next_experiment(cause, aliases), size,
        robust=float(np.sum(estimator.weight**2) * 0.5 * weight),
        effect=MotorEncoderEccentricity.model_construct(orders=tuple(changed)) if low else None,
        note="a change of orders that the model has: its synchronous part takes it over",
    )  # fmt: skip


def _phasor(order: MotorOrder) -> complex:
    angle = math.radians(order.phase_deg)
    return order.amplitude_arcsec * complex(math.cos(angle), math.sin(angle))
