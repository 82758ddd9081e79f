"""Findings within the model's own parts: the elastic law, its parameters, the orders of the motor, a spring.

Calibrations are a few per cent off as a rule, and that is no finding: the change has to be larger than that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hdbridge.diagnose.experiment import next_experiment
from hdbridge.diagnose.holdout import held_out, held_out_change
from hdbridge.diagnose.parameters import parameters_of, polar
from hdbridge.diagnose.result import UNWEIGHED, Finding, Parameter
from hdbridge.diagnose.search import Search, Trail
from hdbridge.effects import CATALOGUE, Effect, FloatArray, Part, Start
from hdbridge.estimation.calibration import CalibratedPart, calibrated, variances
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.model import TransmissionModel


def findings(
    search: Search, model: TransmissionModel, trail: Trail, precise: Fitted, spread: FloatArray
) -> list[Finding]:
    """What has changed within the baseline, as the fit for parameters has it, with their covariance."""
    estimator = search.estimator
    usual = _usual(estimator, model)
    result: list[Finding] = []
    for place, (given, now) in enumerate(zip(model.effects, precise.hypothesis.effects, strict=False)):
        if given.part is Part.LOOP:
            if estimator.data.reversals < 2:
                continue  # a loop shows only where the axis reverses
            found = _law(estimator, trail, precise, usual[place], given, now, spread)
        elif given.part is Part.ORDERS:
            found = _orders(estimator, precise, usual[place], given, now, spread) if usual[place] else None
        else:
            found = _freed(search, trail.fitted, precise, place, given, spread)
        if found is not None:
            result.append(found)
    return result


def _law(
    estimator: Estimator,
    trail: Trail,
    precise: Fitted,
    usual: Sequence[CalibratedPart],
    given: Effect,
    now: Effect,
    spread: FloatArray,
) -> Finding | None:
    fitted, place = trail.fitted, usual[0].place
    start = fitted.hypothesis.start

    def values(effect: Effect) -> FloatArray:
        return estimator.columns(effect, start) @ effect.coefficients()

    if type(given) is not type(now):
        causes = causes_of(given, now)
        if trail.law_gain < estimator.scales.enter + estimator.scales.penalty or not causes:
            return None
        old = estimator.fit(fitted.hypothesis.instead(place, type(given)(**now.parameters())))
        apart = (old.residual - fitted.residual) / estimator.weight
        peak = float(np.quantile(np.abs(apart), 0.998))
        if peak < estimator.scales.plain_arcsec:
            return None
        gain = held_out(estimator, fitted, old)
        name = causes[0].name
        return Finding(
            name, UNWEIGHED, (), parameters_of(estimator, precise, place, spread),
            gain, next_experiment(name, ()),
            peak, robust=trail.law_gain, effect=causes[0],
        )  # fmt: skip
    before, after = values(given), values(now)
    peak = 0.5 * float(np.ptp(after - before))
    lawless = _lawless_arcsec(estimator, fitted)
    if not lawless and (
        peak < estimator.scales.floor_arcsec
        or strain(precise, usual[0], spread) < estimator.scales.calibrations**2
    ):
        return None
    causes = causes_of(given, now)
    if not causes:
        return None
    effect = causes[0]
    # A loop that obeys no law may follow another one in part.
    laws = [kind.name for kind in CATALOGUE.values() if kind.part is Part.LOOP and kind.changes is Part.LOOP]
    aliases = tuple(laws) if lawless else ()
    residual = fitted.residual / estimator.weight
    apart = after - before - float(np.mean(after - before))
    taken = math.sqrt(max(float(np.mean((residual + apart) ** 2 - residual**2)), 0.0))
    moved = values(fitted.hypothesis.effects[place]) - before
    return Finding(
        effect.name, UNWEIGHED, aliases, parameters_of(estimator, precise, place, spread),
        held_out_change(estimator, fitted, fitted.places(place), moved),
        next_experiment(effect.name, aliases), max(peak, lawless), taken_arcsec=taken,
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
    gained = (
        plain.chi_square - fitted.chi_square
        > estimator.scales.enter + estimator.scales.penalty * searched.shape[1]
    )
    return apart if gained and apart > estimator.scales.plain_arcsec else 0.0


def _usual(estimator: Estimator, model: TransmissionModel) -> dict[int, list[CalibratedPart]]:
    """The parts of each effect of a model as any calibration knows them, whatever their intervals were: some
    kelvin and weeks later they are that far off.
    """
    parts = calibrated(
        model.effects, {}, lambda effect: estimator.columns(effect, Start.VIRGIN), estimator.scales
    )
    return {place: [each for each in parts if each.place == place] for place in range(len(model.effects))}


def strain(fitted: Fitted, part: CalibratedPart, spread: FloatArray) -> float:
    """Chi square by which a part of a fit is away from its calibration, both with their errors."""
    own = {fitted.parameters[i].name: i for i in fitted.places(part.place)}
    seen = replace(part, parameters={name: each for name, each in part.parameters.items() if name in own})
    at = [own[name] for name in seen.parameters]
    return seen.strain(fitted.hypothesis.effects, spread[np.ix_(at, at)])


def causes_of(given: Effect, now: Effect) -> list[Effect]:
    """The causes that can have made one of the other, those that say more of it first."""
    found = [each for kind in CATALOGUE.values() if (each := kind.of_change(given, now)) is not None]
    return sorted(found, key=lambda each: each.changes is None)


def _orders(
    estimator: Estimator,
    fitted: Fitted,
    usual: Sequence[CalibratedPart],
    given: Effect,
    now: Effect,
    spread: FloatArray,
) -> Finding | None:
    place = usual[0].place
    columns = [i for i in fitted.places(place) if not fitted.parameters[i].shape]
    changed: list[tuple[Effect, Effect]] = []
    kept: list[int] = []
    calibration: list[FloatArray] = []
    for old, new, named in zip(given.pieces(), now.pieces(), now.named_coefficients(), strict=True):
        before, after = old.coefficients(), new.coefficients()
        pair = [columns[each] for each in named.columns]
        # What is odd in the direction takes some of an order away from the mean of both directions.
        share = math.prod(each.left_in_mean(_number(new)) for each in fitted.hypothesis.effects)
        part = next(each for each in usual if str(named.columns[0]) in each.parameters).times(share)
        if (
            float(np.linalg.norm(after - share * before)) < estimator.scales.floor_arcsec
            or strain(fitted, part, spread) < estimator.scales.calibrations**2
        ):
            continue
        changed.append((old, new))
        kept += pair
        calibration.append(variances(estimator.calibrated, place, named.columns))
    if not changed:
        return None
    change = now.fitted(now.coefficients() - given.coefficients())
    seen = 0.5 * float(np.ptp(estimator.does(change, fitted.hypothesis.start)))
    was, is_now = (_together(each) for each in zip(*changed, strict=True))
    difference = is_now.fitted(is_now.coefficients() - was.coefficients())
    causes = causes_of(was, is_now)
    if not causes or difference.largest_piece_arcsec() > estimator.scales.extrapolated * seen:
        return None  # on an arc of their turn orders take any size
    values = difference.coefficients()
    parameters: dict[str, Parameter] = {}
    for i, named in enumerate(difference.named_coefficients()):
        pair = kept[2 * i : 2 * i + 2]
        # What it has changed from was itself known to its calibration only.
        apart = spread[np.ix_(pair, pair)] + np.diag(calibration[i])
        parameters |= polar(named.name, values[list(named.columns)], apart)
    moved = estimator.columns(difference, fitted.hypothesis.start) @ values
    cause, aliases = causes[0].name, tuple(each.name for each in causes[1:])
    return Finding(
        cause, UNWEIGHED, aliases, parameters, held_out_change(estimator, fitted, np.array(kept), moved),
        next_experiment(cause, aliases), difference.bound_arcsec(),
        robust=float(np.sum(estimator.weight**2) * 0.5 * float(values @ values)),
        effect=causes[0],
        note="a change of orders that the model has: its synchronous part takes it over",
    )  # fmt: skip


def _freed(
    search: Search, fitted: Fitted, precise: Fitted, place: int, given: Effect, spread: FloatArray
) -> Finding | None:
    """Any other part that the data have pulled out of its calibration (`hdbridge.estimation.calibration`)."""
    estimator, own, now = search.estimator, precise.places(place), precise.hypothesis.effects[place]
    if not len(own) or np.all(precise.information[own] != 0.0):
        return None
    start = precise.hypothesis.start
    change = estimator.columns(now, start) @ now.coefficients()
    change -= estimator.columns(given, start) @ given.coefficients()
    peak = 0.5 * float(np.ptp(change))
    if peak < estimator.scales.floor_arcsec:
        return None
    aliases = tuple(search.instead_of_change(fitted, place, given))
    return Finding(
        now.name, UNWEIGHED, aliases, parameters_of(estimator, precise, place, spread),
        held_out_change(estimator, precise, own, change), next_experiment(now.name, aliases), peak,
        robust=float(np.sum((estimator.weight * (change - np.mean(change))) ** 2)), effect=now,
        left_alone=bool(aliases), note="a change of what the model has: " + (
            "it is left as it was, for the record does not distinguish it from another cause"
            if aliases else "its own parameters take it over"
        ),
    )  # fmt: skip


def _together(pieces: Sequence[Effect]) -> Effect:
    """One effect of several pieces of it."""
    whole = pieces[0]
    for each in pieces[1:]:
        both = whole.joined(each)
        assert both is not None, "pieces of one effect join"
        whole = both
    return whole


def _number(piece: Effect) -> int:
    """The order of a piece that is one."""
    waves = piece.waves()
    return round(waves[0][0]) if waves else 0
