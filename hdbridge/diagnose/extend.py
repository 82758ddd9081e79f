"""The extended model: the refitted baseline and what was found, with uncertainty and provenance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hdbridge.diagnose.parameters import half_widths, parameters_of
from hdbridge.diagnose.theory import Fitted
from hdbridge.effects import Effect, FloatArray, conflicts, extended
from hdbridge.effects.orders import OrderSeries
from hdbridge.model import TransmissionModel


def extended_model(
    model: TransmissionModel,
    fitted: Fitted,
    places: Sequence[int],
    spread: FloatArray,
    reason: str,
    base: int,
) -> TransmissionModel:
    """``model`` with the fitted baseline and the findings at ``places`` of the theory."""
    effects: tuple[Effect, ...] = tuple(_tidy(each) for each in fitted.theory.effects[:base])
    uncertainty: dict[str, dict[str, Any]] = {}
    chosen = [*range(base), *places]
    for place in places:
        effect = _tidy(fitted.theory.effects[place])
        if effect.violations():
            continue
        effects = extended(effects, effect)
    if conflicts(effects, model.ratio):
        effects = tuple(_tidy(each) for each in fitted.theory.effects[:base])
    kept = {each.name for each in effects}
    for place in chosen:
        effect = fitted.theory.effects[place]
        if effect.name in kept:
            uncertainty[effect.name] = half_widths(_tidy(effect), parameters_of(fitted, place, spread))
    provenance = {**model.provenance, "reason": reason}
    return TransmissionModel(model.ratio, effects, uncertainty, provenance)


def _tidy(effect: Effect) -> Effect:
    """Without orders of no amplitude, whose phases mean nothing."""
    if isinstance(effect, OrderSeries):
        orders = tuple(each for each in effect.orders if each.amplitude_arcsec > 1e-6)
        return effect.model_copy(update={"orders": orders})
    return effect
