"""The fit that parameters are taken from: what else moves the load in addition to the theory is allowed for.

A tooth error shakes the load on its spring and the motor in its servo, and both answer the more the faster:
well below the resonances in phase by the square of the frequency, and lagging by its cube. A search does
without this, for it names nothing; but it makes orders a per cent too large or too small at one turn a
second, where their noise is a tenth of that. The free-form loop of a search is left out: it is no part of any
model, and what it takes over would be missing in the loop's own parameters.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from hdbridge.diagnose.theory import CONVERGED, Fitted, Workshop, moved, solve
from hdbridge.effects import FloatArray
from hdbridge.effects.orders import RAD_PER_DEG, OrderSeries

SPEEDS_DIFFER: Final = 0.1
"""Share of the squared speed that its mean has to leave: at one speed the answer is part of the orders."""
FOUND: Final = frozenset({"frequency_hz", "torque1_nm", "torque2_nm"})
"""Shapes that a search finds among all their values, and that can be moved on from there."""
STEPS: Final = 4
_RATE: Final = 30.0
"""Radians per second, of size one in the columns."""


def precisely(workshop: Workshop, fitted: Fitted) -> Fitted:
    """The same theory fitted together with what its waves shake, with the tangents of all shapes.

    What its waves shake is left out where the record has one speed only: it is part of the orders there.
    """
    shaken = _shaken(workshop, fitted) if _speeds_differ(workshop) else np.empty((len(workshop.index), 0))
    searched = workshop.nuisance
    try:
        workshop.nuisance = shaken
        return _with_found(workshop, workshop.fit(fitted.theory))
    finally:
        workshop.nuisance = searched


def _with_found(workshop: Workshop, fitted: Fitted) -> Fitted:
    """With the shapes that a search found among all their values, moved to where they fit best."""
    for _ in range(STEPS):
        full = workshop.with_shapes(fitted, FOUND)
        if len(full.parameters) == len(fitted.parameters):
            return fitted
        new = range(len(fitted.parameters), len(full.parameters))
        moves = solve(full.tangent, full.residual)
        effects = moved(
            fitted.theory.effects, moves[new.start :], [full.parameters[each] for each in new], 1.0
        )
        trial = workshop.fit(replace(fitted.theory, effects=effects))
        if any(each.violations() for each in effects) or trial.chi_square > fitted.chi_square - CONVERGED:
            return full
        fitted = trial
    return workshop.with_shapes(fitted, FOUND)


def _shaken(workshop: Workshop, fitted: Fitted) -> FloatArray:
    """In phase by the square of frequency, lagging by its cube; shape (m, 2), or (m, 0) without orders.

    The second is odd in the direction, as a lag is.
    """
    motion = workshop.evidence.full.motion
    speed = motion.motor_speed_deg_s
    waves = [each for each in fitted.theory.effects if isinstance(each, OrderSeries) and each.orders]
    if speed is None or not waves:
        return np.empty((len(workshop.index), 0))
    rate = RAD_PER_DEG * speed / _RATE
    columns = np.zeros((len(motion), 2))
    for series in waves:
        turns = series.turns_per_motor_turn()
        for each in series.orders:
            at = RAD_PER_DEG * (each.order * turns * motion.motor_deg + each.phase_deg)
            frequency = each.order * turns * rate
            columns[:, 0] += each.amplitude_arcsec * frequency**2 * np.cos(at)
            columns[:, 1] += each.amplitude_arcsec * frequency**3 * np.sin(at)
    return workshop.at_points(columns)


def _speeds_differ(workshop: Workshop) -> bool:
    speed = workshop.motion.motor_speed_deg_s
    if speed is None:
        return False
    squared = speed[workshop.index] ** 2
    squared = squared[squared > 0.0]
    if not len(squared):
        return False
    left = 1.0 - float(np.mean(squared)) ** 2 / float(np.mean(squared**2))
    return left > SPEEDS_DIFFER
