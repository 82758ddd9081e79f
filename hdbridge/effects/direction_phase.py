"""The synchronous part shifts with the direction of travel: other flanks of the teeth carry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field

from hdbridge.effects.base import (
    Cause,
    Channel,
    Coefficient,
    Compensable,
    Effect,
    FloatArray,
    Memoryless,
    Moment,
    Motion,
    Observations,
    Part,
    Start,
    Tracker,
)
from hdbridge.effects.carried import has_orders, orders_of
from hdbridge.effects.kinematics import direction_of
from hdbridge.effects.orders import RAD_PER_DEG, Orders, horner, phasors, ripple

STEEPEST = 3.0
"""Of k shift = 72 deg: from there to 108 deg an order's mean is less than a third of the tooth error's."""


class DirectionPhase(Effect):
    """The part odd in direction of a tooth error T(theta_M + d shift), S being the mean over both flanks.

    An order A_k of the tooth error is A_k cos(k shift) in the mean, which is what the model's synchronous
    part has, because that was fitted over both directions; and it is A_k sin(k shift) in the odd part. So the
    odd part is tan(k shift) times the mean's order, a quarter of its turn ahead. The tangent is held at
    `STEEPEST`: beyond, hardly anything of an order is left in the mean. One angle shifts all orders: a free
    amplitude per order would be many parameters for one cause.
    """

    name: ClassVar[str] = "direction_phase"
    channels: ClassVar[frozenset[Channel]] = frozenset({Channel.DIRECTION})
    about: ClassVar[Cause] = Cause(
        title="synchronous part shifted with the direction",
        equation="d times the sum over k of -A_k tan(k shift) sin(k theta_M + phi_k), A_k and phi_k the "
        "synchronous part's, d the direction held at rest",
        signature="the ripple within a motor turn is displaced between the two directions, by one angle "
        "for all orders",
        consequence="a compensation without it leaves the ripple's difference, with opposite signs in the "
        "two directions",
        remedy="compensate it; it is the change of tooth flanks, and grows with preload and with load",
        experiment="slow sweeps over the same motor turns both ways; even and odd part in the direction",
        aliases=("hysteresis_parameters",),
        source="phase of the kinematic error differs between the tooth flanks that carry",
        size="1-5 arcsec",
    )
    compensable: ClassVar[Compensable] = Compensable(
        True, "the load really moves so; the direction is commanded"
    )
    carries: ClassVar[Mapping[Part, str]] = {Part.ORDERS: "orders"}
    curved: ClassVar[bool] = True
    typical: ClassVar[Mapping[str, Any]] = {"shift_deg": 1.0}
    """A shift of one degree of the base's orders."""

    orders: Orders
    shift_deg: Annotated[
        float,
        Field(ge=-45, le=45, description="shift of the motor angle, forward ahead of backward by twice this"),
    ]

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[DirectionPhase]:  # noqa: ARG003
        """From no shift on."""
        if has_orders(base):
            yield cls(orders=orders_of(base), shift_deg=0.0)

    def left_in_mean(self, order: int) -> float:
        """Flanks that are a shift apart have a mean that is less than either, by the cosine of the shift."""
        return math.cos(order * math.radians(self.shift_deg))

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        """The shift."""
        return (Coefficient("shift_deg", (0,), ("shift_deg",)),)

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec, shape (n,)."""
        return self.columns(motion, start)[:, 0] * self.shift_deg

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """On-line tracker; the direction comes with the moment."""
        return _Tracker(tuple(self.shift_deg * each for each in self._odd()), start.value)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Per degree of shift, *at the present shift*, shape (n, 1): nearly linear, so fit, and fit again."""
        error: FloatArray = direction_of(motion, start) * ripple(motion.motor_deg, self._odd())
        return error[:, np.newaxis]

    def coefficients(self) -> FloatArray:
        """The shift, degrees of the motor."""
        return np.array([self.shift_deg])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Another shift."""
        return self.model_copy(update={"shift_deg": float(coefficients[0])})

    def bound_arcsec(self) -> float:
        """Sum of A_k |tan(k shift)|."""
        return abs(self.shift_deg) * sum(map(abs, self._odd()))

    def slope_bound_arcsec_per_deg(self) -> float:
        """Sum of k A_k |tan(k shift)|, per degree."""
        steepness = sum(k * abs(each) for k, each in enumerate(reversed(self._odd())))
        return RAD_PER_DEG * abs(self.shift_deg) * steepness

    @classmethod
    def _carried(cls, base: Sequence[Effect]) -> dict[str, Any]:
        return {"orders": orders_of(base)}

    def _odd(self) -> tuple[complex, ...]:
        """Phasors of the odd part per degree of shift: j A_k tan(k shift) / shift exp(j phi_k)."""
        given = phasors(self.orders)
        highest = len(given) - 1
        return tuple(1j * each * self._tangent(highest - i) for i, each in enumerate(given))

    def _tangent(self, order: int) -> float:
        if abs(self.shift_deg) < 1e-9:
            return order * RAD_PER_DEG
        tangent = math.tan(order * RAD_PER_DEG * self.shift_deg)
        return min(max(tangent, -STEEPEST), STEEPEST) / self.shift_deg


class _Tracker(Memoryless):
    __slots__ = ("_phasors", "_start")

    def __init__(self, amplitudes: tuple[complex, ...], start: int) -> None:
        self._phasors = amplitudes
        self._start = start

    def peek(self, motor_deg: float, moment: Moment) -> float:
        angle = RAD_PER_DEG * motor_deg
        error = horner(self._phasors, complex(math.cos(angle), math.sin(angle))).real
        return (moment.direction or self._start) * error
