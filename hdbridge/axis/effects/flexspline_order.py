"""Orders of the wave generator relative to the flexspline, which rotates in the opposite direction."""

import numpy as np

from hdbridge.axis.effects.coordinate import Coordinate
from hdbridge.axis.effects.described import Cause, Compensable
from hdbridge.axis.effects.load_order import Ratio
from hdbridge.axis.effects.motion import Motion
from hdbridge.axis.effects.orders import OrderSeries, orders_from
from hdbridge.units import DEG_PER_TURN


class FlexsplineOrders(OrderSeries):
    """Sum of A_k cos(k (1 + 1/N) theta_M + phi_k)."""

    name = "flexspline_order"
    about = Cause(
        title="order of the wave generator relative to the flexspline",
        subject="orders",
        equation="sum over k of A_k cos(k (1 + 1/N) theta_M + phi_k)",
        signature="nearly a motor order, but its phase advances by k turns per load turn",
        consequence="a model of motor orders compensates the ripple at one load angle and doubles it at "
        "another",
        remedy="add it to the model",
        experiment="a slow sweep over one load turn, preferably two: over less it looks like a motor order",
        aliases=("motor_order", "synchronous"),
        source="kinematics of a strain wave gear: the flexspline turns by -theta_M / N under the wave "
        "generator",
        size="1-10 arcsec",
    )
    compensable = Compensable(True, "the load really has this error, and it repeats")
    typical = {"orders": orders_from((1, 2, 4), 2.0)}
    searched = range(1, 9)

    ratio: Ratio

    def coordinate(self, motion: Motion, ratio: float) -> Coordinate:
        """Returns the wave generator's angle relative to the flexspline, modulo one turn."""
        angle = np.mod(motion.motor_deg * (1.0 + 1.0 / ratio), DEG_PER_TURN)
        return Coordinate("angle of the wave generator to the flexspline", "deg", angle)

    def turns_per_motor_turn(self) -> float:
        return 1.0 + 1.0 / self.ratio
