"""Finds changes of the model's own parts: hysteresis law and parameters, motor orders, springs.

Calibrations are usually off by a few per cent. A finding must exceed this deviation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hdbridge.analysis.acceptance import gate_of_change
from hdbridge.analysis.calibrated import CalibratedPart, calibrated, variances
from hdbridge.analysis.findings import UNWEIGHED, Finding, Parameter, next_experiment
from hdbridge.analysis.gain import held_out
from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import Column
from hdbridge.analysis.parameters import named_parameters, parameters_of
from hdbridge.analysis.search import Search, together
from hdbridge.axis.effects import CATALOGUE, Effect, FloatArray, Part, Start
from hdbridge.axis.model import TransmissionModel


def findings(
    search: Search,
    model: TransmissionModel,
    fitted: Fitted,
    plain: Fitted,
    precise: Fitted,
    spread: FloatArray,
) -> list[Finding]:
    """Returns the changed parts of the baseline as findings.

    ``plain`` is the fit without a free-form loop, ``precise`` the fit that determines the parameters, and
    ``spread`` the covariance of ``precise``.
    """
    estimator = search.estimator
    # The file's intervals are ignored, because temperature and time shift every calibration by a few per
    # cent.
    parts = calibrated(
        model.effects, {}, lambda effect: estimator.columns(effect, Start.VIRGIN), estimator.scales
    )
    result: list[Finding | None] = []
    for place, given in enumerate(model.effects):
        usual = [each for each in parts if each.place == place]
        change: _Change | None = None
        if given.part is Part.LOOP:
            if estimator.data.reversals >= 2:  # a loop is visible only near reversals
                same = type(given) is type(precise.hypothesis.effects[place])
                change = (
                    _loop(search, fitted, plain, precise, usual[0], given, spread)
                    if same
                    else _another_law(search, fitted, precise, place, given, spread)
                )
        elif given.part is Part.ORDERS:
            change = _orders(search, fitted, precise, usual, given, spread) if usual else None
        else:
            change = _freed(search, fitted, precise, place, given, spread)
        if change is not None:
            result.append(_finding(search, plain, fitted, place, given, change))
    return [each for each in result if each is not None]


class _Change(NamedTuple):
    effect: Effect
    peak_arcsec: float
    parameters: Mapping[str, Parameter]
    note: str
    aliases: tuple[str, ...] = ()
    left_alone: bool = False


def _finding(
    search: Search, fitted: Fitted, loose: Fitted, place: int, given: Effect, change: _Change
) -> Finding | None:
    """Assesses a change like any other cause, by its block-robust evidence and its gain on held-out data.

    Both compare the fit with one that keeps the ``given`` part. The evidence is computed from ``loose``, a
    fit that may contain a free-form loop, unlike a model. Returns None if the evidence is insufficient.
    """
    estimator, name = search.estimator, change.effect.name

    def as_given(fit: Fitted) -> Fitted:
        now = fit.hypothesis.effects[place]
        if type(now) is type(given):
            return search.with_given(fit, place, given)
        return estimator.fit(fit.hypothesis.instead(place, type(given)(**change.effect.parameters())))

    as_it_was = as_given(loose)
    gate = gate_of_change(estimator, loose, as_it_was)
    if gate.reason:
        search.refusals[name] = gate.reason
        return None
    without = as_given(fitted)
    return Finding(
        name, UNWEIGHED, change.aliases, change.parameters, held_out(estimator, without, fitted),
        next_experiment(name, change.aliases), change.peak_arcsec,
        robust=as_it_was.chi_square - loose.chi_square, left_alone=change.left_alone,
        within=True, note=change.note, effect=change.effect, gate=gate,
    )  # fmt: skip


def _another_law(
    search: Search, fitted: Fitted, precise: Fitted, place: int, given: Effect, spread: FloatArray
) -> _Change | None:
    """Returns a change if a different hysteresis law fits better than the ``given`` one."""
    estimator, now = search.estimator, precise.hypothesis.effects[place]
    scales = estimator.scales
    causes = causes_of(given, now)
    old = estimator.fit(fitted.hypothesis.instead(place, type(given)(**now.parameters())))
    peak = _apart_arcsec(estimator, old, fitted)
    gain = old.chi_square - fitted.chi_square
    if gain < scales.enter + scales.penalty or peak < scales.plain_arcsec or not causes:
        return None
    return _Change(causes[0], peak, parameters_of(estimator, precise, place, spread), "")


def _loop(
    search: Search,
    fitted: Fitted,
    plain: Fitted,
    precise: Fitted,
    usual: CalibratedPart,
    given: Effect,
    spread: FloatArray,
) -> _Change | None:
    """Returns a change if the loop's parameters have changed or its shape fits neither hysteresis law."""
    estimator, place = search.estimator, usual.place
    scales = estimator.scales
    change = _change(estimator, precise, place, given)
    peak = 0.5 * float(np.ptp(change))
    lawless = _lawless_arcsec(estimator, fitted, plain)
    small = peak < estimator.floor_arcsec or strain(precise, usual, spread) < scales.calibrations**2
    causes = causes_of(given, precise.hypothesis.effects[place])
    if (small and not lawless) or not causes:
        return None
    # A loop that follows neither law exactly may partly follow the alternative law.
    laws = [kind.name for kind in CATALOGUE.values() if kind.part is Part.LOOP and kind.changes is Part.LOOP]
    others = search.alternatives_to_change(fitted, place, given)
    return _Change(
        causes[0],
        max(peak, lawless),
        parameters_of(estimator, precise, place, spread),
        "the model's own loop receives the new parameters",
        tuple(dict.fromkeys((*others, *(laws if lawless else ())))),
    )


def _apart_arcsec(estimator: Estimator, one: Fitted, other: Fitted) -> float:
    """Returns the largest difference between two fits, arcsec, excluding rare extremes."""
    apart = np.abs(one.residual - other.residual) / estimator.weight
    return float(np.quantile(apart, 1.0 - estimator.rare))


def _lawless_arcsec(estimator: Estimator, fitted: Fitted, plain: Fitted) -> float:
    """Returns the peak contribution of a free-form loop beyond the hysteresis law, arcsec.

    The result is 0 if the law alone fits as well.
    """
    scales, free = estimator.scales, fitted.hypothesis.nuisances
    if free is None:
        return 0.0
    apart = _apart_arcsec(estimator, plain, fitted)
    gained = plain.chi_square - fitted.chi_square > scales.enter + scales.penalty * len(free.names)
    return apart if gained and apart > scales.plain_arcsec else 0.0


def _orders(
    search: Search,
    fitted: Fitted,
    precise: Fitted,
    usual: Sequence[CalibratedPart],
    given: Effect,
    spread: FloatArray,
) -> _Change | None:
    """Returns a change that combines all changed motor orders; None if no order has changed."""
    estimator, place = search.estimator, usual[0].place
    scales, now = estimator.scales, precise.hypothesis.effects[place]
    columns = precise.places(place)
    changed: list[tuple[Effect, Effect]] = []
    own: list[int] = []
    known: list[FloatArray] = []
    for old, new, named in zip(given.pieces(), now.pieces(), now.named_coefficients(), strict=True):
        before, after = old.coefficients(), new.coefficients()
        # Effects that change sign with the direction of motion reduce an order's mean over both directions.
        number = round(new.waves()[0][0]) if new.waves() else 0
        share = math.prod(each.symmetric_fraction(number) for each in precise.hypothesis.effects)
        part = next(each for each in usual if str(named.columns[0]) in each.parameters).times(share)
        large = float(np.linalg.norm(after - share * before)) >= estimator.floor_arcsec
        if large and strain(precise, part, spread) >= scales.calibrations**2:
            changed.append((old, new))
            own += [columns[each] for each in named.columns]
            known.append(variances(estimator.calibrated, place, named.columns))
    if not changed:
        return None
    all_of_it = now.fitted(now.coefficients() - given.coefficients())
    seen = 0.5 * float(np.ptp(estimator.contribution(all_of_it, precise.hypothesis.start)))
    was, is_now = (together(each) for each in zip(*changed, strict=True))
    difference = is_now.fitted(is_now.coefficients() - was.coefficients())
    causes = causes_of(was, is_now)
    if not causes or difference.largest_piece_arcsec() > scales.extrapolated * seen:
        return None  # a record over part of a motor turn does not limit the amplitudes of orders
    # The uncertainty of the old value is that of its calibration.
    apart = spread[np.ix_(own, own)] + np.diag(np.concatenate(known))
    others = search.alternatives_to_change(fitted, place, given)
    return _Change(
        causes[0],
        difference.bound_arcsec(),
        named_parameters(difference, [Column(0, str(i)) for i in range(len(own))], apart),
        "orders of the model have changed, or were wrong: its synchronous part absorbs the change",
        tuple(dict.fromkeys((*(each.name for each in causes[1:]), *others))),
    )


def _freed(
    search: Search, fitted: Fitted, precise: Fitted, place: int, given: Effect, spread: FloatArray
) -> _Change | None:
    """Returns a change of any other part if the fit has freed it from its calibration (`calibrated`)."""
    estimator, own = search.estimator, precise.places(place)
    if not len(own) or np.all(precise.information[own] != 0.0):
        return None
    change = _change(estimator, precise, place, given)
    peak = 0.5 * float(np.ptp(change))
    if peak < estimator.floor_arcsec:
        return None
    aliases = tuple(search.alternatives_to_change(fitted, place, given))
    return _Change(
        precise.hypothesis.effects[place],
        peak,
        parameters_of(estimator, precise, place, spread),
        "a change of a part of the model: "
        + (
            "it is unchanged, because the record does not separate it from another cause"
            if aliases
            else "its own parameters absorb the change"
        ),
        aliases,
        left_alone=bool(aliases),
    )


def _change(estimator: Estimator, fitted: Fitted, place: int, given: Effect) -> FloatArray:
    """Returns the contribution of the fitted part minus that of the ``given`` part, arcsec, shape (m,)."""
    start, now = fitted.hypothesis.start, fitted.hypothesis.effects[place]
    after = estimator.columns(now, start) @ now.coefficients()
    return np.asarray(after - estimator.columns(given, start) @ given.coefficients())


def strain(fitted: Fitted, part: CalibratedPart, spread: FloatArray) -> float:
    """Returns the chi square of a part's deviation from its calibration.

    Its variance includes the errors of the fit, from the covariance ``spread``, and of the calibration.
    """
    own = {fitted.parameters[i].name: i for i in fitted.places(part.place)}
    seen = replace(part, parameters={name: each for name, each in part.parameters.items() if name in own})
    at = [own[name] for name in seen.parameters]
    return seen.strain(fitted.hypothesis.effects, spread[np.ix_(at, at)])


def causes_of(given: Effect, now: Effect) -> list[Effect]:
    """Returns the causes that can explain the change from ``given`` to ``now``, most specific first."""
    found = [each for kind in CATALOGUE.values() if (each := kind.of_change(given, now)) is not None]
    return sorted(found, key=lambda each: each.changes is None)
