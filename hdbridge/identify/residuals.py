"""What is left, questioned: does it hang on the motor angle, the load angle, the direction, the time?"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.estimation.blocks import Blocks
from hdbridge.estimation.noise import NoiseModel, Precision
from hdbridge.identify.orders import Family, Line
from hdbridge.identify.result import NoiseFigures, ResidualTest

SURE = 3.0
"""Standard errors that a difference must have."""
WORTH_ARCSEC = 0.3
"""What is smaller than this is not reported as a failure, however sure it is."""
LEAST_TOLD_ARCSEC = 0.005
"""What would be told as 0.00 is left out."""


def residual_tests(
    residual: FloatArray,
    blocks: Blocks,
    precision: Precision,
    left: Sequence[Line],
    figures: NoiseFigures,
) -> tuple[ResidualTest, ...]:
    """All tests; ``left`` are the orders that are not in the fit."""
    return (
        _orders("motor_angle", [each for each in left if each.order.family is not Family.LOAD]),
        _orders("load_angle", [each for each in left if each.order.family is Family.LOAD]),
        _contrast("direction", np.sign(blocks.speed_deg_s) * blocks.moving, residual, precision, 2.0),
        _contrast("time", _centred(blocks.time_s), residual, precision, 1.0),
        _whiteness(figures.model),
        _level(figures),
    )


def _orders(name: str, left: Sequence[Line]) -> ResidualTest:
    significant = [each for each in left if each.significant]
    worst = max(significant, key=lambda each: each.amplitude_arcsec, default=None)
    size = worst.amplitude_arcsec if worst else 0.0
    text = f"{worst.order} of {size:.2f} arcsec is left" if worst else "no order is left"
    return ResidualTest(name, size < WORTH_ARCSEC, size, text)


def _contrast(
    name: str, column: FloatArray, residual: FloatArray, precision: Precision, scale: float
) -> ResidualTest:
    """Generalised least squares of the residual on one column and the mean; size: ``scale`` columns."""
    columns = np.stack([np.ones(len(column)), column], axis=1)
    weighted = precision.apply(columns)
    information = columns.T @ weighted
    if np.linalg.cond(information) > 1e12:
        return ResidualTest(name, True, 0.0, f"the record does not vary in {name}")
    inverse = np.linalg.inv(information)
    value = float((inverse @ (weighted.T @ residual))[1]) * scale
    error = math.sqrt(max(inverse[1, 1], 0.0)) * scale
    passed = abs(value) < max(SURE * error, WORTH_ARCSEC)
    return ResidualTest(name, passed, abs(value), f"{value:+.2f} arcsec, standard error {error:.2f}")


def _centred(time_s: FloatArray) -> FloatArray:
    span = float(np.ptp(time_s))
    return (time_s - np.mean(time_s)) / span if span else np.zeros(len(time_s))


def _whiteness(noise: NoiseModel) -> ResidualTest:
    size = math.hypot(noise.slow_arcsec, noise.place_arcsec)
    wanders = [
        f"by {arcsec:.2f} arcsec within {span}"
        for arcsec, span in (
            (noise.slow_arcsec, f"{noise.slow_s:.1f} s"),
            (noise.place_arcsec, f"{noise.place_deg:.2f} deg of the motor"),
        )
        if arcsec >= LEAST_TOLD_ARCSEC
    ]
    text = f"wanders {' and '.join(wanders)}; the intervals allow for it" if wanders else "does not wander"
    return ResidualTest("whiteness", size < WORTH_ARCSEC, size, text)


def _level(figures: NoiseFigures) -> ResidualTest:
    rest = figures.standing_arcsec
    if rest is None:
        return ResidualTest("noise_level", True, 0.0, "the axis never stood long enough to tell its noise")
    size = math.sqrt(max(figures.fitted_arcsec**2 - rest**2, 0.0))
    text = f"{figures.fitted_arcsec:.2f} arcsec is left, at rest the noise is {rest:.2f}"
    return ResidualTest("noise_level", size < max(rest, 1.0), size, text)
