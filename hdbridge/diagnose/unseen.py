"""What a motor may do within one count of its encoder, and what that does to a loop.

A servo that hunts where it rests, or sticks where it turns round, goes to and fro by less than a count.
Nobody sees it, but a loop begins a new branch at every turn, with an infinite slope: half a count of a coarse
encoder is several arcseconds, and in nested reversals they stay until the loop is crossed again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from hdbridge.effects import FloatArray, Motion
from hdbridge.effects.hysteresis import branches

PART = 0.5
"""Part of a count by which the motor goes to and fro."""
SHARE = 0.5
"""Share of what it would then do that counts as noise: it does not always."""


def hunting_arcsec(motion: Motion, count_deg: float, expected: Callable[[Motion], FloatArray]) -> FloatArray:
    """How far the loop of a model may be off for turns that the encoder cannot see, arcsec, shape (n,).

    ``expected`` is what the model predicts: once for the motion, once for one that goes back by `PART` of a
    count wherever it rests, and to and fro by as much before it turns round.
    """
    motor, speed = motion.motor_deg, motion.motor_speed_deg_s
    turning, signs = branches(motor)
    if not count_deg or not signs or speed is None:
        return np.zeros(len(motor))
    way = np.zeros(len(motor))
    way[turning[0] + 1 :] = np.repeat(signs, np.diff(turning))
    back = PART * count_deg * way
    resting = speed == 0.0
    turns = np.array([each for each in turning[1:-1] if not resting[each]], dtype=np.intp)
    times = np.ones(len(motor), dtype=np.intp)
    times[turns] = 3
    rows = np.repeat(np.arange(len(motor)), times)
    last = np.cumsum(times) - 1
    path = np.where(resting, motor - back, motor)[rows]
    path[last[turns] - 1] -= back[turns]
    channels = {each.name: getattr(motion, each.name) for each in fields(motion)}
    repeated = {name: values[rows] for name, values in channels.items() if values is not None}
    hunted = replace(motion, **repeated | {"motor_deg": path})
    return np.asarray(SHARE * np.abs(expected(hunted)[last] - expected(motion)))
