"""Temperature dependence of ripple and friction.

A ripple and a loop that grow with temperature can be expressed relative to any reference temperature, with
different amplitudes and growth but the same sum. The reference is chosen so that the amplitudes are those of
the model. With any other reference, the drift would be accompanied by an apparent change of the model's own
orders or loop.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from pydantic import Field

from hdbridge.axis.effects.base import Effect
from hdbridge.axis.effects.carried import Loop, Modulating, has_loop, has_orders, loop_of, orders_of
from hdbridge.axis.effects.described import Cause, Compensable, Observations, Part, Tracker
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.hysteresis_memory import HysteresisMemory
from hdbridge.axis.effects.motion import Channel, FloatArray, Moment, Motion, Start
from hdbridge.axis.effects.motor_order import MotorOrders
from hdbridge.axis.effects.orders import (
    RAD_PER_DEG,
    MotorOrder,
    Orders,
    OrderTracker,
    coefficients_of,
    phasors,
    ripple,
)
from hdbridge.axis.effects.rate_dependence import RateDependence
from hdbridge.axis.effects.synchronous import Synchronous
from hdbridge.axis.effects.torque import TorqueGrowth
from hdbridge.axis.effects.warmth import Warmed, WarmthTracker

REACH_K: Final = 30.0
"""Maximum difference between the reference temperature and the temperature range of the record, K."""


@dataclass(frozen=True, slots=True)
class Reparametrised:
    """A model expressed relative to a different reference temperature."""

    warmer_k: float
    """New reference temperature minus the former one, K."""
    orders: FloatArray
    """Cosine and sine coefficients of the orders, arcsec."""
    offsets: FloatArray
    """Offsets of the model's loops, arcsec."""
    per_ripple: float
    per_loop: float
    """Factors that convert growth relative to the former ripple or loop to growth relative to the new one."""

    def counted(self, effect: Effect) -> Effect:
        """Converts the parameters of an effect to the new reference temperature, if they depend on it.

        Only ripple, loop and growth of the loop with speed depend on it; all others are returned unchanged.
        """
        if isinstance(effect, Synchronous):
            return effect.fitted(self.orders)
        if isinstance(effect, Hysteresis | HysteresisMemory):
            return effect.model_copy(update={"offset_arcsec": float(self.offsets[0])})
        if isinstance(effect, RateDependence):
            return effect.model_copy(update={"growth_percent": effect.growth_percent * self.per_loop})
        return effect


def nearest(
    carried: Iterable[MotorOrder],
    loop: Loop,
    growth_percent: tuple[float, float],
    now: Sequence[Effect],
    given: Sequence[Effect],
) -> Reparametrised | None:
    """Expresses ``now`` relative to the reference temperature that brings it closest to ``given``.

    ``growth_percent`` is the growth of ripple and of loop per kelvin. Returns None if this is impossible.
    """
    numbers = {order.order for each in now if isinstance(each, Synchronous) for order in each.orders}
    # Growth refers to the carried orders. Before convergence they may differ from the model's orders.
    ripple = coefficients_of(each for each in carried if each.order in numbers)
    loops = np.full(len(_offsets(now)), loop.offset_arcsec)
    if len(ripple) != len(_orders(now)):
        return None
    growth = 0.01 * np.concatenate([growth_percent[0] * ripple, growth_percent[1] * loops])
    if not np.any(growth):
        return None
    change = np.concatenate([_orders(given) - _orders(now), _offsets(given) - _offsets(now)])
    warmer_k = float(change @ growth) / float(growth @ growth)
    orders = _orders(now) + warmer_k * growth[: len(ripple)]
    offsets = _offsets(now) + warmer_k * growth[len(ripple) :]
    return Reparametrised(warmer_k, orders, offsets, _ratio(ripple, orders), _ratio(loops, offsets))


def _ratio(former: FloatArray, present: FloatArray) -> float:
    return float(np.linalg.norm(former)) / max(float(np.linalg.norm(present)), 1e-9) if len(former) else 1.0


def _orders(base: Sequence[Effect]) -> FloatArray:
    given = [coefficients_of(each.orders) for each in base if isinstance(each, Synchronous)]
    return np.concatenate(given) if given else np.empty(0)


def _offsets(base: Sequence[Effect]) -> FloatArray:
    return np.array([each.offset_arcsec for each in base if isinstance(each, Hysteresis | HysteresisMemory)])


class AmplitudeDrift(Modulating, Warmed):
    """w (ripple S(theta_M) + friction H): the model's ripple and loop change with the gear's warmth w.

    The torque-dependent part of the ripple is scaled too, so its relative growth with torque does not depend
    on warmth.
    """

    name = "amplitude_drift"
    about = Cause(
        title="ripple and friction change with temperature",
        subject="drift",
        equation="w (ripple S + friction H), S the model's orders (times 1 + growth tau if they grow with "
        "torque), H its loop, w the gear's warmth as in zero_drift",
        signature="the ripple within a motor turn, or the height of the loop, follows the temperature",
        consequence="a compensation calibrated warm is wrong in the cold",
        remedy="warm up before work; calibrate at working temperature; compensate it with a temperature "
        "sensor",
        experiment="the same sweeps both ways cold, warming up and warm, at one load",
        aliases=("torque_modulation", "wear", "hysteresis_parameters"),
        source="first-order dependence on temperature with a first-order lag",
        size="10-30 % over the warm-up",
    )
    compensable = Compensable(
        True, "if the temperature is measured on line; driven by time only after a cold start"
    )
    carries = {
        Part.ORDERS: "orders",
        Part.LOOP: "loop",
        Part.GROWTH: "under_load",
    }
    linear = ("ripple_percent_per_k", "friction_percent_per_k")
    typical = {
        "ripple_percent_per_k": 0.5,
        "friction_percent_per_k": -0.5,
        "tau_s": 1800.0,
    }

    orders: Orders
    loop: Loop = Field(description="the model's loop")
    under_load: TorqueGrowth | None = Field(
        None, description="growth of the model's orders with torque (torque_modulation)"
    )
    ripple_percent_per_k: float = Field(ge=-10, le=10, description="growth of the orders per kelvin")
    friction_percent_per_k: float = Field(ge=-10, le=10, description="growth of the loop per kelvin")

    @classmethod
    def proposals(cls, observations: Observations, base: Sequence[Effect]) -> Iterator[Self]:
        """Yields effects that depend on temperature if it varies in the record, else on time."""
        if has_orders(base) and has_loop(base):
            for driven_by, tau_s in cls.lags(observations):
                yield cls(
                    orders=orders_of(base), loop=loop_of(base), ripple_percent_per_k=1.0,
                    friction_percent_per_k=1.0, tau_s=tau_s, driven_by=driven_by,
                )  # fmt: skip

    def scales(self) -> tuple[Part, Effect]:
        """Returns the part with the larger change in arcsec: the loop or the ripple."""
        ripple = math.sqrt(0.5 * sum(each.amplitude_arcsec**2 for each in self.orders))
        friction = abs(self.friction_percent_per_k * self.loop.offset_arcsec)
        if abs(self.ripple_percent_per_k) * ripple <= friction:
            return Part.LOOP, self.loop.law()
        return Part.ORDERS, MotorOrders(orders=self.orders)

    def reparametrised(
        self, now: Sequence[Effect], given: Sequence[Effect], observations: Observations
    ) -> tuple[Effect, ...] | None:
        """Expresses the drift relative to the temperature that brings the model closest to ``given``."""
        temperature = observations.motion.measured.get(Channel.TEMPERATURE)
        if temperature is None or self.driven_by != "temperature":
            return None
        coldest, hottest = float(np.min(temperature)) - REACH_K, float(np.max(temperature)) + REACH_K
        growth = (self.ripple_percent_per_k, self.friction_percent_per_k)
        moved = nearest(self.orders, self.loop, growth, now[: len(given)], given)
        if moved is None or not coldest <= self.reference_c + moved.warmer_k <= hottest:
            return None
        return tuple(
            each._counted(moved) if isinstance(each, AmplitudeDrift) else moved.counted(each) for each in now
        )

    def _counted(self, moved: Reparametrised) -> Self:
        return self.model_copy(
            update={
                "ripple_percent_per_k": self.ripple_percent_per_k * moved.per_ripple,
                "friction_percent_per_k": self.friction_percent_per_k * moved.per_loop,
                "reference_c": round(self.reference_c + moved.warmer_k, 1),
            }
        )

    def needs(self) -> frozenset[Channel]:
        """Returns the channels that determine warmth; also the torque channel if orders grow with torque."""
        load = self.under_load
        return super().needs() | (frozenset() if load is None else {Channel(load.torque)})

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        """Returns the error for a growth of 1 % per kelvin, of the ripple and of the loop, shape (n, 2)."""
        orders = ripple(motion.motor_deg, phasors(self.orders))
        if self.under_load is not None:
            orders = orders * self.under_load.factor(motion, self.name)
        parts = np.column_stack([orders, self.loop.law().predict(motion, start)])
        columns: FloatArray = 0.01 * self.warmth(motion)[:, np.newaxis] * parts
        return columns

    def tracker(self, start: Start = Start.VIRGIN) -> Tracker:
        return _Tracker(self, self.loop.law().tracker(start))

    def gentle_tracker(self, start: Start, fall_arcsec_per_deg: float) -> Tracker | None:
        """Returns a tracker whose total fall at the highest warmth is at most ``fall_arcsec_per_deg``.

        Returns None if the effect does not change the loop, if the load leads, or if the ripple alone exceeds
        the limit.
        """
        left = fall_arcsec_per_deg - self.ripple_fall()
        if not self.loop_share() or left <= 0.0:
            return None
        loop = self.loop.law().gentle_tracker(start, left / self.loop_share())
        return None if loop is None else _Tracker(self, loop)

    def bound_arcsec(self) -> float:
        ripple = abs(self.ripple_percent_per_k) * sum(each.amplitude_arcsec for each in self.orders)
        ripple *= self._most()
        return 0.01 * self.limit_k * (ripple + abs(self.friction_percent_per_k * self.loop.offset_arcsec))

    def slope_bound_arcsec_per_deg(self) -> float:
        """Returns the steepest negative ripple slope, arcsec per motor degree; infinity if the loop changes.

        A reduction of the loop falls as steeply as the loop rises. It removes only a fraction of the model's
        loop, so the sum of both does not fall (`combine.fall_bound`).
        """
        return self.ripple_fall() if not self.friction_percent_per_k else math.inf

    def ripple_fall(self) -> float:
        """Returns the steepest negative slope of the ripple alone, arcsec per motor degree."""
        slope = sum(each.order * each.amplitude_arcsec for each in self.orders)
        return 0.01 * self.limit_k * RAD_PER_DEG * abs(self.ripple_percent_per_k) * slope * self._most()

    def loop_share(self) -> float:
        """Returns the largest change that the effect can make to the loop, as a fraction of the loop."""
        return 0.01 * abs(self.friction_percent_per_k) * self.limit_k

    def _most(self) -> float:
        return 1.0 if self.under_load is None else 1.0 + self.under_load.most()


class _Tracker(Tracker):
    def __init__(self, effect: AmplitudeDrift, loop: Tracker) -> None:
        self._orders = OrderTracker(phasors(effect.orders))
        self._load = effect.under_load
        self._loop = loop
        self._ripple = 0.01 * effect.ripple_percent_per_k
        self._friction = 0.01 * effect.friction_percent_per_k
        self._warmth = WarmthTracker(effect)

    @property
    def memory_deg(self) -> float:
        return self._loop.memory_deg

    def peek(self, motor_deg: float, moment: Moment) -> float:
        friction = self._friction * self._loop.peek(motor_deg, moment)
        return self._warmth.peek(motor_deg, moment) * (self._ripple_at(motor_deg, moment) + friction)

    def advance(self, motor_deg: float, moment: Moment) -> float:
        friction = self._friction * self._loop.advance(motor_deg, moment)
        return self._warmth.advance(motor_deg, moment) * (self._ripple_at(motor_deg, moment) + friction)

    def _ripple_at(self, motor_deg: float, moment: Moment) -> float:
        ripple = self._ripple * self._orders.peek(motor_deg, moment)
        return ripple if self._load is None else ripple * self._load.factor_at(moment)
