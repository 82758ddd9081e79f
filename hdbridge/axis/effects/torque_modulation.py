"""Growth of the synchronous part with load, because the mesh deflects."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np

from hdbridge.axis.effects.base import (
    Cause,
    Channel,
    Compensable,
    Coordinate,
    Effect,
    Experiment,
    FloatArray,
    Linear,
    Memoryless,
    Moment,
    Motion,
    Observations,
    Part,
    Start,
    Tracker,
)
from hdbridge.axis.effects.carried import has_orders, orders_of
from hdbridge.axis.effects.coordinate import Spacing
from hdbridge.axis.effects.motor_order import MotorOrders
from hdbridge.axis.effects.observations import top
from hdbridge.axis.effects.orders import RAD_PER_DEG, Orders, OrderTracker, phasors, ripple
from hdbridge.axis.effects.torque import TorqueGrowth


class TorqueModulation(TorqueGrowth, Linear):
    """growth |T| S(theta_M): all carried orders grow alike; to let fewer grow, carry fewer."""

    name: ClassVar[str] = "torque_modulation"
    channels: ClassVar[frozenset[Channel]] = frozenset({Channel.LOAD_TORQUE})
    about: ClassVar[Cause] = Cause(
        title="ripple that grows with load",
        subject="effects of torque",
        equation="growth tau S(theta_M), S the carried orders, tau = |T| (or T where signed), limited to "
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
    compensable: ClassVar[Compensable] = Compensable(
        True, "the load really moves so, where the torque is known on line"
    )
    part: ClassVar[Part | None] = Part.GROWTH
    carries: ClassVar[Mapping[Part, str]] = {Part.ORDERS: "orders"}
    linear: ClassVar[tuple[str, ...]] = ("growth_percent_per_nm",)
    typical: ClassVar[Mapping[str, Any]] = {"growth_percent_per_nm": 1.0}
    """1 % per Nm for all orders."""

    orders: Orders

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields growth with the torque and with its magnitude, over the range of the record."""
        largest = top(observations.motion, Channel.LOAD_TORQUE)
        if not largest or not has_orders(base):
            return
        # Beyond its limit an effect is clamped, so the record's torques must lie within.
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
        """Returns the effect of a growth of 1 % per Nm, shape (n, 1)."""
        orders = ripple(motion.motor_deg, phasors(self.orders))
        column: FloatArray = 0.01 * self.load_nm(motion, self.name) * orders
        return column[:, np.newaxis]

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return _Tracker(self)

    def bound_arcsec(self) -> float:
        return self.most() * sum(each.amplitude_arcsec for each in self.orders)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Slope of the ripple's growth at the highest torque."""
        return self.most() * RAD_PER_DEG * sum(each.order * each.amplitude_arcsec for each in self.orders)

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        return {"orders": orders_of(base)}


class _Tracker(Memoryless):
    def __init__(self, effect: TorqueModulation) -> None:
        self._orders = OrderTracker(phasors(effect.orders))
        self._gain = 0.01 * effect.growth_percent_per_nm
        self._load_nm = effect.load_at_nm

    def peek(self, motor_deg: float, moment: Moment) -> float:
        return self._gain * self._load_nm(moment) * self._orders.peek(motor_deg, moment)
