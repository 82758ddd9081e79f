"""What hours of work change in the gear, evenly from when it is switched on; see `hdbridge.sim.gear`.

Grease that stiffens and preload that settles change the loop, teeth that wear change the tooth error. Each
piece is asked once per substep, in order of time.
"""

from __future__ import annotations

import math
from typing import ClassVar

from hdbridge.sim.conditions import Conditions
from hdbridge.sim.orders import Orders
from hdbridge.sim.state import state
from hdbridge.sim.truth.gear import TrueAgeing


@state
class Age:
    """Share of the ageing that is done: from 0 when the axis is switched on to 1, where it stays."""

    _share: float
    _step: float

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._step = dt_s / truth.duration_s
        self._share = 0.0

    def grown(self) -> float:
        """The share after one more substep."""
        self._share = min(1.0, self._share + self._step)
        return self._share


@state
class AgeFactor:
    """Growth of the elastic hysteresis."""

    _age: Age
    _growth: float

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._age = Age(truth, dt_s)
        self._growth = truth.hysteresis_growth

    def factor(self, now: Conditions) -> float:
        """The factor after one more substep."""
        return 1.0 + self._growth * self._age.grown()


@state
class WornTeeth:
    """Tooth error by the motor's angle that comes with wear."""

    BY_MOTOR_ONLY: ClassVar[bool] = False
    _age: Age
    _orders: Orders

    def __init__(self, truth: TrueAgeing, dt_s: float) -> None:
        self._age = Age(truth, dt_s)
        self._orders = Orders(truth.motor_orders)

    def arcsec(self, now: Conditions) -> float:
        """See `gear.Piece`."""
        return self._age.grown() * self._orders.at(math.radians(now.motor_deg))
