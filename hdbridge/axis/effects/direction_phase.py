"""Shift of the synchronous part with the direction of motion, because the tooth flanks that carry differ."""

import math
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Modulating, has_orders, orders_of
from hdbridge.axis.effects.described import Cause, Compensable, Memoryless, Observations, Part, Tracker
from hdbridge.axis.effects.kinematics import direction_of
from hdbridge.axis.effects.motion import Channel, FloatArray, Motion, Start
from hdbridge.axis.effects.orders import RAD_PER_DEG, Orders, OrderTracker, phasors, ripple

STEEPEST = 3.0
"""Limit of tan(k shift), reached at k shift = 72 deg. From there up to 108 deg, the mean over both directions
is less than a third of the order.
"""


class DirectionPhase(Modulating):
    """Direction-odd part of a tooth error T(theta_M + d shift) in direction d.

    The model's synchronous part was fitted to the mean over both directions. An order A_k of the tooth error
    contributes A_k cos(k shift) to this mean, and A_k sin(k shift) to the odd part. The odd part is therefore
    tan(k shift) times the mean's order, and leads it by a quarter period. The tangent is limited to
    `STEEPEST`, beyond which hardly anything of an order remains in the mean. One angle shifts all orders,
    because a separate amplitude for each order would mean many parameters for one cause.
    """

    name = "direction_phase"
    channels = frozenset({Channel.DIRECTION})
    about = Cause(
        title="synchronous part shifted with the direction",
        equation="d times the sum over k of -A_k tan(k shift) sin(k theta_M + phi_k), A_k and phi_k the "
        "synchronous part's, d the direction held at rest",
        signature="the ripple is displaced between the two directions by one motor angle for all orders",
        consequence="the compensation leaves a ripple with opposite signs in the two directions",
        remedy="compensate it; it grows with preload and load",
        experiment="slow sweeps over the same motor turns both ways",
        aliases=("hysteresis_parameters",),
        source="phase of the kinematic error differs between the tooth flanks that carry",
        size="1-5 arcsec",
    )
    compensable = Compensable(True, "the load really has this error; the direction is commanded")
    carries = {Part.ORDERS: "orders"}
    curved = True
    linear = ("shift_deg",)
    typical = {"shift_deg": 1.0}

    orders: Orders
    shift_deg: float = Field(
        ge=-45, le=45, description="shift of the motor angle, forward ahead of backward by twice this"
    )

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields the effect with zero shift, as the initial value of a fit."""
        if has_orders(base):
            yield cls(orders=orders_of(base), shift_deg=0.0)

    def symmetric_fraction(self, order: int) -> float:
        """Returns cos(k shift), by which the shift reduces an order in the mean over both directions."""
        return math.cos(order * math.radians(self.shift_deg))

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        orders = OrderTracker(tuple(self.shift_deg * each for each in self._odd()))
        before = start.value
        return Memoryless(lambda motor_deg, now: (now.direction or before) * orders.peek(motor_deg, now))

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error per degree of shift *at the current shift*, shape (n, 1).

        The error is not exactly proportional to the shift, so the fit must be iterated.
        """
        error: FloatArray = direction_of(motion, start) * ripple(motion.motor_deg, self._odd())
        return error[:, np.newaxis]

    def bound_arcsec(self) -> float:
        return abs(self.shift_deg) * sum(map(abs, self._odd()))

    def slope_bound_arcsec_per_deg(self) -> float:
        steepness = sum(k * abs(each) for k, each in enumerate(reversed(self._odd())))
        return RAD_PER_DEG * abs(self.shift_deg) * steepness

    def _odd(self) -> tuple[complex, ...]:
        """Returns the phasors of the odd part per degree: j A_k exp(j phi_k) tan(k shift) / shift."""
        given = phasors(self.orders)
        highest = len(given) - 1
        return tuple(1j * each * self._tangent(highest - i) for i, each in enumerate(given))

    def _tangent(self, order: int) -> float:
        if abs(self.shift_deg) < 1e-9:
            return order * RAD_PER_DEG
        tangent = math.tan(order * RAD_PER_DEG * self.shift_deg)
        return min(max(tangent, -STEEPEST), STEEPEST) / self.shift_deg
