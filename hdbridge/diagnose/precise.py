"""The fit that parameters are taken from: what else moves the load is allowed for.

A tooth error shakes the load on its spring and the motor in its servo, and both answer the more the faster:
well below the resonances in phase by the square of the frequency, and lagging by its cube. A search does
without this, for it names nothing; but it makes orders a per cent too large or too small at one turn a
second, where their noise is a tenth of that. The free-form loop of a search is left out: it is no part of any
model, and what it takes over would be missing in the loop's own parameters.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.effects.orders import RAD_PER_DEG
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.terms import FOUND, Effort

SPEEDS_DIFFER: Final = 0.1
"""Share of the squared speed that its mean has to leave: at one speed the answer is part of the orders."""
_RATE: Final = 30.0
"""Radians per second, of size one in the columns."""


def precisely(estimator: Estimator, fitted: Fitted) -> Fitted:
    """The same hypothesis fitted together with what its waves shake, with the tangents of all shapes.

    What its waves shake is left out where the record has one speed only: it is part of the orders there.
    """
    shaken = _shaken(estimator, fitted) if _speeds_differ(estimator) else np.empty((len(estimator.index), 0))
    searched = estimator.nuisance
    try:
        estimator.nuisance = shaken
        plain = estimator.fit(fitted.hypothesis)
        found = estimator.fit(plain.hypothesis, moves=FOUND)
        if any(each.violations() for each in found.hypothesis.effects):
            return estimator.fit(plain.hypothesis, FOUND, Effort(steps=1))
        return found
    finally:
        estimator.nuisance = searched


def _shaken(estimator: Estimator, fitted: Fitted) -> FloatArray:
    """In phase by the square of frequency, lagging by its cube; shape (m, 2), or (m, 0) without orders.

    The second is odd in the direction, as a lag is.
    """
    motion = estimator.data.full.motion
    speed = motion.motor_speed_deg_s
    waves = [wave for each in fitted.hypothesis.effects for wave in each.waves()]
    if speed is None or not waves:
        return np.empty((len(estimator.index), 0))
    rate = RAD_PER_DEG * speed / _RATE
    columns = np.zeros((len(motion), 2))
    for turns, amplitude_arcsec, phase_deg in waves:
        at = RAD_PER_DEG * (turns * motion.motor_deg + phase_deg)
        frequency = turns * rate
        columns[:, 0] += amplitude_arcsec * frequency**2 * np.cos(at)
        columns[:, 1] += amplitude_arcsec * frequency**3 * np.sin(at)
    return estimator.at_points(columns)


def _speeds_differ(estimator: Estimator) -> bool:
    speed = estimator.motion.motor_speed_deg_s
    if speed is None:
        return False
    squared = speed[estimator.index] ** 2
    squared = squared[squared > 0.0]
    if not len(squared):
        return False
    left = 1.0 - float(np.mean(squared)) ** 2 / float(np.mean(squared**2))
    return left > SPEEDS_DIFFER
