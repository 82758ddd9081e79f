"""Reference temperature of an amplitude drift.

Ripple and loop that grow with warmth can be expressed at any temperature: amplitudes and growth differ, and
the sum is the same. The reference is chosen so that the amplitudes are those of the model. At any other
temperature the drift would come with an apparent change of the model's own orders or loop.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Loop
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.hysteresis_memory import HysteresisMemory
from hdbridge.axis.effects.motion import FloatArray
from hdbridge.axis.effects.orders import MotorOrder, coefficients_of
from hdbridge.axis.effects.rate_dependence import RateDependence
from hdbridge.axis.effects.synchronous import Synchronous

REACH_K: Final = 30.0
"""Maximum difference between the temperature of the model's calibration and those of the record; K."""


@dataclass(frozen=True, slots=True)
class Told:
    """A model re-expressed at another reference temperature."""

    warmer_k: float
    """Temperature above the former reference, K."""
    orders: FloatArray
    """Cosines and sines, arcsec."""
    offsets: FloatArray
    """Offsets of its loops, arcsec."""
    per_ripple: float
    per_loop: float
    """Factors that convert a share of the former ripple or loop into a share of the present one."""

    def counted(self, effect: Effect) -> Effect:
        """Re-expresses an effect of the model, or one that is given as a share of it."""
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
    """Returns ``now`` re-expressed at the temperature at which it is nearest to ``given``; None if
    impossible.

    ``growth_percent`` is the growth of ripple and of loop per kelvin.
    """
    numbers = {order.order for each in now if isinstance(each, Synchronous) for order in each.orders}
    # A fit that has not settled may carry other orders than the model has: growth refers to the carried ones.
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
