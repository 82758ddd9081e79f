"""The synchronous part: errors that repeat with every turn of the motor (the wave generator)."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from hdbridge.effects.base import (
    Cause,
    Effect,
    FloatArray,
    Memoryless,
    Moment,
    Motion,
    Start,
    Tracker,
)

_RAD_PER_DEG = math.pi / 180.0
_Phasor = TypeVar("_Phasor", complex, "np.ndarray[tuple[int], np.dtype[np.complex128]]")


class MotorOrder(BaseModel):
    """One harmonic: amplitude * cos(order * motor_angle + phase)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    order: Annotated[int, Field(ge=1, le=1000, description="periods per motor turn")]
    amplitude_arcsec: Annotated[float, Field(ge=0, le=3600, description="amplitude at the load")]
    phase_deg: Annotated[float, Field(ge=-360, le=360, description="phase of the cosine")]


class Synchronous(Effect):
    """Sum of A_k cos(k theta_M + phi_k) over orders k of the motor angle theta_M."""

    name: ClassVar[str] = "synchronous"
    about: ClassVar[Cause] = Cause(
        title="synchronous transmission error",
        equation="sum over k of A_k cos(k theta_M + phi_k)",
        signature="repeats with every motor turn, the same in both directions and at every load angle",
        consequence="the load runs ahead and behind within each motor turn",
        remedy="compensate it; its size is a matter of tooth quality and of how true the wave generator runs",
        experiment="a slow sweep over whole motor turns, both ways",
        aliases=("motor_encoder_eccentricity",),
        source="Fourier series over the wave generator's angle, the usual kinematic error model",
    )

    orders: tuple[MotorOrder, ...]

    @field_validator("orders")
    @classmethod
    def _distinct(cls, orders: tuple[MotorOrder, ...]) -> tuple[MotorOrder, ...]:
        numbers = [each.order for each in orders]
        if len(set(numbers)) != len(numbers):
            raise ValueError("each order may stand only once")
        return orders

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Error in arcsec, shape (n,)."""
        turn = np.exp(1j * (_RAD_PER_DEG * motion.motor_deg))
        error: FloatArray = horner(self._phasors(), turn).real
        return error

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        """On-line tracker; it has no state."""
        return _SynchronousTracker(self._phasors())

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """For each order its cosine and its sine, shape (n, 2 * orders)."""
        angles = _RAD_PER_DEG * np.outer(motion.motor_deg, [each.order for each in self.orders])
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(len(motion), -1)

    def coefficients(self) -> FloatArray:
        """A cos(phi) and -A sin(phi) of each order, arcsec."""
        pairs = [
            (each.amplitude_arcsec * math.cos(phase), -each.amplitude_arcsec * math.sin(phase))
            for each in self.orders
            for phase in [math.radians(each.phase_deg)]
        ]
        return np.array(pairs, dtype=np.float64).reshape(-1)

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """The same orders with amplitudes and phases from cosine and sine coefficients."""
        pairs = np.asarray(coefficients, dtype=np.float64).reshape(len(self.orders), 2)
        orders = tuple(
            MotorOrder(
                order=each.order,
                amplitude_arcsec=math.hypot(cosine, sine),
                phase_deg=math.degrees(math.atan2(-sine, cosine)),
            )
            for each, (cosine, sine) in zip(self.orders, pairs.tolist(), strict=True)
        )
        return self.model_copy(update={"orders": orders})

    def bound_arcsec(self) -> float:
        """Sum of the amplitudes."""
        return sum(each.amplitude_arcsec for each in self.orders)

    def slope_bound_arcsec_per_deg(self) -> float:
        """Sum of order times amplitude, per degree."""
        return _RAD_PER_DEG * sum(each.order * each.amplitude_arcsec for each in self.orders)

    def _phasors(self) -> tuple[complex, ...]:
        """Complex amplitudes from the highest order down to order 0, for `horner`."""
        highest = max((each.order for each in self.orders), default=0)
        phasors = [0j] * (highest + 1)
        for each in self.orders:
            phasors[each.order] = cmath.rect(each.amplitude_arcsec, math.radians(each.phase_deg))
        return tuple(reversed(phasors))


def horner(phasors: tuple[complex, ...], turn: _Phasor) -> _Phasor:
    """Polynomial in ``turn`` = exp(j theta), for one angle or for a whole record.

    One exponential and a few multiplications per order is several times faster in the control loop than a
    cosine per order, and the same lines serve a record.
    """
    total = 0.0 * turn
    for phasor in phasors:
        total = total * turn + phasor
    return total


class _SynchronousTracker(Memoryless):
    __slots__ = ("_phasors",)

    def __init__(self, phasors: tuple[complex, ...]) -> None:
        self._phasors = phasors

    def peek(self, motor_deg: float, moment: Moment) -> float:
        angle = _RAD_PER_DEG * motor_deg
        return horner(self._phasors, complex(math.cos(angle), math.sin(angle))).real
