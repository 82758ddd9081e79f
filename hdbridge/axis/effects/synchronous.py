"""Synchronous part: errors that repeat with every turn of the motor (the wave generator)."""

from hdbridge.axis.effects.described import Cause, Compensable, Part
from hdbridge.axis.effects.orders import MotorOrder, OrderSeries

TYPICAL_ORDERS = tuple(
    MotorOrder(order=k, amplitude_arcsec=a, phase_deg=p)
    for k, a, p in [
        (1, 4.9, -126.8), (2, 9.33, -132.1), (3, 2.09, -96.2),
        (4, 12.21, 105.7), (6, 3.18, -127.0), (8, 1.87, 124.3),
    ]
)  # fmt: skip
"""Orders of a published gear with ratio 50 (Table 1 of the article that hdbridge implements)."""


class Synchronous(OrderSeries):
    """Sum of A_k cos(k theta_M + phi_k) over orders k of the motor angle theta_M."""

    name = "synchronous"
    about = Cause(
        title="synchronous transmission error",
        equation="sum over k of A_k cos(k theta_M + phi_k)",
        signature="repeats with every motor turn, the same in both directions and at every load angle",
        consequence="the load runs ahead and behind within each motor turn",
        remedy="compensate it",
        experiment="a slow sweep over whole motor turns, both ways",
        aliases=("motor_encoder_eccentricity",),
        source="Fourier series over the wave generator's angle, the usual kinematic error model",
        size="20-60 arcsec peak to peak",
    )
    compensable = Compensable(True, "the load really has this error, and it repeats")
    typical = {"orders": TYPICAL_ORDERS}
    """Orders of the published gear."""
    part = Part.ORDERS
    drifting = ("orders",)
    """All orders drift, because the teeth and the wave generator's bearing wear."""
