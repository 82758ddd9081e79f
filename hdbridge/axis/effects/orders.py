"""Harmonic series over an angle proportional to the motor angle: common base of all order effects."""

import cmath
import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, ClassVar, Final, Self, TypeVar, cast

import numpy as np
from pydantic import Field, field_validator

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.described import Coefficient, Memoryless, Observations, Stretch, Tracker
from hdbridge.axis.effects.motion import FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.path import away_from_reversals, once
from hdbridge.strictness import Strict

RAD_PER_DEG = math.pi / 180.0
HIGHEST_MOTOR_ORDER: Final = 24
"""Highest candidate motor order: six times order 4, the strongest of a strain wave gear (two contacts), so
that the harmonics of encoders and bearings are included."""
_ComplexArray = np.ndarray[tuple[int], np.dtype[np.complex128]]
_AT_ONCE: Final = 1 << 14
"""Number of samples processed at once, so that their powers fit in the processor's cache."""
_Phasor = TypeVar("_Phasor", complex, _ComplexArray)


class MotorOrder(Strict):
    """One harmonic: amplitude * cos(order * angle + phase)."""

    order: int = Field(ge=1, le=1000, description="periods per turn")
    amplitude_arcsec: float = Field(ge=0, le=3600, description="amplitude at the load")
    phase_deg: float = Field(ge=-360, le=360, description="phase of the cosine")


Orders = Annotated[
    tuple[MotorOrder, ...], Field(description="harmonics: order, amplitude_arcsec, phase_deg each")
]


class HarmonicSum(Effect):
    """Sum of A_k cos(k angle + phi_k) over an angle that a subclass defines."""

    few: ClassVar[frozenset[int]] = frozenset()
    """Permitted orders, if only a few are physically possible; empty if all are permitted."""

    orders: Orders

    @field_validator("orders")
    @classmethod
    def _distinct(cls, orders: tuple[MotorOrder, ...]) -> tuple[MotorOrder, ...]:
        numbers = [each.order for each in orders]
        if len(set(numbers)) != len(numbers):
            raise ValueError("each order may appear only once")
        if cls.few and not cls.few.issuperset(numbers):
            raise ValueError(f"only orders {', '.join(map(str, sorted(cls.few)))} are of this cause")
        return orders

    @abstractmethod
    def _angle(self, motion: Motion) -> FloatArray:
        """Returns the phase angle of order 1, radians, shape (n,)."""

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        error: FloatArray = horner(phasors(self.orders), turn_of(self._angle(motion))).real
        return error

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the cosine and sine of each order, shape (n, 2 * orders)."""
        return cosines_and_sines(self._angle(motion), [each.order for each in self.orders])

    def coefficients(self) -> FloatArray:
        """Returns A cos(phi) and -A sin(phi) of each order, arcsec."""
        return coefficients_of(self.orders)

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        """Returns the same orders with amplitudes and phases from cosine and sine coefficients."""
        return self.model_copy(
            update={"orders": orders_fitted(self.orders, coefficients), **dict(shape or {})}
        )

    def bound_arcsec(self) -> float:
        return sum(each.amplitude_arcsec for each in self.orders)

    def shows(self, motion: Motion) -> Stretch | None:
        """Returns the samples away from reversals, where a misfit of the loop's shape leaves no waves."""
        return away_from_reversals(motion)

    def largest_piece_arcsec(self) -> float:
        """Returns the largest amplitude, because a record over part of a period shows only part of it."""
        return max((each.amplitude_arcsec for each in self.orders), default=0.0)

    def named_coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(
            Coefficient(f"order_{each.order}_", (2 * i, 2 * i + 1), ("orders", i))
            for i, each in enumerate(self.orders)
        )


class OrderSeries(HarmonicSum):
    """Harmonic sum over an angle that is c times the motor angle."""

    usual = 2
    searched: ClassVar[Sequence[int]] = ()
    """Orders that are proposed for a record, each as a separate candidate."""

    def turns_per_motor_turn(self) -> float:
        """Returns c, the number of periods of order 1 per motor turn."""
        return 1.0

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields single orders that the model lacks; those found are combined later."""
        values = {"ratio": observations.ratio} if "ratio" in cls.model_fields else {}
        turns = cls(orders=(), **values).turns_per_motor_turn()
        present = _present(base, turns)
        yield from (cls(orders=orders_from([each]), **values) for each in cls.searched if each not in present)

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return OrderTracker(phasors(self.orders), RAD_PER_DEG * self.turns_per_motor_turn())

    def slope_bound_arcsec_per_deg(self) -> float:
        steepest = sum(each.order * each.amplitude_arcsec for each in self.orders)
        return RAD_PER_DEG * self.turns_per_motor_turn() * steepest

    def pieces(self) -> tuple[Self, ...]:
        return tuple(self.model_copy(update={"orders": (each,)}) for each in self.orders)

    def joined(self, other: Effect) -> Self | None:
        if other.name != self.name or not isinstance(other, OrderSeries):
            return None
        own = {each.order for each in self.orders}
        new = [each for each in other.orders if each.order not in own]
        orders = tuple(sorted((*self.orders, *new), key=lambda each: each.order))
        return self.model_copy(update={"orders": orders})

    def waves(self) -> tuple[tuple[float, float, float], ...]:
        turns = self.turns_per_motor_turn()
        return tuple((each.order * turns, each.amplitude_arcsec, each.phase_deg) for each in self.orders)

    def tidied(self, ratio: float) -> Self:
        """Removes orders of zero amplitude, whose phases are meaningless."""
        orders = tuple(each for each in self.orders if each.amplitude_arcsec > 1e-6)
        return self.model_copy(update={"orders": orders})

    @classmethod
    def _change(cls, before: Effect, now: Effect) -> Self | None:
        """Returns the difference between two series of motor orders as an effect of this kind.

        Returns None if the two are not series of the same orders, or if this kind does not permit these
        orders.
        """
        if not isinstance(before, OrderSeries) or not isinstance(now, type(before)):
            return None
        numbers = [each.order for each in before.orders]
        if numbers != [each.order for each in now.orders] or (cls.few and not cls.few.issuperset(numbers)):
            return None
        change = orders_fitted(before.orders, now.coefficients() - before.coefficients())
        return cast("Self", cls.model_construct(orders=change))

    def _angle(self, motion: Motion) -> FloatArray:
        return RAD_PER_DEG * self.turns_per_motor_turn() * motion.motor_deg


def _present(base: Iterable[Effect], turns_per_motor_turn: float) -> dict[int, MotorOrder]:
    """Returns the model's orders over the angle with these turns per motor turn, by number."""
    series = [each for each in base if isinstance(each, OrderSeries)]
    return {
        order.order: order
        for each in series
        if each.turns_per_motor_turn() == turns_per_motor_turn
        for order in each.orders
    }


def orders_from(numbers: Iterable[int], amplitude_arcsec: float = 1.0) -> tuple[MotorOrder, ...]:
    """Returns harmonics of equal amplitude and zero phase, as initial values of a fit."""
    return tuple(MotorOrder(order=each, amplitude_arcsec=amplitude_arcsec, phase_deg=0.0) for each in numbers)


def cosines_and_sines(angle_rad: FloatArray, numbers: Sequence[int]) -> FloatArray:
    """Returns columns cos(k angle), sin(k angle) for each k, shape (n, 2 * len(numbers))."""
    result = np.empty((2 * len(numbers), len(angle_rad))).T
    for first in range(0, len(angle_rad), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        for at, wave in enumerate(waves(angle_rad[rows], numbers)):
            result[rows, 2 * at], result[rows, 2 * at + 1] = wave.real, wave.imag
    return result


def waves(angle_rad: FloatArray, numbers: Iterable[float]) -> Iterator[_ComplexArray]:
    """Yields exp(j k angle), shape (n,), for each k.

    For integer k it is computed as a power of exp(j angle), because a multiplication is several times faster
    than a cosine and a sine.
    """
    turn = turn_of(angle_rad)
    power, before = None, 0
    for number in numbers:
        if number == int(number):
            step, before = int(number) - before, int(number)
            factor = turn if step == 1 else turn**step
            power = factor if power is None else power * factor
            yield power
        else:
            yield turn_of(number * angle_rad)


def coefficients_of(orders: Iterable[MotorOrder]) -> FloatArray:
    """Returns A cos(phi) and -A sin(phi) of each order, in the order of `cosines_and_sines`."""
    pairs = [
        (each.amplitude_arcsec * math.cos(phase), -each.amplitude_arcsec * math.sin(phase))
        for each in orders
        for phase in [math.radians(each.phase_deg)]
    ]
    return np.array(pairs, dtype=np.float64).reshape(-1)


def orders_fitted(orders: Sequence[MotorOrder], coefficients: FloatArray) -> tuple[MotorOrder, ...]:
    """Returns the same orders with amplitudes and phases from cosine and sine coefficients."""
    pairs = np.asarray(coefficients, dtype=np.float64).reshape(len(orders), 2)
    return tuple(
        MotorOrder.model_construct(  # not validated: a fit may leave the range (`violations`)
            order=each.order,
            amplitude_arcsec=math.hypot(cosine, sine),
            phase_deg=math.degrees(math.atan2(-sine, cosine)),
        )
        for each, (cosine, sine) in zip(orders, pairs.tolist(), strict=True)
    )


def phasors(orders: Iterable[MotorOrder]) -> tuple[complex, ...]:
    """Returns the complex amplitudes from the highest order down to order 0, for `horner`."""
    given = {each.order: cmath.rect(each.amplitude_arcsec, math.radians(each.phase_deg)) for each in orders}
    return tuple(given.get(order, 0j) for order in range(max(given, default=0), -1, -1))


def ripple(motor_deg: FloatArray, amplitudes: tuple[complex, ...]) -> FloatArray:
    """Returns the sum of motor orders, arcsec, shape (n,); ``amplitudes`` is a result of `phasors`."""

    def make() -> FloatArray:
        return np.ascontiguousarray(horner(amplitudes, turn_of(RAD_PER_DEG * motor_deg)).real)

    return once(motor_deg, Start.VIRGIN, amplitudes, make)


def turn_of(angle_rad: FloatArray) -> _ComplexArray:
    """Returns exp(j angle), shape (n,), from cosine and sine; numpy's complex exponential is much slower."""
    result = np.empty(len(angle_rad), dtype=np.complex128)
    np.cos(angle_rad, out=result.real)
    np.sin(angle_rad, out=result.imag)
    return result


def horner(amplitudes: tuple[complex, ...], turn: _Phasor) -> _Phasor:
    """Evaluates the polynomial in ``turn`` = exp(j theta), for one angle or for a whole record.

    In the control loop, one exponential and a few multiplications per order are several times faster than a
    cosine per order.
    """
    total = 0.0 * turn
    for amplitude in amplitudes:
        total = total * turn + amplitude
    return total


def compensated_orders(effects: Iterable[Effect]) -> list[MotorOrder]:
    """Returns the motor orders that a compensation corrects, in ascending order."""
    found = _present((each for each in effects if each.is_compensable()), 1.0)
    return [found[number] for number in sorted(found)]


class OrderTracker(Memoryless):
    """On-line tracker of a harmonic series; ``scale`` is the phase of order 1, radians per motor degree."""

    def __init__(self, amplitudes: tuple[complex, ...], scale: float = RAD_PER_DEG) -> None:
        self._highest, *self._lower = amplitudes
        self._scale = scale

    def peek(self, motor_deg: float, moment: Moment) -> float:
        # `horner` is inlined, because this method is called several times in each control cycle.
        turn = cmath.rect(1.0, self._scale * motor_deg)
        total = self._highest
        for amplitude in self._lower:
            total = total * turn + amplitude
        return total.real
