"""Draft of a truth file, written effect by effect."""

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
    """Result of translating an effect: its place in the truth file, and notes on differences."""

    counterpart: str | None
    notes: tuple[str, ...] = ()


def none(why: str) -> Said:
    """Returns the result for an effect without a counterpart in the plant."""
    return Said(None, (why,))


@dataclass(slots=True)
class Draft:
    """Content of a truth file, `data`, which is changed in place."""

    data: dict[str, Any]
    axis: AxisConfig
    tells_servo: bool
    """True if the drive's feed-forward is set to the load that is written, as after commissioning."""

    @property
    def gear(self) -> dict[str, Any]:
        """The section ``gear``."""
        return self.part("gear")

    @property
    def load(self) -> dict[str, Any]:
        """The section ``load``."""
        return self.part("load")

    def part(self, *names: str) -> dict[str, Any]:
        """Returns a nested section; creates it if it is missing."""
        place = self.data
        for name in names:
            if place.get(name) is None:
                place[name] = {}
            place = place[name]
        return place

    @property
    def ratio(self) -> float:
        """Ratio of the axis file, to which the model's orders and travels refer."""
        return self.axis.gear.ratio

    @property
    def stiffness_nm_per_rad(self) -> float:
        """Stiffness of the spring's first stage."""
        return float(self.gear["stiffness_nm_per_rad"])

    def set_stiffness(self, nm_per_rad: float) -> None:
        """Sets the stiffness and keeps the damping ratio of the load."""
        self.gear["damping_nm_s_per_rad"] *= math.sqrt(nm_per_rad / self.stiffness_nm_per_rad)
        self.gear["stiffness_nm_per_rad"] = nm_per_rad

    @property
    def hanging_kg_m2(self) -> float:
        """Inertia of the hanging mass, which is not part of the load's own."""
        mass = self.load.get("gravity")
        return float(mass["mass_kg"] * mass["arm_m"] ** 2) if mass else 0.0

    @property
    def inertia_kg_m2(self) -> float:
        """Total inertia of the load."""
        return float(self.load["inertia_kg_m2"]) + self.hanging_kg_m2

    def set_inertia(self, kg_m2: float) -> None:
        """Sets the load's total inertia, more than the hanging mass's, and keeps the damping ratio."""
        self.gear["damping_nm_s_per_rad"] *= math.sqrt(kg_m2 / self.inertia_kg_m2)
        self.load["inertia_kg_m2"] = kg_m2 - self.hanging_kg_m2

    @property
    def highest_stiffness_nm_per_rad(self) -> float:
        """Maximum stiffness: half of the stiffest spring that the plant's shortest time step resolves."""
        return Resonance.of({**self.data, "load": {**self.load, "presliding": ()}}).stiffest_nm_per_rad(
            math.sqrt(0.5) / (SHORTEST_MS / 1e3)
        )

    @property
    def spare_stiffness_nm_per_rad(self) -> float:
        """Maximum stiffness of sliders at the load whose resonance the present time step resolves."""
        return Resonance.of(self.data).most_held_nm_per_rad(RESOLVED / (self.data["substep_ms"] / 1e3))

    def finish(self) -> None:
        """Sets the load feed-forward, and a time step that resolves the fastest resonance."""
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
"""Shortest time step; a whole fraction of a millisecond."""
RESOLVED = 0.98
"""Maximum phase of the fastest resonance in a time step, in radians; the truth file allows one."""
