"""The gear's output: motor angle / ratio, and all that the gear adds to it.

What is added is a sum of pieces, each one physical cause. A further cause is a further class here (or in a
file of its own) and a line in `pieces_of`; it reads what it depends on from the `Conditions`.
"""

from __future__ import annotations

import math
from typing import ClassVar, Protocol

from hdbridge.sim.hysteresis_laws import Law, law_of
from hdbridge.sim.orders import Orders
from hdbridge.sim.truth import TrueOrder, Truth
from hdbridge.units import ARCSEC_PER_DEG


class Conditions:
    """What a piece may depend on, as it is now; the plant keeps it up to date."""

    __slots__ = ("load_deg", "motor_deg", "temperature_c", "torque_nm")

    def __init__(self, temperature_c: float) -> None:
        self.motor_deg = 0.0
        self.load_deg = 0.0
        self.torque_nm = 0.0
        """Torque of the flexspline's spring on the load."""
        self.temperature_c = temperature_c


class Piece(Protocol):
    """One cause of transmission error, with its state."""

    BY_MOTOR_ONLY: ClassVar[bool]
    """Whether it cannot change while the motor stands."""

    def arcsec(self, now: Conditions) -> float:
        """Its part of the output's error, once the axis has come to these conditions."""
        ...


class MotorOrders:
    """Tooth error by the motor's angle, and by the angle between wave generator and flexspline."""

    BY_MOTOR_ONLY: ClassVar[bool] = True
    __slots__ = ("_orders", "_rad_per_deg")

    def __init__(self, orders: tuple[TrueOrder, ...], turns: float) -> None:
        self._orders = Orders(orders)
        self._rad_per_deg = math.radians(turns)

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        return self._orders.at(now.motor_deg * self._rad_per_deg)


class LoadOrders:
    """Tooth error by the load's angle."""

    BY_MOTOR_ONLY: ClassVar[bool] = False
    __slots__ = ("_orders",)

    def __init__(self, orders: tuple[TrueOrder, ...]) -> None:
        self._orders = Orders(orders)

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        return self._orders.at(math.radians(now.load_deg))


class ElasticHysteresis:
    """The elastic part, by the way the motor has come."""

    BY_MOTOR_ONLY: ClassVar[bool] = True
    __slots__ = ("_advance",)

    def __init__(self, law: Law) -> None:
        self._advance = law.advance

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        return self._advance(now.motor_deg)


class ZeroDrift:
    """A shift that goes with the temperature."""

    BY_MOTOR_ONLY: ClassVar[bool] = False
    __slots__ = ("_ambient_c", "_arcsec_per_k")

    def __init__(self, ambient_c: float, arcsec_per_k: float) -> None:
        self._ambient_c = ambient_c
        self._arcsec_per_k = arcsec_per_k

    def arcsec(self, now: Conditions) -> float:
        """See `Piece`."""
        return self._arcsec_per_k * (now.temperature_c - self._ambient_c)


def pieces_of(truth: Truth) -> list[Piece]:
    """The causes that a truth file sets to work, at their start."""
    gear, temperature = truth.gear, truth.temperature
    pieces: list[Piece] = []
    if gear.motor_orders:
        pieces.append(MotorOrders(gear.motor_orders, 1.0))
    if gear.flexspline_orders:
        pieces.append(MotorOrders(gear.flexspline_orders, 1.0 + 1.0 / gear.ratio))
    if gear.load_orders:
        pieces.append(LoadOrders(gear.load_orders))
    law = law_of(gear.hysteresis, 0.0)
    if law is not None:
        pieces.append(ElasticHysteresis(law))
    if temperature.zero_drift_arcsec_per_k:
        pieces.append(ZeroDrift(temperature.ambient_c, temperature.zero_drift_arcsec_per_k))
    return pieces


class Gear:
    """The output of the gear before its spring, in degrees of the load."""

    __slots__ = ("_pieces", "_ratio", "by_motor_only")

    def __init__(self, truth: Truth) -> None:
        pieces = pieces_of(truth)
        self._ratio = truth.gear.ratio
        self._pieces = tuple(piece.arcsec for piece in pieces)
        self.by_motor_only = all(piece.BY_MOTOR_ONLY for piece in pieces)
        """Whether the output cannot change while the motor stands."""

    def output_deg(self, now: Conditions) -> float:
        """Where the output would turn an unloaded shaft."""
        error = 0.0
        for arcsec in self._pieces:
            error += arcsec(now)
        return now.motor_deg / self._ratio + error / ARCSEC_PER_DEG
