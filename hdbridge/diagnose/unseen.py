"""What a motor may do within one count of its encoder, and what that does to a loop.

A servo that hunts where it rests goes to and fro by less than a count. Nobody sees it, but a loop begins a
new branch at every turn, with an infinite slope: half a count of a coarse encoder is several arcseconds, and
where the axis goes on without crossing the loop they stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hdbridge.effects import FloatArray, Motion
from hdbridge.effects.kinematics import direction_of

PART = 0.5
"""Part of a count by which a resting motor may have gone back."""
SHARE = 0.5
"""Share of what it would then do that counts as noise: it does not always."""


def hunting_arcsec(motion: Motion, count_deg: float, expected: Callable[[Motion], FloatArray]) -> FloatArray:
    """How far the loop of a model may be off for moves that the encoder cannot see, arcsec, shape (n,).

    ``expected`` is what the model predicts: for the motion, and for one that goes back by `PART` of a count
    wherever it rests.
    """
    if not count_deg or motion.motor_speed_deg_s is None:
        return np.zeros(len(motion))
    back = PART * count_deg * direction_of(motion) * (motion.motor_speed_deg_s == 0.0)
    hunted = replace(motion, motor_deg=motion.motor_deg - back)
    return np.asarray(SHARE * np.abs(expected(hunted) - expected(motion)))
