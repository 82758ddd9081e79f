"""Orders of the motor angle in addition to those of the model's synchronous part."""

from collections.abc import Sequence
from typing import Any, Self

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.described import Cause, Compensable, Experiment, Part
from hdbridge.axis.effects.orders import HIGHEST_MOTOR_ORDER, OrderSeries, orders_from


class MotorOrders(OrderSeries):
    """Sum of A_k cos(k theta_M + phi_k) over orders that the model's synchronous part does not contain."""

    name = "motor_order"
    about = Cause(
        title="motor order missing or wrong in the model",
        subject="orders",
        equation="sum over k of A_k cos(k theta_M + phi_k), k not among the synchronous part's orders",
        signature="repeats with every motor turn; the same in both directions, at every load angle and speed",
        consequence="the compensation leaves a ripple within each motor turn",
        remedy="add the order to the model; a new one suggests wear of the wave generator's bearing",
        experiment="steps of another size, or a slow sweep: an order aliased by the step moves",
        aliases=("motor_encoder_eccentricity", "synchronous"),
        source="Fourier series over the wave generator's angle",
        size="0.3-3 arcsec; often k = 3, 5, 7, 10, 12",
        apart={
            "motor_encoder_eccentricity": Experiment(
                15,
                "re-clock the motor encoder by 90 deg on its shaft and sweep ten motor turns: its part turns "
                "with it",
            )
        },
    )
    compensable = Compensable(True, "the load really has this error, and it repeats")
    part = Part.ORDERS
    searched = range(1, HIGHEST_MOTOR_ORDER + 1)
    usual = 4
    """Maximum number of similar orders; a worn wave-generator bearing causes several."""
    drifting = ("orders",)
    """All orders drift, because wear of teeth and bearing changes them."""

    @classmethod
    def of_change(cls, before: Effect, now: Effect) -> Self | None:
        return cls._change(before, now)

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        present = {order.order for each in base if isinstance(each, OrderSeries)
                   if each.turns_per_motor_turn() == 1.0 for order in each.orders}  # fmt: skip
        return {"orders": orders_from(k for k in range(1, 13) if k not in present)}
