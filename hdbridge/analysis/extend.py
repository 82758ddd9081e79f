"""Builds the extended model: refitted baseline and findings, with uncertainty and provenance."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.intervals import intervals_of, nested_half_widths
from hdbridge.axis.effects import Effect, FloatArray, Part, conflicts, extended, in_place
from hdbridge.axis.model import TransmissionModel


def as_named(estimator: Estimator, fitted: Fitted, given: Sequence[Effect], named: Container[str]) -> Fitted:
    """Returns the fit, repeated with the ``given`` hysteresis law if its own law is not in ``named``."""
    for place, (old, new) in enumerate(zip(given, fitted.hypothesis.effects, strict=False)):
        if type(old) is not type(new) and new.changes is not None and new.name not in named:
            return estimator.fit(fitted.hypothesis.instead(place, *in_place(new, [type(old)])))
    return fitted


def supported(
    estimator: Estimator, fitted: Fitted, given: Sequence[Effect], alone: Container[str] = ()
) -> tuple[Effect, ...]:
    """Returns the fitted effects, except that undetermined baseline effects keep their ``given`` parameters.

    A loop without a reversal, and orders over a fraction of a motor turn, fit the record with almost any
    value. Effects in ``alone`` also remain as given, because their change may be due to another cause.
    """
    start = fitted.hypothesis.start
    one_way = estimator.data.reversals < 2
    result = list(fitted.hypothesis.effects)
    for place, (old, new) in enumerate(zip(given, fitted.hypothesis.effects, strict=False)):
        if new.name in alone or (new.part is Part.LOOP and one_way):
            result[place] = old
        elif old.part is Part.ORDERS and len(old.coefficients()):
            change = new.fitted(new.coefficients() - old.coefficients())
            seen = 0.5 * float(np.ptp(estimator.contribution(change, start)))
            if change.largest_piece_arcsec() > estimator.scales.extrapolated * seen:
                result[place] = old
    return tuple(result)


def extended_model(
    model: TransmissionModel,
    fitted: Fitted,
    places: Sequence[int],
    spread: FloatArray,
    reason: str,
    base: int,
) -> TransmissionModel:
    """Returns ``model`` with the fitted baseline (`supported`) and the effects of the findings at ``places``.

    Other effects of the fit are not included.
    """
    ratio = model.ratio
    effects: tuple[Effect, ...] = tuple(each.tidied(ratio) for each in fitted.hypothesis.effects[:base])
    uncertainty: dict[str, dict[str, Any]] = {}
    chosen = [*range(base), *places]
    for place in places:
        effect = fitted.hypothesis.effects[place].tidied(ratio)
        more = extended(effects, effect)
        if not (effect.violations() or conflicts(more, ratio)):
            effects = more
    kept = {each.name for each in effects}
    for place in chosen:
        effect = fitted.hypothesis.effects[place]
        if effect.name in kept:
            own = fitted.places(place)
            intervals = intervals_of(effect, [fitted.parameters[i] for i in own], spread[np.ix_(own, own)])
            seen = [each for each in intervals if each.half_width > 0.0]
            uncertainty[effect.name] = nested_half_widths(effect.tidied(ratio), seen)
    provenance = {**model.provenance, "reason": reason}
    return replace(model, effects=effects, uncertainty=uncertainty, provenance=provenance, path=None)
