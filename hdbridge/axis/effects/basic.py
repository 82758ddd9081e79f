"""The two basic parts of every calibrated model: motor-synchronous ripple and elastic loop."""

from collections.abc import Iterable
from typing import Final

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.orders import orders_from
from hdbridge.axis.effects.synchronous import Synchronous

BASIC: Final = frozenset({Synchronous.name, Hysteresis.name})
"""Names of the two basic parts."""
USUAL_LOOP: Final[Effect] = Hysteresis(offset_arcsec=40.0, width_deg=20.0, exponent=1.8)
"""Initial loop for a fit."""


def ripple(numbers: Iterable[int]) -> Effect:
    """Returns a ripple with these motor orders at zero amplitude, as the start of a fit."""
    return Synchronous(orders=orders_from(numbers, 0.0))


def is_ripple(effect: Effect) -> bool:
    """Returns True if an effect is the model's ripple rather than additional orders."""
    return isinstance(effect, Synchronous)
