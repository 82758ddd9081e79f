"""Data for injecting a hidden cause: axis, intended run, wanted size and random generator."""

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
    """Properties of a bench run that determine the sizes of causes."""

    duration_s: float = 600.0
    load_speed_deg_s: float = 10.0
    """Highest constant speed of the load."""
    load_acceleration_deg_s2: float = 50.0
    """Highest acceleration of the load."""
    motor_turns: float = 400.0
    """Total travel of the motor, both directions added."""
    load_reach_deg: tuple[float, float] = (-360.0, 360.0)
    """Range of the load angle."""


@dataclass(frozen=True)
class Hidden:
    """Description of a hidden cause."""

    cause: str
    size_arcsec: float
    size_is: str
    """Definition of the size, in words."""
    text: str
    """Change of the axis, in one line."""
    parameters: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Parameters to compare a finding with; names include their units."""
    brings: tuple[str, ...] = ()
    """Causes that this cause necessarily implies; these are right findings, too."""


@dataclass
class Site:
    """Axis into which a cause is injected; ``data`` is the content of its truth file, which changes."""

    truth: Truth
    rng: random.Random
    size_arcsec: float
    run: Run
    data: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        self.data = self.truth.model_dump(by_alias=True)

    @property
    def gear(self) -> dict[str, Any]:
        """Section ``gear``."""
        return self.part("gear")

    @property
    def load(self) -> dict[str, Any]:
        """Section ``load``."""
        return self.part("load")

    def part(self, *names: str) -> dict[str, Any]:
        """Returns a nested section."""
        place = self.data
        for name in names:
            place = place[name]
        return place

    def uniform(self, low: float, high: float) -> float:
        """Draws a number from a uniform distribution."""
        return self.rng.uniform(low, high)

    def stretched(self, low: float, high: float) -> float:
        """Draws a number whose logarithm is uniformly distributed."""
        return math.exp(self.rng.uniform(math.log(low), math.log(high)))

    def angle_deg(self) -> float:
        """Draws an angle from -180 to 180 deg."""
        return self.rng.uniform(-180.0, 180.0)

    def sign(self) -> float:
        """Draws plus or minus one."""
        return self.rng.choice((1.0, -1.0))

    def load_angle_deg(self) -> float:
        """Draws a load angle from the middle 80 % of the run's range."""
        low, high = self.run.load_reach_deg
        return self.rng.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low))

    def tooth_peak_arcsec(self, shift_deg: float | None = None) -> float:
        """Returns the peak of the tooth error over the motor angle, or of its change by a shift, arcsec."""
        orders = Orders(self.truth.gear.motor_orders)
        if not self.truth.gear.motor_orders:
            raise ValueError("this axis has no tooth error by motor angle")
        if shift_deg is None:
            return max(abs(orders.at(math.radians(each))[0]) for each in range(360))
        off = math.radians(shift_deg)
        return max(
            abs(orders.at(math.radians(each) + off)[0] - orders.at(math.radians(each))[0])
            for each in range(360)
        )


def solve(of: Callable[[float], float], goal: float, low: float, high: float) -> float:
    """Returns the argument at which an increasing function reaches a goal, by bisection, within the range."""
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
