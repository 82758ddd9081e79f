"""Sums of orders, evaluated as a polynomial in exp(i angle): one complex exponential, then Horner's rule."""

import cmath
import math
from collections.abc import Iterable

from hdbridge.sim.state import state
from hdbridge.sim.truth.hysteresis import TrueOrder


@state
class Orders:
    """``sum of amplitude cos(order angle + phase)`` as a function of an angle."""

    def __init__(self, orders: Iterable[TrueOrder]) -> None:
        terms = {
            each.order: cmath.rect(each.amplitude_arcsec, math.radians(each.phase_deg)) for each in orders
        }
        # Highest order first, for Horner's rule; the last one, order 0, is always zero.
        self._coefficients: tuple[complex, ...] = tuple(
            terms.get(order, 0j) for order in range(max(terms, default=0), 0, -1)
        )
        self._count: int = len(self._coefficients)

    def at(self, angle_rad: float) -> tuple[float, float]:
        """Returns the sum in arcsec, and its derivative with respect to the angle in arcsec per radian."""
        turn = complex(math.cos(angle_rad), math.sin(angle_rad))
        total = slope = 0j  # of the polynomial in exp(i angle)
        for place in range(self._count):
            total += self._coefficients[place]
            slope = slope * turn + total
            total *= turn
        return total.real, -(slope * turn).imag
