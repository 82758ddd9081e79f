"""Injects a hidden physical cause into the simulated axis, for a diagnosis to find.

`hide` draws physically plausible random parameters that give the cause the wanted size, and returns the truth
with the cause, and its description. The size is a peak in arcsec at the load, reached somewhere in the
intended run (`Run`); each description defines it exactly.

The names of the causes are those of the catalogue in docs/causes.md. ``unexplained`` draws one of several
causes outside the catalogue; ``unexplained:roller`` and the like choose one of them.
"""

import random
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

from hdbridge.sim.truth import Truth
from support.hidden import elastic, readings, slow, teeth, unknown
from support.hidden.site import Hidden, Run, Site

__all__ = ["CAUSES", "UNKNOWN", "Hidden", "Run", "hide", "hide_all"]

UNKNOWN: Mapping[str, Callable[[Site], Hidden]] = MappingProxyType(
    {
        "unexplained:roller": unknown.roller,
        "unexplained:seat": unknown.seat,
        "unexplained:cable": unknown.cable,
        "unexplained:sensor_warming": unknown.sensor_warming,
    }
)
"""Causes outside the catalogue."""

CAUSES: Mapping[str, Callable[[Site], Hidden]] = MappingProxyType(
    {
        "motor_order": teeth.motor_order,
        "motor_encoder_eccentricity": readings.motor_encoder_eccentricity,
        "load_order": readings.load_order,
        "flexspline_order": teeth.flexspline_order,
        "direction_phase": teeth.direction_phase,
        "torque_modulation": teeth.torque_modulation,
        "compliance": elastic.compliance,
        "inertial_windup": elastic.inertial_windup,
        "velocity_windup": elastic.velocity_windup,
        "channel_skew": readings.channel_skew,
        "backlash": elastic.backlash,
        "hysteresis_memory": elastic.hysteresis_memory,
        "hysteresis_parameters": elastic.hysteresis_parameters,
        "rate_dependence": elastic.rate_dependence,
        "subdivisional_error": readings.subdivisional_error,
        "zero_drift": slow.zero_drift,
        "amplitude_drift": slow.amplitude_drift,
        "wear": slow.wear,
        "creep": slow.creep,
        "ratio_error": teeth.ratio_error,
        "count_loss": readings.count_loss,
        "vibration": elastic.vibration,
        "local_defect": teeth.local_defect,
    }
)
"""Causes of the catalogue."""


def hide(
    truth: Truth, cause: str, rng: random.Random, size_arcsec: float, run: Run | None = None
) -> tuple[Truth, Hidden]:
    """Injects a cause of about this size into an axis, in addition to those that the axis has.

    ``Hidden.size_arcsec`` is the true size, because the size of some causes is limited (for example, the
    shift of a tooth error). ValueError for an unknown cause, a size that is not above 0, or an axis that
    cannot have the cause (without hysteresis, no loop can have another width).
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
    """Injects several causes into an axis, one after the other, each with its given size in arcsec."""
    hidden = []
    for cause, size_arcsec in wanted:
        truth, one = hide(truth, cause, rng, size_arcsec, run)
        hidden.append(one)
    return truth, hidden
