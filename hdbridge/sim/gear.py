"""Gear output: motor angle / ratio, plus the transmission error.

The error is a sum of pieces, each a physical cause. To add a cause, write a class in
`hdbridge.sim.gear_pieces` (or in its own file) and a line in `pieces_of`; the class reads its inputs from the
`Conditions`. An inactive cause has no piece and no cost.
"""

import math
from typing import ClassVar, Protocol

from hdbridge.sim.gear_pieces import (
    AgeFactor,
    Creep,
    Damage,
    Flank,
    Jumps,
    Roller,
    Seat,
    SpeedFactor,
    WarmthFactor,
    Wear,
    WornTeeth,
)
from hdbridge.sim.hysteresis_laws import Law, law_of
from hdbridge.sim.orders import Orders
from hdbridge.sim.state import Conditions, state
from hdbridge.sim.truth import TrueOrder, Truth
from hdbridge.sim.truth.gear import TrueFlank
from hdbridge.units import ARCSEC_PER_DEG


class Factor(Protocol):
    """Factor that multiplies the contribution of a cause."""

    def factor(self, now: Conditions) -> float:
        """Advances by one substep and returns the factor under these conditions."""
        ...


class Piece(Protocol):
    """One cause of transmission error, with its state."""

    @property
    def by_motor_only(self) -> bool:
        """True if the piece cannot change while the motor is at rest."""
        ...

    def arcsec(self, now: Conditions) -> float:
        """Returns the piece's contribution to the output error under the new conditions, arcsec."""
        ...


@state
class MotorOrders:
    """Tooth error as a function of the motor angle, or of the angle between wave generator and flexspline.

    The error may also depend on the loaded flank, the torque and the temperature.
    """

    def __init__(
        self,
        orders: tuple[TrueOrder, ...],
        turns: float = 1.0,
        flank: TrueFlank | None = None,
        growth_per_nm: float = 0.0,
        factors: tuple[Factor, ...] = (),
    ) -> None:
        self._orders = Orders(orders)
        self._turns = turns
        self._rad_per_deg = math.radians(turns)
        self._growth_per_nm = growth_per_nm
        self._flanked: bool = flank is not None
        self._flank = Flank(flank if flank is not None else TrueFlank(shift_deg=0.0, travel_deg=1.0))
        self._factors: tuple[Factor, ...] = factors
        self.by_motor_only: bool = flank is None and not growth_per_nm and not factors

    def arcsec(self, now: Conditions) -> float:
        angle_deg = now.motor_deg
        if self._flanked:
            angle_deg += self._flank.shift_deg(angle_deg)
        size = 1.0
        for factor in self._factors:
            size *= factor.factor(now)
        error, slope = self._orders.at(angle_deg * self._rad_per_deg)
        grown = self._growth_per_nm * abs(now.torque_nm)
        # The growth of the error with the torque counts only by half in the reaction (see `plant`).
        now.slope_arcsec += slope * self._turns * (1.0 + 0.5 * grown) * size
        return error * (1.0 + grown) * size


@state
class LoadOrders:
    """Tooth error as a function of the load angle."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, orders: tuple[TrueOrder, ...]) -> None:
        self._orders = Orders(orders)

    def arcsec(self, now: Conditions) -> float:
        return self._orders.at(math.radians(now.load_deg))[0]


@state
class ElasticHysteresis:
    """Elastic hysteresis over the motor's travel; may also depend on speed, temperature or age."""

    _loop_slope: float
    """Slope of the loop over the last travel of the motor, arcsec per radian."""

    def __init__(self, law: Law, factors: tuple[Factor, ...], reaction: float) -> None:
        self._law: Law = law
        self._factors: tuple[Factor, ...] = factors
        self._reaction = reaction
        self._loop_deg = self._loop_slope = 0.0
        self._loop_arcsec = law.advance(0.0)
        self.by_motor_only: bool = not factors

    def arcsec(self, now: Conditions) -> float:
        loop, size = self._law.advance(now.motor_deg), 1.0
        for factor in self._factors:
            size *= factor.factor(now)
        if self._reaction:
            if now.motor_deg != self._loop_deg:
                travel = math.radians(now.motor_deg - self._loop_deg)
                self._loop_slope = (loop - self._loop_arcsec) / travel
                self._loop_arcsec, self._loop_deg = loop, now.motor_deg
            now.slope_arcsec += self._reaction * self._loop_slope * size
        return loop * size


@state
class ZeroDrift:
    """Shift of the output proportional to the temperature above ambient."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, ambient_c: float, arcsec_per_k: float) -> None:
        self._ambient_c = ambient_c
        self._arcsec_per_k = arcsec_per_k

    def arcsec(self, now: Conditions) -> float:
        return self._arcsec_per_k * (now.temperature_c - self._ambient_c)


@state
class SlowZeroDrift:
    """Shift of the output with the temperature of a housing, which lags the measured temperature."""

    by_motor_only: ClassVar[bool] = False

    def __init__(self, ambient_c: float, arcsec_per_k: float, start_c: float, nearer: float) -> None:
        self._ambient_c = ambient_c
        self._arcsec_per_k = arcsec_per_k
        self._housing_c = start_c
        self._nearer = nearer

    def arcsec(self, now: Conditions) -> float:
        self._housing_c += (now.temperature_c - self._housing_c) * self._nearer
        return self._arcsec_per_k * (self._housing_c - self._ambient_c)


def pieces_of(truth: Truth) -> list[Piece]:
    """Returns the active causes of a truth file, in their initial states."""
    gear, dt_s = truth.gear, truth.substep_s
    pieces: list[Piece] = []
    if gear.motor_orders:
        pieces.append(_motor_orders(truth))
    if gear.flexspline_orders:
        pieces.append(MotorOrders(gear.flexspline_orders, 1.0 + 1.0 / gear.ratio))
    if gear.load_orders:
        pieces.append(LoadOrders(gear.load_orders))
    pieces += _hysteresis(truth)
    pieces += _zero_drift(truth)
    if gear.wear is not None:
        pieces.append(Wear(gear.wear, gear.ratio))
    if gear.ageing is not None and gear.ageing.motor_orders:
        pieces.append(WornTeeth(gear.ageing, dt_s))
    if gear.creep:
        pieces.append(Creep(gear.creep, dt_s))
    if gear.jumps:
        pieces.append(Jumps(gear.jumps, gear.teeth or 2.0 * gear.ratio, dt_s))
    if gear.damage:
        pieces.append(Damage(gear.damage))
    if gear.roller is not None:
        pieces.append(Roller(gear.roller))
    if gear.seat is not None:
        pieces.append(Seat(gear.seat))
    return pieces


def warmth_factor(truth: Truth, per_k: float) -> WarmthFactor | None:
    """Returns the factor for growth with temperature; None without growth."""
    return WarmthFactor(per_k, truth.temperature.unchanged_c) if per_k else None


def _motor_orders(truth: Truth) -> Piece:
    gear = truth.gear
    flank = gear.flank if gear.flank is not None and gear.flank.shift_deg else None
    warmth = warmth_factor(truth, truth.temperature.tooth_growth_per_k)
    factors = () if warmth is None else (warmth,)
    return MotorOrders(
        gear.motor_orders, flank=flank, growth_per_nm=gear.torque_growth_per_nm, factors=factors
    )


def _hysteresis(truth: Truth) -> list[Piece]:
    gear = truth.gear
    pieces: list[Piece] = []
    for each in (gear.hysteresis, gear.second_hysteresis):
        law = law_of(each, 0.0)
        if law is None:
            continue
        rate = SpeedFactor(gear.rate_dependence, truth.substep_s) if gear.rate_dependence else None
        warmth = warmth_factor(truth, truth.temperature.friction_growth_per_k)
        ageing = gear.ageing if gear.ageing is not None and gear.ageing.hysteresis_growth else None
        age = AgeFactor(ageing, truth.substep_s) if ageing is not None else None
        factors = tuple(factor for factor in (rate, warmth, age) if factor is not None)
        pieces.append(ElasticHysteresis(law, factors, gear.hysteresis_reaction))
    return pieces


def _zero_drift(truth: Truth) -> list[Piece]:
    heat = truth.temperature
    per_k = heat.zero_drift_arcsec_per_k
    if not per_k:
        return []
    if not heat.zero_time_constant_s:
        return [ZeroDrift(heat.ambient_c, per_k)]
    start_c = heat.ambient_c if heat.start_c is None else heat.start_c
    nearer = -math.expm1(-truth.substep_s / heat.zero_time_constant_s)
    return [SlowZeroDrift(heat.ambient_c, per_k, start_c, nearer)]


@state
class Gear:
    """Output of the gear before its spring, in degrees of the load."""

    def __init__(self, truth: Truth) -> None:
        pieces = pieces_of(truth)
        self._ratio = truth.gear.ratio
        self._pieces: tuple[Piece, ...] = tuple(pieces)
        self.by_motor_only: bool = all(piece.by_motor_only for piece in pieces)
        """True if the output cannot change while the motor is at rest."""

    def turned_deg(self, now: Conditions) -> float:
        """Returns the angle to which the output would turn an unloaded shaft."""
        error = now.slope_arcsec = 0.0
        for piece in self._pieces:
            error += piece.arcsec(now)
        return now.motor_deg / self._ratio + error / ARCSEC_PER_DEG
