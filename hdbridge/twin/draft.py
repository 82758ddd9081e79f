"""A truth file that is being written, effect by effect."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from hdbridge.axis import AxisConfig
from hdbridge.sim.truth.resonance import Resonance
from hdbridge.units import ARCSEC_PER_DEG

ARCSEC_PER_RAD = math.degrees(1.0) * ARCSEC_PER_DEG


@dataclass(frozen=True, slots=True)
class Said:
    """What became of an effect: where it went, and what is different there."""

    counterpart: str | None
    notes: tuple[str, ...] = ()


def none(why: str) -> Said:
    """The plant has no counterpart."""
    return Said(None, (why,))


@dataclass(slots=True)
class Draft:
    """The content of a truth file, `data`, to be changed in place."""

    data: dict[str, Any]
    axis: AxisConfig
    tells_servo: bool
    """Whether the drive's feed-forward follows the load that is written (it was commissioned for it)."""

    @property
    def gear(self) -> dict[str, Any]:
        """The section ``gear``."""
        return self.part("gear")

    @property
    def load(self) -> dict[str, Any]:
        """The section ``load``."""
        return self.part("load")

    def part(self, *names: str) -> dict[str, Any]:
        """A section of a section; made where it is not there."""
        place = self.data
        for name in names:
            if place.get(name) is None:
                place[name] = {}
            place = place[name]
        return place

    @property
    def ratio(self) -> float:
        """N of the axis file, which the model's orders and travels are told by."""
        return self.axis.gear.ratio

    @property
    def stiffness_nm_per_rad(self) -> float:
        """The spring's first stage."""
        return float(self.gear["stiffness_nm_per_rad"])

    def set_stiffness(self, nm_per_rad: float) -> None:
        """Another spring; the damping ratio of the load on it stays."""
        self.gear["damping_nm_s_per_rad"] *= math.sqrt(nm_per_rad / self.stiffness_nm_per_rad)
        self.gear["stiffness_nm_per_rad"] = nm_per_rad

    @property
    def hanging_kg_m2(self) -> float:
        """Inertia of the mass on the axis, which is not the load's own."""
        mass = self.load.get("gravity")
        return float(mass["mass_kg"] * mass["arm_m"] ** 2) if mass else 0.0

    @property
    def inertia_kg_m2(self) -> float:
        """The load's whole inertia."""
        return float(self.load["inertia_kg_m2"]) + self.hanging_kg_m2

    def set_inertia(self, kg_m2: float) -> None:
        """Another whole inertia of the load; its damping ratio stays. It is more than the hanging mass's."""
        self.gear["damping_nm_s_per_rad"] *= math.sqrt(kg_m2 / self.inertia_kg_m2)
        self.load["inertia_kg_m2"] = kg_m2 - self.hanging_kg_m2

    @property
    def highest_stiffness_nm_per_rad(self) -> float:
        """The stiffest spring that the plant's shortest time step resolves, with half of that to spare."""
        return Resonance.of({**self.data, "load": {**self.load, "presliding": ()}}).stiffest_nm_per_rad(
            math.sqrt(0.5) / (SHORTEST_MS / 1e3)
        )

    @property
    def spare_stiffness_nm_per_rad(self) -> float:
        """How stiff sliders may hold the load, for its resonance to be resolved by the present time step."""
        return Resonance.of(self.data).most_held_nm_per_rad(RESOLVED / (self.data["substep_ms"] / 1e3))

    def finish(self) -> None:
        """Tell the drive of its load, and let the time step resolve the resonance."""
        servo, load = self.data["servo"], self.inertia_kg_m2
        if self.tells_servo and servo.get("load_feedforward"):
            turn = math.sqrt(self.stiffness_nm_per_rad / load)
            servo["load_feedforward"] = {
                "inertia_kg_m2": load / self.ratio**2,
                "frequency_hz": min(500.0, max(1.0, turn / math.tau)),
                "damping_ratio": min(2.0, self.gear["damping_nm_s_per_rad"] / (2.0 * load * turn)),
            }
        fastest = Resonance.of(self.data).rad_s
        while fastest * self.data["substep_ms"] / 1e3 > RESOLVED and self.data["substep_ms"] > SHORTEST_MS:
            self.data["substep_ms"] = max(SHORTEST_MS, 0.5 * self.data["substep_ms"])


SHORTEST_MS = 0.0625
"""The shortest step that is taken, of those that go evenly into a millisecond."""
RESOLVED = 0.98
"""Radians of the fastest resonance within a step; the truth file allows one."""
