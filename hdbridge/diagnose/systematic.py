"""Systematic errors of parameters: what moves them and leaves nothing in the residual.

No sandwich over blocks sees them, for they are the same in the whole record. Each is a column with a
standard deviation of its own, and moves the parameters as the fit takes it over: the form of a law, as its
effect says it may differ, and what only a measured channel's noise distinguishes from a finding (a mass off
centre winds the gear up once per turn, as a run-out of the load encoder goes once per turn).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hdbridge.diagnose.lookalikes import lookalikes
from hdbridge.effects import CATALOGUE, Effect, FloatArray, aliases_of
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.estimation.screening import proposed


class Confounded(NamedTuple):
    """Another cause that may have taken a part of a finding, or added to it, unseen."""

    name: str
    shift: FloatArray
    """Of the fit's parameters by one standard deviation of what is left of it unseen, shape (p, k)."""


def confounded(estimator: Estimator, fitted: Fitted, place: int) -> Iterator[Confounded]:
    """Causes of which one of typical size beside the effect at ``place`` would not be seen."""
    effects, scales = fitted.hypothesis.effects, estimator.scales
    held = zip(fitted.parameters, fitted.information.tolist(), strict=True)
    known = {each.effect for each, information in held if information}  # as calibrated, not changed
    if place in known:
        return
    for other, columns, noise in _alike(estimator, fitted, place):
        theirs = [at for at, each in enumerate(effects) if each.name == other.name]
        if known & set(theirs):
            continue  # its calibration distinguishes the two
        own = np.array([i for i, each in enumerate(fitted.parameters) if each.effect not in theirs])
        fit = fitted.linearised.of(own)
        shift = fit.taken_over(columns)
        left = columns - fit.columns @ shift
        claimed = noise * np.sum(columns**2, axis=0)
        seen, axes = np.linalg.eigh(left.T @ left - np.diag(claimed))
        if seen[0] < scales.enter + scales.penalty:
            moved = np.zeros((fitted.count(), len(seen)))
            moved[own] = shift @ axes / np.sqrt(1.0 + np.maximum(seen, 0.0))
            yield Confounded(other.name, moved)


def systematic(estimator: Estimator, fitted: Fitted) -> FloatArray:
    """What systematic errors add to the covariance of all parameters, shape (p, p)."""
    added = np.zeros((fitted.count(), fitted.count()))
    for place, effect in enumerate(fitted.hypothesis.effects):
        shift = fitted.linearised.taken_over(estimator.law_discrepancy(effect, fitted.hypothesis.start))
        added += shift @ shift.T
        own = fitted.places(place)
        for each in confounded(estimator, fitted, place):
            added[np.ix_(own, own)] += each.shift[own] @ each.shift[own].T
    return added


def _alike(estimator: Estimator, fitted: Fitted, place: int) -> Iterator[tuple[Effect, FloatArray, float]]:
    """Look-alikes by a measured channel: one of them, its weighted columns of typical size, and the share of
    the channel's noise in their squares.
    """
    effect, ratio = fitted.hypothesis.effects[place], estimator.data.ratio
    start = fitted.hypothesis.start
    pairs = [
        (each, type(piece), each)
        for kind, piece in lookalikes(effect, ratio)
        for each in proposed(kind, estimator.data)[:1]
    ]
    look = effect.unmeasured(ratio)
    if look is not None and look.name in aliases_of(effect.name) and look.name in CATALOGUE:
        pairs.append((look, type(look), effect))
    for other, wave, driven in pairs:
        columns = estimator.columns(other, start)
        columns = columns[:, np.ptp(columns, axis=0) > 0.0]
        typical = wave.candidate(ratio).largest_piece_arcsec() / np.maximum(
            np.max(np.abs(columns), axis=0), 1e-9
        )
        square = float(np.sum(estimator.weighted(estimator.columns(driven, start)) ** 2))
        noise = float(np.sum(estimator.channel_noise(driven, start))) / max(square, 1e-300)
        yield other, estimator.weighted(columns * typical), noise
