"""Second thoughts on what a search has picked: swap and prune.

A swap takes each finding out and puts the best one in its place, which cures most wrong first picks. What
remembers the path is fitted anew from each of its shapes. Pruning takes out what no longer earns its keep
among the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from hdbridge.diagnose.search import Search, Trail
from hdbridge.estimation.hypothesis import Estimator, Fitted


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

    def least(fitted: Fitted) -> tuple[int, str] | None:
        effects = fitted.hypothesis.effects
        gains = {
            place: search.estimator.fit(fitted.hypothesis.without(place)).chi_square - fitted.chi_square
            for place in range(search.base, len(effects))
        }
        toll = {
            each: search.scales.penalty * len(fitted.places(each)) + search.scales.enter for each in gains
        }
        place = min(gains, key=lambda each: gains[each] - toll[each], default=-1)
        if place < 0:
            return None
        small = search.peak(fitted, place) < search.scales.floor_arcsec
        # What the law of a large one gets wrong looks like a small one of its kind.
        alike = [each for each in gains if each != place and effects[each].name == effects[place].name]
        share = effects[place].inexact * max((gains[each] for each in alike), default=0.0)
        needed = max(toll[place], search.scales.leftover * max(gains.values()), share)
        return None if gains[place] > needed and not small else (place, "")

    return eliminated(search.estimator, fitted, search.base, least, [])


def eliminated(
    estimator: Estimator,
    fitted: Fitted,
    base: int,
    worst: Callable[[Fitted], tuple[int, str] | None],
    told: list[str],
) -> Fitted:
    """Without what is ``worst`` (its place, and why it goes), one after the other; the others fitted again.

    What went is appended to ``told`` in words. The effects of the baseline, the first ``base``, stay.
    """
    while len(fitted.hypothesis.effects) > base and (found := worst(fitted)) is not None:
        place, why = found
        told.append(f"{fitted.hypothesis.effects[place].name}: {why}")
        fitted = estimator.fit(fitted.hypothesis.without(place))
    return fitted
