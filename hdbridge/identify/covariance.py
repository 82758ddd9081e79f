"""The covariance of what was fitted, from the noise as it is, not as one would like it.

The covariance of a fit under the noise model is the inverse information. Where the noise model is wrong the
scores of longer stretches of the record vary more than it says: a sandwich over stretches (Liang and Zeger
1986) finds out, and wherever it is wider it is believed. What reading in counts leaves in a wave is the same
all along a sweep, and other in the next: for waves the stretches are whole legs as well, and since there are
few of these, all waves are taken together.
"""

from __future__ import annotations

import math

import numpy as np

from hdbridge.effects import FloatArray, Part
from hdbridge.estimation.blocks import Blocks
from hdbridge.estimation.design import clusters
from hdbridge.estimation.intervals import Interval, intervals_of
from hdbridge.estimation.linear import inverse_symmetric
from hdbridge.estimation.noise import Precision
from hdbridge.estimation.nuisances import is_turn
from hdbridge.estimation.separable import Solution
from hdbridge.estimation.stretches import sandwich, sums

STRETCHES = 100
"""The record is cut into about so many stretches for the sandwich."""


def covariance(solution: Solution, precision: Precision, blocks: Blocks) -> FloatArray:
    """Covariance of the solution's columns, shape (p, p)."""
    model = inverse_symmetric(solution.information)
    number = clusters(blocks, STRETCHES)
    # Turns are noise (each has one stretch to itself), not parameters: they have no scores of their own.
    main = [at for at, column in enumerate(solution.columns) if not is_turn(column.name)]
    if int(number[-1]) + 1 < 2 * len(main):
        return model
    inner = model[np.ix_(main, main)]
    weighted = precision.apply(solution.residual)
    spread = sandwich(solution.jacobian[:, main] @ inner * weighted[:, np.newaxis], number)
    widen = np.ones(len(model))
    widen[main] = np.sqrt(np.maximum(np.diag(spread) / np.maximum(np.diag(inner), 1e-300), 1.0))
    orders = {at for at, each in enumerate(solution.effects) if each.part is Part.ORDERS}
    waves = [at for at, each in enumerate(solution.columns) if each.effect in orders]
    if waves:
        between = math.sqrt(_between_legs(solution.jacobian[:, waves], precision, solution.residual, blocks))
        widen[waves] = np.maximum(widen[waves], between)
    return np.asarray(model * np.outer(widen, widen))


def of_effect(solution: Solution, index: int, cov: FloatArray) -> list[Interval]:
    """Intervals of one effect's parameters by the covariance of a solution's columns."""
    mine = [at for at, column in enumerate(solution.columns) if column.effect == index]
    columns = [solution.columns[at] for at in mine]
    return intervals_of(solution.effects[index], columns, cov[np.ix_(mine, mine)])


def _between_legs(waves: FloatArray, precision: Precision, residual: FloatArray, blocks: Blocks) -> float:
    """By how much the variance of waves, taken from leg to leg, is more than the noise model's; at least 1.

    Waves (b, p) of one kind have nearly the same information and hardly share any, so that each tells of all.
    """
    scores = sums(waves * precision.apply(residual)[:, np.newaxis], blocks.leg)
    own = sums(waves * precision.apply(waves), blocks.leg)
    information = np.sum(own, axis=0)
    legs = information**2 / np.sum(own**2, axis=0)
    ratio = np.sum(scores**2, axis=0) / information * legs / np.maximum(legs - 1.0, 0.5)
    return max(float(np.mean(ratio)), 1.0)
