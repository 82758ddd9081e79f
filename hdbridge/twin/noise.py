"""The noise of a recording: what a twin leaves is held against it, and its load encoder has as much."""

from __future__ import annotations

import math

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import CHANNELS, Data
from hdbridge.twin.parameters import LOAD, with_load_encoder
from hdbridge.twin.scales import MAD_TO_SIGMA, Scales, noise_floor
from hdbridge.units import ARCSEC_PER_DEG

ARCSEC_PER_TURN = 360.0 * ARCSEC_PER_DEG
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


def expected(data: Data) -> Scales:
    """By channel, in its unit: what a replay of the true axis would leave.

    Of following error and torque that is their rounding: what third differences leave of a torque is mostly
    motion. What the load encoder has beyond its rounding only the recording tells.
    """
    return Scales(noise_floor(data) | {LOAD: noise_in_motion(data)[LOAD]})


def with_load_noise(truth: Truth, left_arcsec: FloatArray) -> Truth:
    """The truth with the load encoder's noise: what differs from row to row and no replay has.

    ``left_arcsec`` are the load's residuals, zero where a row does not count. The rounding is not in it.
    """
    encoder = truth.load_.encoder
    inside = left_arcsec != 0.0
    steps = np.diff(left_arcsec)[inside[1:] & inside[:-1]]
    if not len(steps):
        return truth
    spread = MAD_TO_SIGMA * float(np.median(np.abs(steps))) / math.sqrt(2.0)
    rounding = ARCSEC_PER_TURN / encoder.counts_per_turn / math.sqrt(12.0)
    noise_arcsec = round(math.sqrt(max(spread**2 - rounding**2, 0.0)), 4)
    return with_load_encoder(truth, noise_arcsec=noise_arcsec)
