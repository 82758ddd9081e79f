"""The temperature that a drift of amplitudes is counted from.

Ripple and loop that grow with warmth can be told at any temperature: amplitudes and growth at another one are
others, and the sum is the same. It is told where the amplitudes are those of the model. At any other
temperature the drift would look like a change of the model's own orders, or of its loop, in addition to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge.effects.base import Effect, FloatArray
from hdbridge.effects.carried import Loop
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.hysteresis_memory import HysteresisMemory
from hdbridge.effects.orders import MotorOrder, coefficients_of
from hdbridge.effects.rate_dependence import RateDependence
from hdbridge.effects.synchronous import Synchronous

REACH_K: Final = 30.0
"""A model was measured at a temperature that is at most so far away from those of the record."""


@dataclass(frozen=True, slots=True)
class Told:
    """A model as it is at another temperature."""

    warmer_k: float
    """Above the former reference."""
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
        if isinstance(effect, RateDependence):
            return effect.model_copy(update={"growth_percent": effect.growth_percent * self.per_loop})
        return effect


def nearest(
    carried: Iterable[MotorOrder],
    loop: Loop,
    growth_percent: tuple[float, float],
    now: Sequence[Effect],
    given: Sequence[Effect],
) -> Told | None:
    """The model ``now`` at the temperature at which it is nearest to the one ``given``.

    ``growth_percent`` is that of ripple and loop per kelvin.
    """
    numbers = {order.order for each in now if isinstance(each, Synchronous) for order in each.orders}
    # A fit that has not settled carries other orders than it has: growth is that of what is carried.
    ripple = coefficients_of(each for each in carried if each.order in numbers)
    loops = np.full(len(_offsets(now)), loop.offset_arcsec)
    if len(ripple) != len(_orders(now)):
        return None
    growth = 0.01 * np.concatenate([growth_percent[0] * ripple, growth_percent[1] * loops])
    if not np.any(growth):
        return None
    change = np.concatenate([_orders(given) - _orders(now), _offsets(given) - _offsets(now)])
    warmer_k = float(change @ growth) / float(growth @ growth)
    orders = _orders(now) + warmer_k * growth[: len(ripple)]
    offsets = _offsets(now) + warmer_k * growth[len(ripple) :]
    return Told(warmer_k, orders, offsets, _ratio(ripple, orders), _ratio(loops, offsets))


def _ratio(former: FloatArray, present: FloatArray) -> float:
    return float(np.linalg.norm(former)) / max(float(np.linalg.norm(present)), 1e-9) if len(former) else 1.0


def _orders(base: Sequence[Effect]) -> FloatArray:
    given = [coefficients_of(each.orders) for each in base if isinstance(each, Synchronous)]
    return np.concatenate(given) if given else np.empty(0)


def _offsets(base: Sequence[Effect]) -> FloatArray:
    return np.array([each.offset_arcsec for each in base if isinstance(each, Hysteresis | HysteresisMemory)])
