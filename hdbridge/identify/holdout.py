"""Quality on data that the fit has not seen: parts are left out, fitted without, and predicted."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hdbridge.effects import FloatArray, IntArray
from hdbridge.estimation.design import Design, clusters
from hdbridge.estimation.gain import Gain
from hdbridge.estimation.linearised import Linearised, steps_without
from hdbridge.estimation.noise import Precision
from hdbridge.estimation.separable import Solution
from hdbridge.estimation.stretches import about_zeros, counted, sums
from hdbridge.identify.result import HeldOut
from hdbridge.identify.state import State
from hdbridge.identify.usable import KNOWN
from hdbridge.units import DEG_PER_TURN

FOLDS = 4
STRETCHES = 40
"""Of time, of which a fold takes every fourth."""
RECORDINGS = "recordings"
CELL_DEG = 30.0
SAME_WAY = 0.8
"""A recording went where others did when so much of it lies in cells of the motor angle that they saw."""


def held_out(
    state: State, solution: Solution, measured_arcsec: FloatArray, inside_variance: float
) -> HeldOut:
    """Leave out one fold at a time, and compare with the active model, or none.

    ``measured_arcsec`` (b,) is what was measured, before any delay was put right; ``inside_variance`` is what
    samples vary inside their blocks, which no model of this kind changes.
    """
    design, blocks, active = state.design, state.design.blocks, state.options.active
    fold, over = folds(design)
    written = {place for place, each in enumerate(solution.effects) if not each.violations()}
    shift = [at for at, each in enumerate(solution.columns) if each.effect < 0]
    kept = shift + [at for at, each in enumerate(solution.columns) if each.effect in written]
    rest_arcsec = blocks.error_arcsec - solution.jacobian[:, shift] @ solution.nuisances[shift]
    added, alone = (np.zeros((2, len(blocks))) for _ in range(2))
    # The active model has no nuisances of its own: it is given those that suit it best.
    own = active.effects if active else ()
    new = [solution.effects[place] for place in sorted(written)]
    for row, (effects, of) in enumerate(((own, shift), (new, kept))):
        told, columns = design.told(effects), solution.jacobian[:, of]
        fit = Linearised(columns, rest_arcsec - told, solution.known[of])
        steps = steps_without(fit, fold, lambda rows: Precision(state.noise, blocks.picked(rows)))
        for number, step in enumerate(steps):
            out = fold == number
            # About the zeros that the rest of the data have; about its own where one is in this fold alone.
            lost = ~np.isin(blocks.zero, blocks.zero[~out])
            left = fit.residual - columns @ step
            added[row, out] = about_zeros(left, blocks.zero, blocks.count * lost)[out]
            left = measured_arcsec - told - columns[:, len(shift) :] @ step[len(shift) :]
            alone[row, out] = about_zeros(left, blocks.zero, blocks.count * (lost | ~out))[out]
    used = len(fold) - np.bincount(fold)[fold] >= 2 * len(solution.columns)
    weight = blocks.count * used
    if not np.sum(weight):
        return HeldOut(
            None, None, math.nan, "nothing was held out: there is too little data to leave any out"
        )
    stretch = blocks.chain if over == RECORDINGS else clusters(blocks, STRETCHES)
    number = len(np.unique(fold[used]))

    def gain(left: FloatArray) -> Gain:
        rows = np.stack([weight, *(weight * (each**2 + inside_variance) for each in left)], axis=1)
        return Gain(over, number, *sums(rows, stretch).T)

    fitted = math.sqrt(float(weight @ solution.residual**2) / float(np.sum(weight)) + inside_variance)
    result = HeldOut(gain(alone), gain(added), fitted, "")
    assert result.gain is not None
    words = "improves on" if result.improves else "does not improve on"
    against = "the active model" if active else "no model"
    figures = f"{result.gain.before_arcsec:.2f} to {result.gain.after_arcsec:.2f} arcsec"
    return replace(result, text=f"{words} {against}: {figures} on {over} left out")


def folds(design: Design) -> tuple[IntArray, str]:
    """Which fold each block is in, and what is left out in words.

    Sweeps by whole motor turns, every fourth one in both directions; what stays in one place (sines,
    reversals) by stretches of time, so that no fold takes all there is to know about a reversal. Of several
    short recordings of the same travel whole ones: what is left in one of them goes on from one
    stretch to the next, and would be foretold by its neighbours.
    """
    blocks = design.blocks
    lowest = float(np.min(blocks.motor_deg))
    turns = float(np.ptp(blocks.motor_deg)) / DEG_PER_TURN
    by_turn = np.floor((blocks.motor_deg - lowest) / DEG_PER_TURN).astype(np.intp) % FOLDS
    by_time = clusters(blocks, STRETCHES) % FOLDS
    if turns < 2 * FOLDS:
        return (blocks.chain % FOLDS, RECORDINGS) if _alike(design) else (by_time, "stretches of time")
    local = design.samples.among(blocks.kind, ("sine", "reversal"))
    words = "motor turns, and stretches of sines and reversals," if local.any() else "motor turns"
    return counted(np.where(local, by_time, by_turn)), words


def _alike(design: Design) -> bool:
    """Whether there are recordings of which nothing is known but that each went where others did."""
    blocks = design.blocks
    if np.any(design.samples.among(blocks.kind, KNOWN)) or int(blocks.chain[-1]) == 0:
        return False
    cell = np.floor(blocks.motor_deg / CELL_DEG).astype(np.intp)
    for chain in range(int(blocks.chain[-1]) + 1):
        own = blocks.chain == chain
        if np.any(own) and np.mean(np.isin(cell[own], cell[~own])) < SAME_WAY:
            return False
    return True
