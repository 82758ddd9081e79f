"""The extended model: the refitted baseline and what was found, with uncertainty and provenance."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any

import numpy as np

from hdbridge.diagnose.parameters import half_widths, parameters_of
from hdbridge.diagnose.search import EXTRAPOLATED
from hdbridge.effects import Effect, FloatArray, Synchronous, conflicts, extended
from hdbridge.effects.backlash import Backlash
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import OrderSeries
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.model import TransmissionModel


def as_named(estimator: Estimator, fitted: Fitted, given: Sequence[Effect], named: Container[str]) -> Fitted:
    """The fit with the ``given`` law of the loop, where return-point memory does better but was not named."""
    for place, (old, new) in enumerate(zip(given, fitted.hypothesis.effects, strict=False)):
        unnamed = isinstance(new, HysteresisMemory) and "hysteresis_memory" not in named
        if isinstance(old, Hysteresis) and unnamed:
            return estimator.fit(fitted.hypothesis.instead(place, Hysteresis(**new.parameters())))
    return fitted


def supported(estimator: Estimator, fitted: Fitted, given: Sequence[Effect]) -> tuple[Effect, ...]:
    """The hypothesis's effects, but those of the baseline as ``given`` where the record cannot tell them.

    A loop without a reversal, and orders on a short arc of their turn, take any value that suits this record.
    """
    start = fitted.hypothesis.start
    one_way = estimator.data.reversals < 2
    result = list(fitted.hypothesis.effects)
    for place, (old, new) in enumerate(zip(given, fitted.hypothesis.effects, strict=False)):
        if isinstance(new, Hysteresis | HysteresisMemory) and one_way:
            result[place] = old
        elif isinstance(old, Synchronous) and isinstance(new, Synchronous) and old.orders:
            change = new.coefficients() - old.coefficients()
            seen = 0.5 * float(np.ptp(estimator.does(new.fitted(change), start)))
            largest = float(np.max(np.hypot(change[::2], change[1::2])))
            if largest > EXTRAPOLATED * seen:
                result[place] = old
    return tuple(result)


def extended_model(
    estimator: Estimator,
    model: TransmissionModel,
    fitted: Fitted,
    places: Sequence[int],
    spread: FloatArray,
    reason: str,
    base: int,
) -> TransmissionModel:
    """``model`` with the fitted baseline (`supported`) and the findings at ``places`` of the hypothesis.

    What else the hypothesis holds was fitted in addition to them and is not written: it was not named.
    """
    ratio = model.ratio
    effects: tuple[Effect, ...] = tuple(_tidy(each, ratio) for each in fitted.hypothesis.effects[:base])
    uncertainty: dict[str, dict[str, Any]] = {}
    chosen = [*range(base), *places]
    for place in places:
        effect = _tidy(fitted.hypothesis.effects[place], ratio)
        if effect.violations():
            continue
        effects = extended(effects, effect)
    if conflicts(effects, model.ratio):
        effects = tuple(_tidy(each, ratio) for each in fitted.hypothesis.effects[:base])
    kept = {each.name for each in effects}
    for place in chosen:
        effect = fitted.hypothesis.effects[place]
        if effect.name in kept:
            uncertainty[effect.name] = half_widths(
                _tidy(effect, ratio), parameters_of(estimator, fitted, place, spread)
            )
    provenance = {**model.provenance, "reason": reason}
    return TransmissionModel(model.ratio, effects, uncertainty, provenance)


def _tidy(effect: Effect, ratio: float) -> Effect:
    """Without orders of no amplitude, whose phases mean nothing; play as wide as an inverse needs."""
    if isinstance(effect, OrderSeries):
        orders = tuple(each for each in effect.orders if each.amplitude_arcsec > 1e-6)
        return effect.model_copy(update={"orders": orders})
    if isinstance(effect, Backlash):
        # The load rests while the motor crosses; noise lets the fit make that angle smaller than it can be.
        gentlest = Backlash.of_gap(effect.gap_arcsec, ratio)
        return gentlest if gentlest.crossing_deg > effect.crossing_deg else effect
    return effect
