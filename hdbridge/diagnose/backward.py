"""Second thoughts on what a search has picked: swap, merge, prune.

A swap takes each finding out and puts the best one in its place, which cures most wrong first picks. A merge
does so with two findings that are kin: one cause that explains what they do is more likely than both. Wear is
fitted from several widths. Pruning takes out what no longer earns its keep among the others.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from hdbridge.diagnose.candidates import candidates
from hdbridge.diagnose.search import (
    ENTER,
    FEW,
    FLOOR_ARCSEC,
    PENALTY,
    Search,
    Trail,
    cost,
)
from hdbridge.effects import AmplitudeDrift, Wear
from hdbridge.estimation.hypothesis import Fitted

DIRECTIONAL = frozenset(
    {
        "backlash",
        "wear",
        "amplitude_drift",
        "rate_dependence",
        "velocity_windup",
        "channel_skew",
        "inertial_windup",
        "creep",
    }
)
"""Causes that lie between the two directions of motion, or where one goes over to the other: what the form of
one gets wrong lies there too, and looks like another of them."""
DIRECTIONAL_SHARE = 0.05
"""... so that the second needs this share of the first one's data."""
OVERLAPPING = (
    {"velocity_windup", "channel_skew", "rate_dependence"},
    {"channel_skew", "inertial_windup"},
    {"zero_drift", "count_loss"},
    {"backlash", "wear"},
    {"wear", "amplitude_drift"},
)
"""Causes that are nearer to each other than that."""
OVERLAP_SHARE = 0.15
EXACTLY = 1.1
"""Chi square per point that is more than noise. Where kin together leave noise and without the smaller one
there is more, both are there."""
SIDELINE_SHARE = 0.03
"""A vibration of less than this share of another one's evidence is that one: no source keeps its frequency
and amplitude exactly, and the gear's loop answers it with other frequencies."""
MERGED_SHARE = 0.03
"""One cause in place of two kin may miss this share of what both explain: laws are not exact."""
LEFTOVER = 2e-5
"""Findings of less than this share of the largest one's evidence are leftovers of its linearisation."""


def reconsidered(search: Search, trail: Trail) -> Trail:
    """What is left of a trail, and what stands in for the rest."""
    fitted = trail.fitted
    if len(fitted.hypothesis.effects) - search.base <= FEW:
        fitted = _swapped(search, fitted)
    fitted = _pruned(search, _with_wear_anew(search, fitted))
    fitted = _merged(search, fitted)
    fitted, _ = search.with_best_law(fitted)
    fitted = _pruned(search, fitted)
    fitted, law_gain = search.with_best_law(fitted)
    return replace(trail, fitted=fitted, law_gain=law_gain)


def overlap(one: str, other: str) -> float:
    """Share of the other's evidence that a finding needs, because it may look like what that leaves."""
    if one == other:
        return {"vibration": SIDELINE_SHARE, "local_defect": OVERLAP_SHARE}.get(one, 0.0)
    if any({one, other} <= each for each in OVERLAPPING):
        return OVERLAP_SHARE
    return DIRECTIONAL_SHARE if {one, other} <= DIRECTIONAL else 0.0


def _swapped(search: Search, fitted: Fitted) -> Fitted:
    """Each finding taken out, the law chosen anew, the best one put in its place."""
    for _ in range(2):
        changed = False
        for place in range(search.base, len(fitted.hypothesis.effects)):
            search.forget()
            without, _ = search.with_best_law(search.estimator.fit(fitted.hypothesis.without(place)))
            other = search.best_addition(without)
            if other is not None and cost(other) < cost(fitted) - 5.0:
                fitted, changed = other, True
                break
        if not changed:
            break
    search.forget()
    return fitted


def _with_wear_anew(search: Search, fitted: Fitted) -> Fitted:
    """With wear fitted anew from each width that is offered: from a wide one it ends as part of the loop."""
    for place, effect in enumerate(fitted.hypothesis.effects[search.base :], search.base):
        if isinstance(effect, Wear):
            trials = [
                search.estimator.fit(fitted.hypothesis.instead(place, each.effect))
                for each in candidates(search.estimator.data, fitted.hypothesis.effects[: search.base])
                if isinstance(each.effect, Wear)
            ]
            fitted = min((fitted, *trials), key=cost)
    return fitted


def _merged(search: Search, fitted: Fitted) -> Fitted:
    """Two kin taken out together, and the best one cause put in the place of both."""
    places = range(search.base, len(fitted.hypothesis.effects))
    for one, other in combinations(places, 2):
        kinds = (_kind(search, fitted, one), _kind(search, fitted, other))
        if kinds[0] == kinds[1] or not overlap(*kinds):
            continue
        search.forget()
        without = search.estimator.fit(fitted.hypothesis.without(other).without(one))
        trial = search.best_addition(without)
        if trial is None:
            continue
        both = without.chi_square - fitted.chi_square
        if cost(trial) < cost(fitted) + ENTER + MERGED_SHARE * both:
            search.forget()
            return _merged(search, trial)
    search.forget()
    return fitted


def _pruned(search: Search, fitted: Fitted) -> Fitted:
    """Without what no longer earns its keep among the others."""
    while len(fitted.hypothesis.effects) > search.base:
        gains = {}
        for place in range(search.base, len(fitted.hypothesis.effects)):
            without = search.estimator.fit(fitted.hypothesis.without(place))
            gains[place] = (without.chi_square - fitted.chi_square, without)
        largest = max(gain for gain, _ in gains.values())
        place = min(gains, key=lambda each: gains[each][0] - _toll(fitted, each))
        gain, without = gains[place]
        kinds = {each: _kind(search, fitted, each) for each in gains}
        small = search.peak(fitted, place) < FLOOR_ARCSEC
        count = len(fitted.residual)
        share = max(
            (overlap(kinds[place], kinds[other]) * gains[other][0] for other in gains if other != place),
            default=0.0,
        )
        if fitted.chi_square < count and without.chi_square > EXACTLY * count:
            share = 0.0  # what a form gets wrong is not made up for down to the noise
        if gain > max(_toll(fitted, place), LEFTOVER * largest, share) and not small:
            break
        fitted = without
    return fitted


def _kind(search: Search, fitted: Fitted, place: int) -> str:
    """The cause, for its kin; a drift of amplitudes that is one of ripple lies in both directions alike."""
    effect = fitted.hypothesis.effects[place]
    if isinstance(effect, AmplitudeDrift):
        parts = search.estimator.columns(effect, fitted.hypothesis.start) * effect.coefficients()
        ripple, friction = np.std(parts, axis=0)
        if ripple > friction:
            return "ripple"
    return effect.name


def _toll(fitted: Fitted, place: int) -> float:
    return PENALTY * len(fitted.places(place)) + ENTER
