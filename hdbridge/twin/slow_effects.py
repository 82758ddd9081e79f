"""Effects of warmth, travel and time, as the plant has them; see `hdbridge.twin.translation`."""

from __future__ import annotations

from typing import Final

from hdbridge.effects import AmplitudeDrift, Creep, Wear, ZeroDrift
from hdbridge.effects.warmth import Warmed
from hdbridge.twin.draft import Draft, Said, none

LINEAR_BUILD_UP: Final = 0.5
"""Below this the plant's element, which has one time for strain and release, differs."""


def zero_drift(effect: ZeroDrift, draft: Draft) -> Said:
    """A shift with the temperature, delayed as the model has it; from the ambient temperature on."""
    heat = draft.part("temperature")
    heat["zero_drift_arcsec_per_k"] = effect.drift_arcsec_per_k
    if effect.driven_by == "time":
        return Said("temperature.zero_drift_arcsec_per_k", (_warms_up(effect, draft),))
    heat["zero_time_constant_s"] = effect.tau_s
    return Said("temperature.zero_drift_arcsec_per_k", ("zero at the ambient temperature: an offset",))


def amplitude_drift(effect: AmplitudeDrift, draft: Draft) -> Said:
    """Growth of tooth error and of friction with the temperature."""
    heat = draft.part("temperature")
    heat["tooth_growth_per_k"] = _share(effect.ripple_percent_per_k)
    heat["friction_growth_per_k"] = _share(effect.friction_percent_per_k)
    notes = []
    if effect.driven_by == "time":
        notes.append(_warms_up(effect, draft))
        heat["reference_c"] = heat["start_c"]
    else:
        heat["reference_c"] = effect.reference_c
        notes.append(f"at once with the temperature, where the model follows it in {effect.tau_s:.3g} s")
    if effect.friction_percent_per_k:
        notes.append("the motor's friction grows with the loop")
    return Said("temperature.tooth_growth_per_k, temperature.friction_growth_per_k", tuple(notes))


def wear(effect: Wear, draft: Draft) -> Said:
    """A gap between the teeth that grows with the travel; the plant's is told one way, the model's both."""
    if effect.growth_arcsec_per_kiloturn > 0.0:
        return none("the loop widens in the sense of the elastic one: the plant's teeth wear to a gap only")
    draft.gear["wear"] = {
        "arcsec_per_1000_turns": -0.5 * effect.growth_arcsec_per_kiloturn,
        "exponent": effect.exponent,
    }
    notes = ["crossed within the gap's own travel"]
    if effect.turns_before:
        notes.append(f"from zero turns on: the {effect.turns_before:.0f} turns before are not in it")
    return Said("gear.wear", tuple(notes))


def creep(effect: Creep, draft: Draft) -> Said:
    """Kelvin-Voigt elements. The model's strain is ahead in motion, the plant's yields to the drag."""
    parts = [
        {"time_constant_s": each.tau_s, "amplitude_arcsec": -each.amplitude_arcsec} for each in effect.parts
    ]
    draft.gear["creep"] = [*draft.gear.get("creep", ()), *parts]
    fast = effect.build_up < LINEAR_BUILD_UP
    return Said(
        "gear.creep",
        (f"strained as slowly as it lets go, where the model needs {effect.build_up:.2g} of that",)
        if fast or effect.build_up > 1.0 / LINEAR_BUILD_UP
        else (),
    )


def _warms_up(effect: Warmed, draft: Draft) -> str:
    """Start the plant as much colder than its surroundings as the model warms up by."""
    heat = draft.part("temperature")
    ambient_c = heat.get("ambient_c", 22.0)
    heat["start_c"] = max(-60.0, ambient_c - effect.warm_up_k)
    heat["time_constant_s"] = effect.tau_s
    return f"started {effect.warm_up_k:g} K below the ambient temperature, in {effect.tau_s:.3g} s"


def _share(percent_per_k: float) -> float:
    return 0.01 * percent_per_k
