"""The load encoder interpolates between its lines, and its sine signals are not perfect sines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, field_validator

from hdbridge.effects.base import (
    Cause,
    Channel,
    Compensable,
    Effect,
    FloatArray,
    Memoryless,
    Moment,
    Motion,
    Start,
    Tracker,
)
from hdbridge.effects.orders import (
    RAD_PER_DEG,
    MotorOrder,
    Orders,
    coefficients_of,
    cosines_and_sines,
    horner,
    orders_fitted,
    orders_from,
    phasors,
)

_HARMONICS = (1, 2, 4)


class SubdivisionalError(Effect):
    """Sum over k = 1, 2, 4 of A_k cos(k lines theta_L + phi_k).

    The load angle has to be the predicted one, error included: a line is often only a few hundred arcsec
    wide, so motor angle / N is not good enough; and the measured angle's own noise would invent the effect.
    """

    name: ClassVar[str] = "subdivisional_error"
    channels: ClassVar[frozenset[Channel]] = frozenset({Channel.LOAD_ANGLE})
    about: ClassVar[Cause] = Cause(
        title="interpolation error of the load encoder",
        equation="sum over k of A_k cos(k lines theta_L + phi_k), k = 1 (offset), 2 (gain, phase), 4 "
        "(distortion)",
        signature="very many periods per load turn: as many as the encoder has lines, or twice, or four "
        "times",
        consequence="none for the axis: the measurement alone is wrong within each line",
        remedy="align and clean the reading head; correct offset, gain and phase of its signals",
        experiment="a very slow sweep over some lines, then with the reading head moved along by a "
        "fraction of a line",
        aliases=("motor_order", "vibration"),
        source="Lissajous errors of sine encoders (Heydemann)",
        size="0.1-2 arcsec",
    )
    compensable: ClassVar[Compensable] = Compensable(
        False,
        "it is an error of the measurement; to compensate it would move the load away from where it should "
        "be",
    )
    typical: ClassVar[Mapping[str, Any]] = {"lines_per_turn": 9000, "orders": orders_from(_HARMONICS, 0.5)}
    """9000 lines, as an example: the line count is a matter of search or of the data sheet."""

    lines_per_turn: Annotated[int, Field(ge=16, le=10_000_000, description="signal periods per load turn")]
    orders: Orders

    @field_validator("orders")
    @classmethod
    def _few(cls, orders: tuple[MotorOrder, ...]) -> tuple[MotorOrder, ...]:
        numbers = [each.order for each in orders]
        if len(set(numbers)) != len(numbers) or not set(numbers) <= set(_HARMONICS):
            raise ValueError("orders of the line count are 1, 2 and 4, each once at most")
        return orders

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec, shape (n,)."""
        error: FloatArray = horner(phasors(self.orders), np.exp(1j * self._angle(motion))).real
        return error

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """On-line tracker; the load angle comes with the moment."""
        return _Tracker(phasors(self.orders), RAD_PER_DEG * self.lines_per_turn)

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """For each order its cosine and its sine, shape (n, 2 * orders)."""
        return cosines_and_sines(self._angle(motion), [each.order for each in self.orders])

    def coefficients(self) -> FloatArray:
        """A cos(phi) and -A sin(phi) of each order, arcsec."""
        return coefficients_of(self.orders)

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Other amplitudes and phases; another line count where given in ``shape``."""
        update = {"orders": orders_fitted(self.orders, coefficients), **dict(shape or {})}
        return self.model_copy(update=update)

    def bound_arcsec(self) -> float:
        """Sum of the amplitudes."""
        return sum(each.amplitude_arcsec for each in self.orders)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Zero: the load angle is the predicted one of the moment, whatever angle is asked about."""
        return 0.0

    def _angle(self, motion: Motion) -> FloatArray:
        return (RAD_PER_DEG * self.lines_per_turn) * motion.channel(Channel.LOAD_ANGLE, self.name)


class _Tracker(Memoryless):
    __slots__ = ("_phasors", "_scale")

    def __init__(self, amplitudes: tuple[complex, ...], scale: float) -> None:
        self._phasors = amplitudes
        self._scale = scale

    def peek(self, motor_deg: float, moment: Moment) -> float:
        angle = self._scale * moment.load_deg
        return horner(self._phasors, complex(math.cos(angle), math.sin(angle))).real
