"""Whether a twin is better than the simulation before it, on legs that its fit has not seen. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from hdbridge.twin.comparison import (
    ALL,
    FOLLOWING_ERROR,
    LOAD_ERROR,
    MOTOR_TORQUE,
    TEMPERATURE,
    TITLES,
    Comparison,
)
from hdbridge.twin.result import HELD_OUT

SIGNALS: Final = (LOAD_ERROR, FOLLOWING_ERROR, MOTOR_TORQUE, TEMPERATURE)
LEAST_GAIN: Final = 0.01
"""Less than a hundredth off the differences, their mean ratio, is no gain: it changes with the noise."""
WORSE: Final = 1.1
"""A signal that differs by a tenth more than before, and by more than its noise, is worse."""


@dataclass(frozen=True, slots=True)
class Gain:
    """What the fit has gained."""

    better: bool
    text: str


def better(before: Comparison, after: Comparison) -> Gain:
    """By the rms differences of load error, following error, torque and temperature, as far as they were
    recorded; over all legs where none was held
    out.
    """
    kind = HELD_OUT if any(row.kind == HELD_OUT for row in after.rows) else ALL
    where = "on legs that the fit has not seen" if kind == HELD_OUT else "on the legs that it was fitted to"
    pairs = {
        name: (was, now)
        for name in SIGNALS
        if (was := before.row(name, kind)) is not None and (now := after.row(name, kind)) is not None
    }
    # A replay begins at a reading, and may be off by a step from there on: within it none is nearer.
    step_k = max((each.noise for each in pairs.get(TEMPERATURE, ())), default=0.0)
    if max((each.difference for each in pairs.get(TEMPERATURE, ())), default=0.0) <= step_k:
        pairs.pop(TEMPERATURE, None)
    worse = [
        f"{TITLES[name]} differs by {now.difference:.3g} {now.unit}, before by {was.difference:.3g}"
        for name, (was, now) in pairs.items()
        if now.difference > WORSE * was.difference and now.difference > max(now.noise, 1e-12)
    ]
    # What is noise is in both differences. What they are less than is none: rounding, a jerk.
    least = {name: step_k if name == TEMPERATURE else 1e-12 for name in pairs}
    ratios = [
        math.log(max(now.difference, least[name]) / max(was.difference, least[name]))
        for name, (was, now) in pairs.items()
    ]
    gain = 1.0 - math.exp(sum(ratios) / len(ratios)) if ratios else 0.0
    if worse:
        return Gain(False, f"{where}, {'; '.join(worse)}")
    if gain < LEAST_GAIN:
        return Gain(False, f"{where} it is no nearer to the axis than the simulation was")
    return Gain(True, f"{where} the differences from the axis are {100.0 * gain:.0f} % smaller in the mean")
