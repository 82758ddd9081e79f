"""The fastest resonance of the simulated axis, which its time step has to resolve."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class Resonance:
    """The load between the gear's spring and sliders that hold it, the motor at the other end."""

    stiffness_nm_per_rad: float
    """The gear's spring where it is stiffest."""
    held_nm_per_rad: float
    """Sliders on the load before they slip."""
    inertia_kg_m2: float
    """The load's own, without the mass that hangs on it: that may be taken off."""
    reflected_kg_m2: float
    """The motor's, seen from the load."""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """That of a truth file's content."""
        gear, load = data["gear"], data["load"]
        later = gear.get("stiffening") or {}
        stages = (later.get(f"{stage}_stiffness_nm_per_rad", 0.0) for stage in ("second", "third"))
        sliders = load.get("presliding") or ()
        return cls(
            max(gear["stiffness_nm_per_rad"], *stages),
            sum(each["limit_nm"] / math.radians(each["travel_deg"]) for each in sliders),
            load["inertia_kg_m2"],
            data["motor"]["inertia_kg_m2"] * gear["ratio"] ** 2,
        )

    @property
    def rad_s(self) -> float:
        """How fast it is."""
        held = (self.stiffness_nm_per_rad + self.held_nm_per_rad) / self.inertia_kg_m2
        return math.sqrt(held + self.stiffness_nm_per_rad / self.reflected_kg_m2)

    def stiffest_nm_per_rad(self, rad_s: float) -> float:
        """The spring with which it would be so fast, the sliders as they are; not positive where they are."""
        left = rad_s**2 - self.held_nm_per_rad / self.inertia_kg_m2
        return left / (1.0 / self.inertia_kg_m2 + 1.0 / self.reflected_kg_m2)

    def most_held_nm_per_rad(self, rad_s: float) -> float:
        """The sliders with which it would be so fast, the spring as it is."""
        share = 1.0 + self.inertia_kg_m2 / self.reflected_kg_m2
        return self.inertia_kg_m2 * rad_s**2 - self.stiffness_nm_per_rad * share
