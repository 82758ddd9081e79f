"""Acceptance tests of a finding, by block-robust evidence in those parts of the record that show the cause.

Chi square treats neighbouring samples as independent, which correlated noise violates. A finding's score is
therefore summed over blocks of time, and its variance is estimated from these sums, so correlation within a
block has no influence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdbridge.analysis.hypothesis import Estimator, Fitted, Hypothesis
from hdbridge.analysis.linear import Linearised, of_length, sandwich, side_by_side, solve_symmetric
from hdbridge.axis.effects import BoolArray, Effect, FloatArray

BLOCKS_S = (1.0, 5.0, 20.0)
"""Lengths of the blocks over which scores are summed. Noise and thermal drift are correlated over less than a
block."""
LEAST_BLOCKS = 30
"""Minimum number of blocks for a reliable variance. In a short record the blocks are shortened to reach
it."""
LEAST_POINTS = 20
"""Minimum number of points for a test; with fewer, the evidence is zero."""


@dataclass(frozen=True, slots=True)
class Gate:
    """Result of the acceptance tests of a finding."""

    robust: float
    """Smallest block-robust chi square over the block lengths."""
    needed: float
    reason: str = ""
    """Reason for rejection; empty if the finding passed."""


def robust_chi_square(
    estimator: Estimator,
    fitted: Fitted,
    place: int,
    nuisances: FloatArray | None = None,
    rows: BoolArray | slice = slice(None),
    only: int | None = None,
    laws: FloatArray | None = None,
    free: bool = False,
) -> float:
    """Returns the block-robust chi square of an effect's coefficients, for the hypothesis that they are zero.

    Omits incidental coefficients and refits all other parameters. The effect's shape has no meaning without
    the effect. It is refitted only if ``free`` is set, which tests whether the record determines the
    coefficients. ``nuisances`` are additional weighted columns. ``rows`` selects points, and ``only`` a
    single coefficient. Each column of ``laws`` is one standard deviation of the law error of some other
    effect, weighted.
    """
    own = fitted.places(place)
    shape = [i for i in own if fitted.parameters[i].shape and not free]
    effect = fitted.hypothesis.effects[place]
    asked = evident(effect) if only is None else [only]
    kept = np.setdiff1d(np.arange(fitted.count()), shape)
    coefficients = effect.coefficients()[asked]
    own = np.searchsorted(kept, [i for i in own if not fitted.parameters[i].shape])[asked].tolist()
    columns = fitted.tangent[:, kept]
    if nuisances is not None:
        columns = np.hstack([columns, nuisances])
    known = np.zeros((columns.shape[1], 2))
    known[: len(kept)] = fitted.linearised.known[kept]
    fit = Linearised(columns[rows], fitted.residual[rows], known)
    return block_robust(estimator, fit, own, coefficients, rows, laws)


def block_robust(
    estimator: Estimator,
    fit: Linearised,
    own: list[int],
    coefficients: FloatArray,
    rows: BoolArray | slice = slice(None),
    laws: FloatArray | None = None,
) -> float:
    """Returns the block-robust chi square of ``coefficients``, those of the columns ``own`` of a fit."""
    time_s = estimator.time_s[rows]
    if len(time_s) < LEAST_POINTS:
        return 0.0
    inverse = fit.directions @ fit.directions[own].T
    coefficients = coefficients + fit.directions[own] @ fit.slack
    influence = (fit.columns @ inverse) * (fit.residual - fit.basis @ fit.slack)[:, np.newaxis]
    # The noise model sets a lower limit, because a residual may be smaller than the noise by chance.
    least = 0.25 * inverse[own] + inverse.T @ (np.maximum(fit.known[:, :1], 0.0) * inverse)
    longest_s = estimator.data.period_s * len(estimator.data.full) / LEAST_BLOCKS
    if laws is not None:
        shift = fit.taken_over(laws[rows])[own]
        least = least + shift @ shift.T
    spreads = [sandwich(influence, of_length(time_s, min(each, longest_s))) + least for each in BLOCKS_S]
    return min(float(coefficients @ solve_symmetric(each, coefficients)) for each in spreads)


def gate(estimator: Estimator, fitted: Fitted, place: int) -> Gate:
    """Runs the acceptance tests for the effect at ``place``."""
    effect = fitted.hypothesis.effects[place]
    shapes = sum(fitted.parameters[each].shape for each in fitted.places(place))
    needed = estimator.scales.robust + estimator.scales.robust_more * (len(evident(effect)) + shapes - 1)
    laws = law_discrepancies(estimator, fitted.hypothesis.without(place))
    robust = robust_chi_square(estimator, fitted, place, laws=laws)
    if robust < needed:
        if robust_chi_square(estimator, fitted, place) < needed:
            return Gate(robust, needed, "not seen in enough independent stretches")
        return Gate(robust, needed, "may be an error in the law of another cause")
    if shapes and robust_chi_square(estimator, fitted, place, laws=laws, free=True) < needed:
        return Gate(robust, needed, "the record does not determine its size and shape")
    if effect.tracker().memory_deg > 0.0:
        others = fitted.hypothesis.without(place)
        laws = np.hstack([laws, estimator.turn_discrepancy(others.effects, others.start)])
        robust = min(robust, robust_chi_square(estimator, fitted, place, laws=laws))
        if robust < needed:
            return Gate(robust, needed, "may be errors of the turning points")
        free = estimator.weighted(estimator.free_loop(fitted.hypothesis.start).columns)
        robust = min(robust, robust_chi_square(estimator, fitted, place, free, laws=laws))
        if robust < needed:
            return Gate(robust, needed, "an elastic loop of another shape explains it as well")
    stretch = effect.shows(estimator.motion)
    if stretch is not None:
        rows = stretch.rows[estimator.index]
        others = fitted.hypothesis.without(place)
        laws = np.hstack([laws, estimator.angle_discrepancy(others.effects, others.start)])
        robust = min(robust, robust_chi_square(estimator, fitted, place, rows=rows, laws=laws))
        if robust < needed:
            return Gate(robust, needed, stretch.otherwise)
    changes = _changes(estimator, fitted, place)
    return Gate(robust, needed, "not the same everywhere" if changes else "")


def gate_of_change(estimator: Estimator, fitted: Fitted, without: Fitted) -> Gate:
    """Runs the tests for a change of a part of the model; ``without`` is the fit with this part unchanged."""
    change = without.residual - fitted.residual
    columns = np.column_stack([without.tangent, change])
    known = np.vstack([without.linearised.known, np.zeros(2)])
    fit = Linearised(columns, without.residual, known)
    turns = estimator.turn_discrepancy(without.hypothesis.effects, without.hypothesis.start)
    laws = np.hstack([law_discrepancies(estimator, without.hypothesis), turns])
    robust = block_robust(estimator, fit, [without.count()], np.zeros(1), laws=laws)
    needed = estimator.scales.robust
    return Gate(robust, needed, "may be errors of the turning points" if robust < needed else "")


def evident(effect: Effect) -> list[int]:
    """Returns the indices of the coefficients that are evidence of an effect: all but the incidental ones."""
    named = effect.named_coefficients()
    return [column for each in named if each.name not in effect.incidental for column in each.columns]


def law_discrepancies(estimator: Estimator, hypothesis: Hypothesis) -> FloatArray:
    """Returns the uncertainties of the laws of a hypothesis's effects as weighted columns, shape (m, k)."""
    forms = [estimator.law_discrepancy(each, hypothesis.start) for each in hypothesis.effects]
    return side_by_side(forms, len(estimator.index))


def all_pieces_seen(estimator: Estimator, fitted: Fitted, place: int) -> bool:
    """Returns True if each component of a finding exceeds the noise and the law errors of larger effects."""
    effect = fitted.hypothesis.effects[place]
    pieces = range(len(effect.coefficients()))
    if not effect.inexact or len(pieces) != len(effect.pieces()):
        return True
    robust = [robust_chi_square(estimator, fitted, place, only=each) for each in pieces]
    return min(robust) > max(estimator.scales.robust, effect.inexact * max(robust))


def _changes(estimator: Estimator, fitted: Fitted, place: int) -> bool:
    """Returns True if a parameter that must be constant changes significantly along the record.

    See `Effect.changing`.
    """
    effect, own = fitted.hypothesis.effects[place], fitted.places(place)
    for number, piece in enumerate(effect.pieces()):
        changing = piece.changing(estimator.motion)
        if changing is None:
            return False
        refitted = [i for i in own if i == own[number] or fitted.parameters[i].shape]
        columns = np.hstack([fitted.tangent[:, own[[number]]], estimator.weighted(changing[estimator.index])])
        others = np.setdiff1d(np.arange(fitted.count()), refitted)
        gram, moment = fitted.linearised.of(others).left(columns)
        step = np.linalg.lstsq(gram, moment, rcond=1e-10)[0]
        along = float(effect.coefficients()[number]) + np.cumsum(step)
        scales = estimator.scales
        differs = float(np.ptp(along)) > scales.bend * float(np.max(np.abs(along)))
        if differs and float(moment @ step) > scales.robust:
            return True
    return False
