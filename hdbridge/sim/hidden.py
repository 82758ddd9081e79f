"""Hide a physical cause in the simulated axis: what a diagnosis is then asked to find.

`hide` draws physically sensible parameters, off any grid, so that the cause has a wanted size, and returns
the truth with the cause in it and a description of what was hidden. The size is a peak in arcsec at the load,
reached somewhere in the run that is meant (`Run`); each description says what exactly it is.

The names of the causes are those of the catalogue in docs/causes.md. ``unexplained`` draws one of several
causes that are not in the catalogue; ``unexplained:roller`` and so on choose one of them.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

from hdbridge.sim import hidden_elastic, hidden_readings, hidden_slow, hidden_teeth, hidden_unknown
from hdbridge.sim.hidden_site import Hidden, Run, Site
from hdbridge.sim.truth import Truth

__all__ = ["CAUSES", "UNKNOWN", "Hidden", "Run", "hide", "hide_all"]

UNKNOWN: Mapping[str, Callable[[Site], Hidden]] = MappingProxyType(
    {
        "unexplained:roller": hidden_unknown.roller,
        "unexplained:seat": hidden_unknown.seat,
        "unexplained:cable": hidden_unknown.cable,
        "unexplained:sensor_warming": hidden_unknown.sensor_warming,
    }
)
"""Causes outside the catalogue."""

CAUSES: Mapping[str, Callable[[Site], Hidden]] = MappingProxyType(
    {
        "motor_order": hidden_teeth.motor_order,
        "motor_encoder_eccentricity": hidden_readings.motor_encoder_eccentricity,
        "load_order": hidden_readings.load_order,
        "flexspline_order": hidden_teeth.flexspline_order,
        "direction_phase": hidden_teeth.direction_phase,
        "torque_modulation": hidden_teeth.torque_modulation,
        "compliance": hidden_elastic.compliance,
        "inertial_windup": hidden_elastic.inertial_windup,
        "velocity_windup": hidden_elastic.velocity_windup,
        "channel_skew": hidden_readings.channel_skew,
        "backlash": hidden_elastic.backlash,
        "hysteresis_memory": hidden_elastic.hysteresis_memory,
        "hysteresis_parameters": hidden_elastic.hysteresis_parameters,
        "rate_dependence": hidden_elastic.rate_dependence,
        "subdivisional_error": hidden_readings.subdivisional_error,
        "zero_drift": hidden_slow.zero_drift,
        "amplitude_drift": hidden_slow.amplitude_drift,
        "wear": hidden_slow.wear,
        "creep": hidden_slow.creep,
        "ratio_error": hidden_teeth.ratio_error,
        "count_loss": hidden_readings.count_loss,
        "vibration": hidden_elastic.vibration,
        "local_defect": hidden_teeth.local_defect,
    }
)
"""The catalogue's causes."""


def hide(
    truth: Truth, cause: str, rng: random.Random, size_arcsec: float, run: Run | None = None
) -> tuple[Truth, Hidden]:
    """Put a cause of about a size into an axis, beside what is in it already.

    ``Hidden.size_arcsec`` is the size that it really has: some causes have limits (a tooth error cannot be
    shifted by more than itself). ValueError for an unknown cause, a size that is not above 0, or an axis that
    cannot have it (a loop without hysteresis cannot have another width).
    """
    if size_arcsec <= 0.0:
        raise ValueError(f"size_arcsec: found {size_arcsec:g}; expected a number above 0")
    name = rng.choice(sorted(UNKNOWN)) if cause == "unexplained" else cause
    draw = CAUSES.get(name) or UNKNOWN.get(name)
    if draw is None:
        raise ValueError(f"cause: found '{cause}'; expected one of {', '.join((*CAUSES, *UNKNOWN))}")
    site = Site(truth, rng, size_arcsec, run or Run())
    hidden = draw(site)
    return Truth.model_validate(site.data), hidden


def hide_all(
    truth: Truth, wanted: Iterable[tuple[str, float]], rng: random.Random, run: Run | None = None
) -> tuple[Truth, list[Hidden]]:
    """Put several causes, each of its size in arcsec, into an axis, one after the other."""
    hidden = []
    for cause, size_arcsec in wanted:
        truth, one = hide(truth, cause, rng, size_arcsec, run)
        hidden.append(one)
    return truth, hidden
