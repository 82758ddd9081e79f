"""Where a cause is hidden: the axis, the run that is meant, the wanted size, and the source of chance."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from hdbridge.sim.orders import Orders
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG

ARCSEC_PER_TURN = 360.0 * ARCSEC_PER_DEG
ARCSEC_PER_RAD = math.degrees(1.0) * ARCSEC_PER_DEG


@dataclass(frozen=True)
class Run:
    """What a bench will do with the axis, as far as a size depends on it."""

    duration_s: float = 600.0
    load_speed_deg_s: float = 10.0
    """The fastest even motion, of the load."""
    load_acceleration_deg_s2: float = 50.0
    """The highest acceleration, of the load."""
    motor_turns: float = 400.0
    """Way of the motor, both directions added up."""
    load_reach_deg: tuple[float, float] = (-360.0, 360.0)
    """Load angles that are passed."""


@dataclass(frozen=True)
class Hidden:
    """What was hidden."""

    cause: str
    size_arcsec: float
    size_is: str
    """What the size is, in words."""
    text: str
    """What was done to the axis, in one line."""
    parameters: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Numbers of it that a finding may be compared with; names carry their units."""
    brings: tuple[str, ...] = ()
    """Other causes that it cannot be without, and that it is right to find too."""


@dataclass
class Site:
    """An axis in which a cause is being hidden; ``data`` is its truth file, to be changed."""

    truth: Truth
    rng: random.Random
    size_arcsec: float
    run: Run
    data: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        self.data = self.truth.model_dump(by_alias=True)

    @property
    def gear(self) -> dict[str, Any]:
        """The section ``gear``."""
        return self.part("gear")

    @property
    def load(self) -> dict[str, Any]:
        """The section ``load``."""
        return self.part("load")

    def part(self, *names: str) -> dict[str, Any]:
        """A section of a section."""
        place = self.data
        for name in names:
            place = place[name]
        return place

    def uniform(self, low: float, high: float) -> float:
        """A number between two, evenly."""
        return self.rng.uniform(low, high)

    def stretched(self, low: float, high: float) -> float:
        """A number between two, evenly by its logarithm."""
        return math.exp(self.rng.uniform(math.log(low), math.log(high)))

    def angle_deg(self) -> float:
        """Any angle."""
        return self.rng.uniform(-180.0, 180.0)

    def sign(self) -> float:
        """Plus or minus one."""
        return self.rng.choice((1.0, -1.0))

    def load_angle_deg(self) -> float:
        """An angle of the load well within the run's reach."""
        low, high = self.run.load_reach_deg
        return self.rng.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low))

    def tooth_peak_arcsec(self, shift_deg: float | None = None) -> float:
        """Peak of the tooth error by motor angle, or of how far it changes with a shift of that angle."""
        orders = Orders(self.truth.gear.motor_orders)
        if not self.truth.gear.motor_orders:
            raise ValueError("this axis has no tooth error by motor angle")
        if shift_deg is None:
            return max(abs(orders.at(math.radians(each))) for each in range(360))
        off = math.radians(shift_deg)
        return max(
            abs(orders.at(math.radians(each) + off) - orders.at(math.radians(each))) for each in range(360)
        )


def solve(of: Callable[[float], float], goal: float, low: float, high: float) -> float:
    """Where a function that grows reaches a goal, by bisection; an end if it does not within the range."""
    if of(high) <= goal:
        return high
    if of(low) >= goal:
        return low
    for _ in range(60):
        middle = 0.5 * (low + high)
        if of(middle) < goal:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
