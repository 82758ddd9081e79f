"""The fit that parameters are taken from: what else moves the load is allowed for.

A tooth error shakes the load on its spring and the motor in its servo, and both answer the more the faster:
well below the resonances in phase by the square of the frequency, and lagging by its cube. A search does
without this, for it names nothing; but it makes orders a per cent too large or too small at one turn a
second, where their noise is a tenth of that. The free-form loop of a search is left out: it is no part of any
model, and what it takes over would be missing in the loop's own parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hdbridge.effects.orders import RAD_PER_DEG
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.nuisances import speeds_differ, swing
from hdbridge.estimation.terms import FOUND, Effort, Nuisances


def precisely(estimator: Estimator, fitted: Fitted) -> Fitted:
    """The same hypothesis fitted together with what its waves shake, with the tangents of all shapes.

    What its waves shake is left out where the record has one speed only: it is part of the orders there.
    """
    plain = estimator.fit(replace(fitted.hypothesis, nuisances=_shaken(estimator, fitted)))
    found = estimator.fit(plain.hypothesis, moves=FOUND)
    if any(each.violations() for each in found.hypothesis.effects):
        return estimator.fit(plain.hypothesis, FOUND, Effort(steps=1))
    return found


def _shaken(estimator: Estimator, fitted: Fitted) -> Nuisances | None:
    """In phase by the square of frequency, and lagging by its cube; the second is odd in the direction, as a
    lag is. None without orders, and at one speed.
    """
    motion = estimator.data.full.motion
    speed = motion.motor_speed_deg_s
    waves = [wave for each in fitted.hypothesis.effects for wave in each.waves()]
    slow = estimator.motion.motor_speed_deg_s
    moving = np.empty(0) if slow is None else slow[estimator.index]
    moving = moving[moving != 0.0]
    if speed is None or not waves or not speeds_differ(moving, np.ones(len(moving))):
        return None
    angles = ((turns, size, RAD_PER_DEG * (turns * motion.motor_deg + phase)) for turns, size, phase in waves)
    both = ((turns, size * np.cos(angle), size * np.sin(angle)) for turns, size, angle in angles)
    return swing(RAD_PER_DEG * speed, both, estimator.at_points)
