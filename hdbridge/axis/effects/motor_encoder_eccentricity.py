"""Eccentricity of the motor encoder's disc, whose reading error becomes a real error of the motor."""

from collections.abc import Iterator, Sequence
from typing import Self

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Part
from hdbridge.axis.effects.orders import OrderSeries, orders_from


class MotorEncoderEccentricity(OrderSeries):
    """A_1 cos(theta_M + phi_1) + A_2 cos(2 theta_M + phi_2), amplitudes at the load."""

    name = "motor_encoder_eccentricity"
    changes = Part.ORDERS
    few = frozenset({1, 2})
    about = Cause(
        title="eccentric motor encoder disc",
        subject="orders",
        equation="A_1 cos(theta_M + phi_1) + A_2 cos(2 theta_M + phi_2); A_1 = (e / r) / N for a disc of "
        "radius r that is out of centre by e",
        signature="order 1 (eccentric) and 2 (tilted or oval) of the motor angle",
        consequence="the drive follows the encoder, so motor and load really run ahead and behind once per "
        "motor turn",
        remedy="compensate it with the synchronous part; centre the disc; calibrate again after removing the "
        "encoder",
        experiment="re-clock the encoder on the motor shaft by 90 deg: its error turns with it, the gear's "
        "does not",
        aliases=("motor_order", "synchronous"),
        source="geometry of an eccentric disc: reading error (e / r) sin(theta), first order in e / r",
        size="1-10 arcsec",
    )
    compensable = Compensable(
        True, "the position loop is closed on this encoder, so its error becomes a real motion of the load"
    )
    typical = {"orders": orders_from((1, 2), 3.0)}

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields both orders, even if the model already has one, because one disc causes both."""
        yield cls(orders=orders_from((1, 2)))

    @classmethod
    def of_change(cls, before: Effect, now: Effect) -> Self | None:
        return cls._change(before, now)
