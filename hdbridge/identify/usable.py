"""Which samples of a calibration are near enough to standing to be used, by what the axis was doing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from hdbridge.effects import BoolArray, FloatArray
from hdbridge.effects.path import branches
from hdbridge.errors import InputError
from hdbridge.estimation.samples import ON_THE_WAY, Measured, Samples, observe
from hdbridge.observations.kinematics import SETTLE_S, settling

MINIMUM_SAMPLES = 8
SETTLE_SHARE = 0.2
"""After a turn, where the hysteresis rises too steeply for a load on a spring to follow, no more than this
share of the travel to the next one is left out."""
STANDING_DEG_S = 1e-3
"""Load speed below which an axis stands."""
GENTLE_DEG_S2 = 40.0
"""Load acceleration that a motion of which nothing is known may have."""
RESTING = ("reference", "standstill")
SLOW = ("sweep", "sine", "reversal")
"""Legs whose own speed is what is meant by slow."""
KNOWN = (*RESTING, *ON_THE_WAY, *SLOW)


def usable_samples(measured: Measured, ratio: float, slow_deg_s: float | None = None) -> Samples:
    """Samples, errors about the median of each zero. InputError where there is too little, or the ratio is
    not this gear's.

    ``slow_deg_s`` is the load speed up to which samples are used; by default the one of the slow legs.
    """
    count = len(measured.record)
    if count < MINIMUM_SAMPLES:
        raise InputError(f"{count} samples; expected at least {MINIMUM_SAMPLES}: record more")
    samples = observe(measured, ratio, against_command=False)
    middles = [np.median(samples.error_arcsec[samples.zero == each]) for each in range(samples.zeros)]
    turned = [_has_turned(samples.time_s[each.rows], samples.motor_deg[each.rows]) for each in samples.chains]
    return replace(
        samples,
        error_arcsec=samples.error_arcsec - np.array(middles)[samples.zero],
        usable=_slow(samples, slow_deg_s) & ~np.concatenate(turned),
    )


def _slow(samples: Samples, slow_deg_s: float | None) -> BoolArray:
    """Samples at rest and in slow motions, not within `SETTLE_S` after fast ones.

    A motion counts as a whole, from rest or turn to the next: the start of a fast move is no slow motion. Of
    moves and steps only the rests are used. Where nothing is known of a record, what accelerates is left out.
    """
    speed, acceleration = samples.speed_deg_s / samples.ratio, samples.motion.motor_acceleration_deg_s2
    assert acceleration is not None
    moving = np.abs(speed)
    own = moving[samples.of_kind(*SLOW) & (moving > 0)]
    if slow_deg_s is None:
        slow_deg_s = 1.2 * float(np.quantile(own, 0.995)) if len(own) else np.inf
    under_way = moving > STANDING_DEG_S
    fast = under_way & samples.of_kind(*ON_THE_WAY)
    fast |= ~samples.of_kind(*KNOWN) & (np.abs(acceleration / samples.ratio) > GENTLE_DEG_S2)
    # Motions that follow one another without a rest are distinguished by their kind and direction.
    changes = [np.diff(each) != 0 for each in (under_way, samples.kind, np.sign(speed))]
    first = np.append(0, np.flatnonzero(np.any(changes, axis=0)) + 1)
    fastest = np.repeat(np.maximum.reduceat(moving, first), np.diff(np.append(first, len(samples))))
    fast |= under_way & (fastest > slow_deg_s)
    return ~settling(fast, samples.time_s)


def _has_turned(time: FloatArray, motor_deg: FloatArray) -> BoolArray:
    """Samples within `SETTLE_S` after a turn."""
    turned = np.zeros(len(time), dtype=bool)
    turning, _ = branches(motor_deg)
    for first, last in pairwise(turning[1:]):
        settled = time[first] + min(SETTLE_S, SETTLE_SHARE * float(time[last] - time[first]))
        turned[first + 1 : int(np.searchsorted(time, settled, "right"))] = True
    return turned
