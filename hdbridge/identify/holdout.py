"""Quality on data that the fit has not seen: parts are left out, fitted without, and predicted."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.identify.beside import is_rounding
from hdbridge.identify.design import clusters
from hdbridge.identify.gain import Gain
from hdbridge.identify.joint import JointFit, Problem, Solution
from hdbridge.identify.noise import NoiseModel, Precision
from hdbridge.identify.result import HeldOut
from hdbridge.identify.samples import KINDS, IntArray
from hdbridge.identify.segment import Kind
from hdbridge.units import DEG_PER_TURN

FOLDS = 4


def held_out(
    problem: Problem, solution: Solution, noise: NoiseModel, active_arcsec: FloatArray, inside_variance: float
) -> HeldOut:
    """Leave out one fold of whole turns at a time.

    ``active_arcsec`` (b,) is what the active model predicts; ``inside_variance`` is what samples vary inside
    their blocks, which no model of this kind changes.
    """
    blocks = problem.design.blocks
    fold, over = folds(problem)
    # Turns and rounding are noise of the fit, not something that a model could be given.
    problem = replace(problem, beside=problem.beside.without(is_rounding))
    shift = problem.beside.columns
    before = np.zeros(len(blocks))
    after = np.zeros(len(blocks))
    used = np.zeros(len(blocks), dtype=bool)
    for number in np.unique(fold).tolist():
        out = fold == number
        precision = Precision(noise, blocks, out)
        if np.count_nonzero(~out) < 2 * solution.jacobian.shape[1]:
            continue
        fit = JointFit(problem, precision, exact=False).refine(solution.effects, iterations=4)
        after[out] = fit.residual[out]
        # The active model has no zero and no nuisances of its own: it is given those that suit it best.
        rest = _least_squares(shift, problem.observed - active_arcsec, precision)
        before[out] = (problem.observed - active_arcsec - shift @ rest)[out]
        used |= out
    weight = blocks.count * used
    if not np.sum(weight):
        return HeldOut(None, math.nan, "nothing was held out: there is too little data to leave any out")
    gone = float(np.sum(np.clip(np.diff(blocks.time_s), 0.0, 1.0)))
    stretch = clusters(blocks, max(gone / 40, 1e-9))

    def squares(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(stretch, weight * (values**2 + inside_variance)))

    gain = Gain(
        over,
        len(np.unique(fold[used])),
        np.asarray(np.bincount(stretch, weight)),
        squares(before),
        squares(after),
    )
    fitted = math.sqrt(float(weight @ solution.residual**2) / float(np.sum(weight)) + inside_variance)
    result = HeldOut(gain, fitted, "")
    words = "improves on" if result.improves else "does not improve on"
    return replace(
        result,
        text=f"{words} the active model: {gain.before_arcsec:.2f} to {gain.after_arcsec:.2f} arcsec on "
        f"{over} left out",
    )


def folds(problem: Problem) -> tuple[IntArray, str]:
    """Which fold each block is in, and what is left out in words.

    Sweeps by whole motor turns, every fourth one in both directions; what stays in one place (sines,
    reversals) by stretches of time, so that no fold takes all there is to know about a reversal.
    """
    blocks = problem.design.blocks
    lowest = float(np.min(blocks.motor_deg))
    turns = float(np.ptp(blocks.motor_deg)) / DEG_PER_TURN
    by_turn = np.floor((blocks.motor_deg - lowest) / DEG_PER_TURN).astype(np.intp) % FOLDS
    gone = float(np.sum(np.clip(np.diff(blocks.time_s), 0.0, 1.0)))
    by_time = clusters(blocks, max(gone / (10 * FOLDS), 1e-9)) % FOLDS
    if turns < 2 * FOLDS:
        return by_time, "stretches of time"
    local = np.isin(blocks.kind, [KINDS.index(each) for each in (Kind.SINE, Kind.REVERSAL)])
    words = "motor turns, and stretches of sines and reversals," if local.any() else "motor turns"
    return np.where(local, by_time, by_turn), words


def _least_squares(columns: FloatArray, observed: FloatArray, precision: Precision) -> FloatArray:
    weighted = precision.apply(columns)
    return np.asarray(np.linalg.lstsq(columns.T @ weighted, weighted.T @ observed, rcond=None)[0])
