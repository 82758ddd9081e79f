"""Second looks at what a search has picked: swap and prune.

Each finding is taken out, and the best one put in its place, which cures most wrong first picks. What no
longer earns its keep among the others goes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from hdbridge.diagnose.search import Search, Trail
from hdbridge.effects import Effect
from hdbridge.estimation.hypothesis import Estimator, Fitted


def pruned(search: Search, trail: Trail) -> Trail:
    """What is left of a trail."""

    def least(fitted: Fitted) -> tuple[int, str] | None:
        effects = fitted.hypothesis.effects
        gains = {
            place: search.estimator.fit(fitted.hypothesis.without(place)).chi_square - fitted.chi_square
            for place in range(search.base, len(effects))
        }
        toll = {
            each: search.scales.penalty * len(fitted.places(each)) + search.scales.enter for each in gains
        }
        place = min(gains, key=lambda each: gains[each] - toll[each])
        small = search.peak(fitted, place) < search.scales.floor_arcsec
        # What the law of a large one gets wrong looks like a small one of its kind.
        alike = [each for each in gains if each != place and effects[each].name == effects[place].name]
        share = effects[place].inexact * max((gains[each] for each in alike), default=0.0)
        needed = max(toll[place], search.scales.leftover * max(gains.values()), share)
        return None if gains[place] > needed and not small else (place, "")

    fitted = trail.fitted
    if len(fitted.hypothesis.effects) - search.base <= search.scales.few:
        fitted = _swapped(search, fitted)
    fitted = eliminated(search.estimator, fitted, search.base, least, [])
    fitted, law_gain = search.with_best_law(fitted)
    return replace(trail, fitted=fitted, law_gain=law_gain)


def _swapped(search: Search, fitted: Fitted) -> Fitted:
    """With the best one in the place of each finding that is taken out, and the law chosen anew.

    What a finding has gained with further pieces cost an entry for each when they were added, and does so
    here: what takes its place has entered only once.
    """
    for place in range(search.base, len(fitted.hypothesis.effects)):
        if place >= len(fitted.hypothesis.effects):
            break  # what took another's place has become part of one that was there
        further = _additions(search, fitted.hypothesis.effects[place]) - 1
        most = search.cost(fitted) + search.scales.enter * further
        without, _ = search.with_best_law(search.estimator.fit(fitted.hypothesis.without(place)))
        other = search.best_addition(without, most)
        if other is not None and search.cost(other) < most:
            fitted = other
    return fitted


def _additions(search: Search, effect: Effect) -> int:
    """How often a search has added to a finding: orders come one by one, or those of one cause together."""
    offered = next(iter(type(effect).proposals(search.estimator.data, ())), effect)
    return max(1, len(effect.pieces()) // max(1, len(offered.pieces())))


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
