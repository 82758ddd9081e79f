"""Further orders of the motor angle, in addition to those that the synchronous part of the model has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from hdbridge.effects.base import Cause, Compensable, Effect
from hdbridge.effects.orders import OrderSeries, orders_from


class MotorOrders(OrderSeries):
    """Sum of A_k cos(k theta_M + phi_k) over orders that the model does not have."""

    name: ClassVar[str] = "motor_order"
    about: ClassVar[Cause] = Cause(
        title="an order of the motor that the model does not have",
        equation="sum over k of A_k cos(k theta_M + phi_k), k not among the synchronous part's orders",
        signature="repeats with every motor turn; the same in both directions, at every load angle and speed",
        consequence="a ripple of the load within each motor turn that the compensation leaves",
        remedy="add the order to the model; new orders after months hint at wear of the wave generator's "
        "bearing",
        experiment="steps of another size, or a slow sweep: an order that was an alias of the step moves",
        aliases=("motor_encoder_eccentricity", "synchronous"),
        source="Fourier series over the wave generator's angle",
        size="0.3-3 arcsec; often k = 3, 5, 7, 10, 12",
    )
    compensable: ClassVar[Compensable] = Compensable(True, "the load really moves so, and it repeats")
    drifting: ClassVar[tuple[str, ...]] = ("orders",)
    """As the synchronous part's."""

    def turns_per_motor_turn(self) -> float:
        """One: it counts on the motor angle itself."""
        return 1.0

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        """Those of orders 1 to 12 that the model does not have."""
        present = {order.order for each in base if isinstance(each, OrderSeries)
                   if each.turns_per_motor_turn() == 1.0 for order in each.orders}  # fmt: skip
        return {"orders": orders_from(k for k in range(1, 13) if k not in present)}
