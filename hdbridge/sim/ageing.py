"""Ageing: gradual changes in the gear over hours of work, linear from switch-on; see `hdbridge.sim.gear`.

Stiffening grease and settling preload change the hysteresis loop; wear of the teeth changes the tooth error.
Each object advances by one substep whenever it is evaluated.
"""

import math
from typing import ClassVar

from hdbridge.sim.orders import Orders
from hdbridge.sim.state import Conditions, state
from hdbridge.sim.truth.gear import TrueAgeing


@state
class Age:
    """Completed fraction of the ageing, which rises from 0 at switch-on to 1 and stays there."""

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._step = dt_s / truth.duration_s
        self._share = 0.0

    def grown(self) -> float:
        """Advances by one substep and returns the completed fraction."""
        self._share = min(1.0, self._share + self._step)
        return self._share


@state
class AgeFactor:
    """Factor that multiplies the elastic hysteresis and grows with age."""

    _age: Age

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._age = Age(truth, dt_s)
        self._growth = truth.hysteresis_growth

    def factor(self, now: Conditions) -> float:
        return 1.0 + self._growth * self._age.grown()


@state
class WornTeeth:
    """Additional tooth error, a function of the motor angle, that grows with age."""

    by_motor_only: ClassVar[bool] = False
    _age: Age
    _orders: Orders

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._age = Age(truth, dt_s)
        self._orders = Orders(truth.motor_orders)

    def arcsec(self, now: Conditions) -> float:
        share = self._age.grown()
        error, slope = self._orders.at(math.radians(now.motor_deg))
        now.slope_arcsec += share * slope
        return share * error
