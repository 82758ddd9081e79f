"""Second thoughts on what a search has picked: swap and prune.

A swap takes each finding out and puts the best one in its place, which cures most wrong first picks. What
remembers the path is fitted anew from each of its shapes. Pruning takes out what no longer earns its keep
among the others.
"""

from __future__ import annotations

from dataclasses import replace

from hdbridge.diagnose.search import Search, Trail
from hdbridge.estimation.hypothesis import Fitted


def reconsidered(search: Search, trail: Trail) -> Trail:
    """What is left of a trail, and what stands in for the rest."""
    fitted = trail.fitted
    if len(fitted.hypothesis.effects) - search.base <= search.scales.few:
        fitted = _swapped(search, fitted)
    fitted = _pruned(search, _loops_anew(search, fitted))
    fitted, law_gain = search.with_best_law(fitted)
    return replace(trail, fitted=fitted, law_gain=law_gain)


def _swapped(search: Search, fitted: Fitted) -> Fitted:
    """Each finding taken out, the law chosen anew, the best one put in its place."""
    for _ in range(2):
        changed = False
        for place in range(search.base, len(fitted.hypothesis.effects)):
            search.forget()
            without, _ = search.with_best_law(search.estimator.fit(fitted.hypothesis.without(place)))
            most = search.cost(fitted)
            other = search.best_addition(without, most)
            if other is not None and search.cost(other) < most:
                fitted, changed = other, True
                break
        if not changed:
            break
    search.forget()
    return fitted


def _loops_anew(search: Search, fitted: Fitted) -> Fitted:
    """With what remembers the path fitted anew from each proposal.

    From a wide one it ends as part of the loop that the model has.
    """
    base = fitted.hypothesis.effects[: search.base]
    for place in range(search.base, len(fitted.hypothesis.effects)):
        effect = fitted.hypothesis.effects[place]
        if effect.tracker().memory_deg > 0.0 and effect.shape:
            trials = [
                search.estimator.fit(fitted.hypothesis.instead(place, each))
                for each in type(effect).proposals(search.estimator.data, base)
            ]
            fitted = min((fitted, *trials), key=search.cost)
    return fitted


def _pruned(search: Search, fitted: Fitted) -> Fitted:
    """Without what no longer earns its keep among the others."""
    while len(fitted.hypothesis.effects) > search.base:
        gains = {}
        for place in range(search.base, len(fitted.hypothesis.effects)):
            without = search.estimator.fit(fitted.hypothesis.without(place))
            gains[place] = (without.chi_square - fitted.chi_square, without)
        largest = max(gain for gain, _ in gains.values())
        place = min(gains, key=lambda each: gains[each][0] - _toll(search, fitted, each))
        gain, without = gains[place]
        small = search.peak(fitted, place) < search.scales.floor_arcsec
        # What the law of a large one gets wrong looks like a small one of its kind.
        effect = fitted.hypothesis.effects[place]
        alike = [
            each for each in gains if each != place and fitted.hypothesis.effects[each].name == effect.name
        ]
        share = effect.inexact * max((gains[each][0] for each in alike), default=0.0)
        if gain > max(_toll(search, fitted, place), search.scales.leftover * largest, share) and not small:
            break
        fitted = without
    return fitted


def _toll(search: Search, fitted: Fitted, place: int) -> float:
    return search.scales.penalty * len(fitted.places(place)) + search.scales.enter
