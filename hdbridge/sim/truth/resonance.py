"""Fastest resonance of the simulated axis, which its time step must resolve."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class Resonance:
    """Resonance of the load, between the sliders that hold it and the gear's spring to the motor."""

    stiffness_nm_per_rad: float
    """Stiffness of the gear's spring at its stiffest stage."""
    held_nm_per_rad: float
    """Stiffness of the sliders on the load before they slip."""
    inertia_kg_m2: float
    """Inertia of the load without the mass on it, because that mass may be removed."""
    reflected_kg_m2: float
    """Inertia of the motor, seen from the load."""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """Returns the resonance of a truth file's content."""
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
        """Angular frequency of the resonance."""
        held = (self.stiffness_nm_per_rad + self.held_nm_per_rad) / self.inertia_kg_m2
        return math.sqrt(held + self.stiffness_nm_per_rad / self.reflected_kg_m2)

    def stiffest_nm_per_rad(self, rad_s: float) -> float:
        """Returns the spring stiffness for a resonance at this frequency, with the same sliders.

        Not positive if the sliders alone exceed this frequency.
        """
        left = rad_s**2 - self.held_nm_per_rad / self.inertia_kg_m2
        return left / (1.0 / self.inertia_kg_m2 + 1.0 / self.reflected_kg_m2)

    def most_held_nm_per_rad(self, rad_s: float) -> float:
        """Returns the slider stiffness for a resonance at this frequency, with the same spring."""
        share = 1.0 + self.inertia_kg_m2 / self.reflected_kg_m2
        return self.inertia_kg_m2 * rad_s**2 - self.stiffness_nm_per_rad * share
