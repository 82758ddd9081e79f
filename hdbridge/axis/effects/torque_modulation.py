"""Growth of the synchronous part with load torque, because the tooth mesh deflects."""

from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Modulating, has_orders, orders_of
from hdbridge.axis.effects.coordinate import Coordinate, Spacing
from hdbridge.axis.effects.described import (
    Cause,
    Compensable,
    Experiment,
    Memoryless,
    Observations,
    Part,
    Tracker,
)
from hdbridge.axis.effects.motion import Channel, FloatArray, Motion, Start
from hdbridge.axis.effects.motor_order import MotorOrders
from hdbridge.axis.effects.orders import RAD_PER_DEG, Orders, OrderTracker, phasors, ripple
from hdbridge.axis.effects.torque import TorqueGrowth, top


class TorqueModulation(TorqueGrowth, Modulating):
    """growth |T| S(theta_M): all orders that the effect contains grow by the same percentage."""

    name = "torque_modulation"
    channels = frozenset({Channel.LOAD_TORQUE})
    about = Cause(
        title="ripple that grows with load",
        subject="effects of torque",
        equation="growth tau S(theta_M), S the carried orders, tau = |T| (or T if signed), limited to "
        "T_limit",
        signature="the amplitude of the ripple within a motor turn follows the load torque",
        consequence="the synchronous compensation is too small under load",
        remedy="measure the torque and compensate it; calibrate under the working load; a larger gear",
        experiment="the same motor turns under two torques at one temperature",
        aliases=("amplitude_drift", "motor_order"),
        source="kinematic error of strain wave gears under load: amplitude roughly linear in the torque",
        size="10-50 % of the ripple at rated torque",
        apart={
            "amplitude_drift": Experiment(10, "the same motor turns under two torques at one temperature")
        },
    )
    compensable = Compensable(True, "the load really has this error, if the torque is known on line")
    part = Part.GROWTH
    carries = {Part.ORDERS: "orders"}
    linear = ("growth_percent_per_nm",)
    typical = {"growth_percent_per_nm": 1.0}

    orders: Orders

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields growth with the torque's magnitude and with the signed torque, within the record's range."""
        largest = top(observations.motion, Channel.LOAD_TORQUE)
        if not largest or not has_orders(base):
            return
        # An effect is clamped beyond its limit, so the limit must exceed the record's torques.
        limit = max(TorqueGrowth.model_fields["limit_nm"].default, 2.0 * largest)
        for signed in (False, True):
            yield cls(orders=orders_of(base), growth_percent_per_nm=1.0, signed=signed, limit_nm=limit)

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        channel = Channel(self.torque)
        torque, name = motion.channel(channel, self.name), channel.title
        if self.signed:
            return Coordinate(name, "Nm", torque, spacing=Spacing.FILLED)
        return Coordinate(f"{name}, either direction", "Nm", np.abs(torque), spacing=Spacing.FILLED)

    def scales(self) -> tuple[Part, Effect]:
        return Part.ORDERS, MotorOrders(orders=self.orders)

    def needs(self) -> frozenset[Channel]:
        return frozenset({Channel(self.torque)})

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error due to a growth of 1 % per Nm, shape (n, 1)."""
        orders = ripple(motion.motor_deg, phasors(self.orders))
        column: FloatArray = 0.01 * self.load_nm(motion, self.name) * orders
        return column[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        orders, gain = OrderTracker(phasors(self.orders)), 0.01 * self.growth_percent_per_nm
        return Memoryless(lambda motor_deg, now: gain * self.load_at_nm(now) * orders.peek(motor_deg, now))

    def bound_arcsec(self) -> float:
        return self.most() * sum(each.amplitude_arcsec for each in self.orders)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns the steepest slope of the added ripple at the torque limit, arcsec per motor degree."""
        return self.most() * RAD_PER_DEG * sum(each.order * each.amplitude_arcsec for each in self.orders)
