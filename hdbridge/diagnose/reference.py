"""The temperature that a drift of amplitudes is counted from.

Ripple and loop that grow with warmth can be told at any temperature: amplitudes and growth at another one are
others, and the sum is the same. It is told where the amplitudes are those of the model. At any other
temperature the drift would look like a change of the model's own orders, or of its loop, in addition to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hdbridge.effects import AmplitudeDrift, Channel, FloatArray, RateDependence, Synchronous
from hdbridge.effects.base import Effect
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import coefficients_of
from hdbridge.estimation.hypothesis import Estimator, Fitted

REACH_K = 30.0
"""A model was measured at a temperature that is at most so far away from those of the record."""
SAME = 10.0
"""Chi square that another temperature may cost: what a fit leaves that has not quite converged."""


def as_calibrated(estimator: Estimator, fitted: Fitted, given: tuple[Effect, ...]) -> Fitted:
    """The drift of amplitudes, counted from the temperature at which they are the ``given`` model's.

    As it was, where there is no such temperature near those of the record.
    """
    temperature = estimator.motion.measured.get(Channel.TEMPERATURE)
    if temperature is None:
        return fitted
    coldest, hottest = float(np.min(temperature)) - REACH_K, float(np.max(temperature)) + REACH_K
    for place, effect in enumerate(fitted.hypothesis.effects[len(given) :], len(given)):
        if not isinstance(effect, AmplitudeDrift) or effect.driven_by != "temperature":
            continue
        told = _nearest(effect, fitted.hypothesis.effects[: len(given)], given)
        if told is None or not coldest <= told.reference_c <= hottest:
            continue
        effects = tuple(told.counted(each) for each in fitted.hypothesis.effects)
        trial = estimator.fit(replace(fitted.hypothesis, effects=effects))
        if trial.chi_square < fitted.chi_square + SAME and not trial.hypothesis.effects[place].violations():
            return trial
    return fitted


@dataclass(frozen=True, slots=True)
class _Told:
    """A model as it is at another temperature."""

    reference_c: float
    orders: FloatArray
    """Cosines and sines, arcsec."""
    offsets: FloatArray
    """Of the loops that it has, arcsec."""
    per_ripple: float
    per_loop: float
    """A share of the former ripple, or loop, as a share of this one."""

    def counted(self, effect: Effect) -> Effect:
        """An effect of the model, or one that is told as a share of it."""
        if isinstance(effect, Synchronous):
            return effect.fitted(self.orders)
        if isinstance(effect, Hysteresis | HysteresisMemory):
            return effect.model_copy(update={"offset_arcsec": float(self.offsets[0])})
        if isinstance(effect, AmplitudeDrift):
            growth = {
                "ripple_percent_per_k": effect.ripple_percent_per_k * self.per_ripple,
                "friction_percent_per_k": effect.friction_percent_per_k * self.per_loop,
            }
            return effect.model_copy(update=growth | {"reference_c": self.reference_c})
        if isinstance(effect, RateDependence):
            return effect.model_copy(update={"growth_percent": effect.growth_percent * self.per_loop})
        return effect


def _nearest(drift: AmplitudeDrift, now: tuple[Effect, ...], given: tuple[Effect, ...]) -> _Told | None:
    """The model ``now`` at the temperature at which it is nearest to the one ``given``."""
    numbers = {order.order for each in now if isinstance(each, Synchronous) for order in each.orders}
    # A fit that has not settled carries other orders than it has: growth is that of what is carried.
    ripple = coefficients_of(each for each in drift.orders if each.order in numbers)
    loop = np.full(len(_offsets(now)), drift.loop.offset_arcsec)
    if len(ripple) != len(_orders(now)):
        return None
    growth = 0.01 * np.concatenate(
        [drift.ripple_percent_per_k * ripple, drift.friction_percent_per_k * loop],
    )
    if not np.any(growth):
        return None
    change = np.concatenate([_orders(given) - _orders(now), _offsets(given) - _offsets(now)])
    warmer_k = float(change @ growth) / float(growth @ growth)
    orders = _orders(now) + warmer_k * growth[: len(ripple)]
    offsets = _offsets(now) + warmer_k * growth[len(ripple) :]
    return _Told(
        round(drift.reference_c + warmer_k, 1), orders, offsets, _ratio(ripple, orders), _ratio(loop, offsets)
    )


def _ratio(former: FloatArray, present: FloatArray) -> float:
    return float(np.linalg.norm(former)) / max(float(np.linalg.norm(present)), 1e-9) if len(former) else 1.0


def _orders(base: tuple[Effect, ...]) -> FloatArray:
    given = [coefficients_of(each.orders) for each in base if isinstance(each, Synchronous)]
    return np.concatenate(given) if given else np.empty(0)


def _offsets(base: tuple[Effect, ...]) -> FloatArray:
    return np.array([each.offset_arcsec for each in base if isinstance(each, Hysteresis | HysteresisMemory)])
