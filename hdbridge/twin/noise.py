"""The noise that what a twin leaves is held against: that of the recording while the axis moves."""

from __future__ import annotations

import math

import numpy as np

from hdbridge.twin.misfit import CHANNELS, MAD_TO_SIGMA, Data, noise_floor

THIRD_DIFFERENCE = math.sqrt(20.0)
"""White noise is so much larger in third differences: the root of 1 + 9 + 9 + 1."""
LEAST_ROWS = 8


def noise_in_motion(data: Data) -> dict[str, float]:
    """By channel, in its unit: what third differences leave of the signal, no less than its rounding.

    At rest an encoder says the same count again and again, and a motor that holds needs the same torque: no
    simulation of the motion can be held against that. A motion that is smooth over four rows is not in third
    differences, and of rows where it is not (a jerk, a reversal) a median takes no notice.
    """
    floor = noise_floor(data)
    found = {}
    for name in CHANNELS:
        rows = []
        for piece in data.pieces:
            moving = piece.rest == 0.0
            whole = moving[3:] & moving[2:-1] & moving[1:-2] & moving[:-3]
            rows.append(np.diff(piece.measured[name], 3)[whole])
        third = np.abs(np.concatenate(rows))
        spread = (
            MAD_TO_SIGMA * float(np.median(third)) / THIRD_DIFFERENCE if len(third) >= LEAST_ROWS else 0.0
        )
        found[name] = max(floor[name], spread)
    return found
