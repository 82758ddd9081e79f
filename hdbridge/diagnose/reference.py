"""The temperature that a drift of amplitudes is counted from.

Ripple and loop that grow with warmth can be told at any temperature: amplitudes and growth at another one are
others, and the sum is the same. It is told where the amplitudes are those of the model. At any other
temperature the drift would look like a change of the model's own orders, or of its loop, beside it.
"""

from __future__ import annotations

import numpy as np

from hdbridge.diagnose.theory import Fitted, Workshop
from hdbridge.effects import AmplitudeDrift, FloatArray, Synchronous
from hdbridge.effects.base import Effect
from hdbridge.effects.orders import coefficients_of

REACH_K = 30.0
"""A model was measured at a temperature that is at most so far away from those of the record."""
SAME = 1.0
"""Chi square that another temperature may cost: what is lost in linearisation, and no more."""


def as_calibrated(workshop: Workshop, fitted: Fitted, given: tuple[Effect, ...]) -> Fitted:
    """With the drift of amplitudes told from the temperature at which they are those of the ``given`` model.

    As it was, where there is no such temperature near those of the record.
    """
    temperature = workshop.motion.temperature_c
    if temperature is None:
        return fitted
    for place, effect in enumerate(fitted.theory.effects[len(given) :], len(given)):
        if not isinstance(effect, AmplitudeDrift) or effect.driven_by != "temperature":
            continue
        growth = 0.01 * np.concatenate(
            [
                effect.ripple_percent_per_k * coefficients_of(effect.orders),
                [effect.friction_percent_per_k * effect.loop.offset_arcsec],
            ]
        )
        change = _amplitudes(given) - _amplitudes(fitted.theory.effects[: len(given)])
        if len(change) != len(growth) or not np.any(growth):
            continue
        reference_c = effect.reference_c + float(change @ growth) / float(growth @ growth)
        near = np.min(temperature) - REACH_K <= reference_c <= np.max(temperature) + REACH_K
        if not near:
            continue
        told = effect.model_copy(update={"reference_c": round(reference_c, 1)})
        trial = workshop.fit(fitted.theory.instead(place, told))
        if trial.chi_square < fitted.chi_square + SAME and not trial.theory.effects[place].violations():
            return trial
    return fitted


def _amplitudes(base: tuple[Effect, ...]) -> FloatArray:
    """Orders, real and imaginary, and the offset of the loop, arcsec."""
    orders = [coefficients_of(each.orders) for each in base if isinstance(each, Synchronous)]
    offsets = [[each.offset_arcsec] for each in base if hasattr(each, "offset_arcsec")]
    return np.concatenate([*orders, *offsets]) if orders or offsets else np.empty(0)
