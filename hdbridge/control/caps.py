"""Check that the limits in an axis file do not clip a model's correction. Pure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Motion, compensable
from hdbridge.axis.effects.motion import MEASURED
from hdbridge.axis.model import TransmissionModel

_POINTS = 20_000
"""Maximum number of points per direction: one point every two motor degrees over 800 load degrees at a ratio
of 50."""


def cap_remark(axis: AxisConfig, model: TransmissionModel) -> str | None:
    """Returns a remark if ``compensation.maximum_arcsec`` clips the model's correction, else None.

    The correction is evaluated over the travel in both directions at the axis's maximum velocity, with the
    measured channels at their defaults.
    """
    limits, cap_arcsec = axis.limits, axis.compensation.maximum_arcsec
    travel_deg = axis.gear.ratio * (limits.position_max_deg - limits.position_min_deg)
    there = np.linspace(
        axis.gear.ratio * limits.position_min_deg,
        axis.gear.ratio * limits.position_max_deg,
        min(_POINTS, 1 + int(np.ceil(travel_deg))),
    )
    motor_deg = np.concatenate([there, there[-2::-1]])
    speed_deg_s = axis.gear.ratio * limits.velocity_deg_s
    motion = Motion(
        motor_deg,
        time_s=np.cumsum(np.abs(np.diff(motor_deg, prepend=motor_deg[0]))) / speed_deg_s,
        measured={each: np.full(len(motor_deg), each.at_rest) for each in MEASURED},
        load_deg=motor_deg / axis.gear.ratio,
    )
    wanted = np.abs(replace(model, effects=compensable(model.effects)).predict(motion))
    peak = int(np.argmax(wanted))
    if wanted[peak] <= cap_arcsec:
        return None
    cut = float(np.mean(wanted > cap_arcsec))
    peak_deg = motor_deg[peak] / axis.gear.ratio
    return (
        f"{axis.where('compensation.maximum_arcsec')}: {cap_arcsec:g} arcsec cut the correction of this "
        f"model, which reaches {wanted[peak]:.0f} arcsec at {peak_deg:.4g} deg, over "
        f"{100.0 * cut:.0f} % of the travel; raise it, or check the model"
    )
