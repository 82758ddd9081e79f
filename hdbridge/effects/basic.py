"""The two parts that a calibration gives every model: the ripple over the motor's turn, the elastic loop."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from hdbridge.effects.base import Effect
from hdbridge.effects.hysteresis import Hysteresis
from hdbridge.effects.orders import orders_from
from hdbridge.effects.synchronous import Synchronous

BASIC: Final = frozenset({Synchronous.name, Hysteresis.name})
"""Their names."""
USUAL_LOOP: Final[Effect] = Hysteresis(offset_arcsec=40.0, width_deg=20.0, exponent=1.8)
"""A loop to start a fit from."""


def ripple(numbers: Iterable[int]) -> Effect:
    """The ripple of these orders of the motor, all of amplitude zero, to start a fit from."""
    return Synchronous(orders=orders_from(numbers, 0.0))


def is_ripple(effect: Effect) -> bool:
    """Whether an effect is a model's ripple, and not orders in addition to it."""
    return isinstance(effect, Synchronous)
