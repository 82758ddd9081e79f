"""Synchronous part: errors that repeat with every turn of the motor (the wave generator)."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self

from hdbridge.axis.effects.base import Cause, Compensable, Effect, Observations, Part
from hdbridge.axis.effects.orders import MotorOrder, OrderSeries

TYPICAL_ORDERS = tuple(
    MotorOrder(order=k, amplitude_arcsec=a, phase_deg=p)
    for k, a, p in [
        (1, 4.9, -126.8), (2, 9.33, -132.1), (3, 2.09, -96.2),
        (4, 12.21, 105.7), (6, 3.18, -127.0), (8, 1.87, 124.3),
    ]
)  # fmt: skip
"""A published gear of ratio 50 (Table 1 of the article that hdbridge implements)."""


class Synchronous(OrderSeries):
    """Sum of A_k cos(k theta_M + phi_k) over orders k of the motor angle theta_M."""

    name: ClassVar[str] = "synchronous"
    about: ClassVar[Cause] = Cause(
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
    compensable: ClassVar[Compensable] = Compensable(True, "the load really moves so, and it repeats")
    typical: ClassVar[Mapping[str, Any]] = {"orders": TYPICAL_ORDERS}
    """The published gear."""
    part: ClassVar[Part | None] = Part.ORDERS
    drifting: ClassVar[tuple[str, ...]] = ("orders",)
    """Teeth and the wave generator's bearing wear."""

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields none, because its orders are read from a spectrum."""
        return iter(())

    def turns_per_motor_turn(self) -> float:
        """One, because the orders refer to the motor angle itself."""
        return 1.0
