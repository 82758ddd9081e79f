"""Fitting the plant's parameters to recordings: regressions first, then least squares over replays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.earned import EARNED, with_last, with_limit, with_loop
from hdbridge.twin.least_squares import SOFT, Fitted, Progress, solve
from hdbridge.twin.loop_laws import LAWS, LOOP
from hdbridge.twin.minima import elsewhere, exchanged, lags, neighbours, springs
from hdbridge.twin.misfit import CHANNELS, Data
from hdbridge.twin.noise import expected
from hdbridge.twin.parameters import (
    LOAD,
    PARAMETERS,
    Parameter,
    at_coordinates,
    coordinates,
    value_in,
)
from hdbridge.twin.regressions import start_of
from hdbridge.twin.replays import Replays
from hdbridge.twin.scales import Loops, Scales, least_deviation, scales

FIT_S = 60.0
"""A longer recording is fitted on parts of it that take the axis about so long, of each kind of motion where
there is time: a thousand replays of a quarter of an hour would take hours."""
FIRST_STEPS = 6
"""From each of the starts a fit goes so many steps, as many more from the first and the best of the others,
and as many from the better of these with its gains exchanged;"""
MORE_STEPS = 10
"""... then so many from the first, and the best of what else there is."""
FEW_STEPS = 4
"""From each of the places that are tried in the end, first."""
NEAR_STEPS = 30
"""Steps at most over all of the recording, by the noise that is expected;"""
STEPS = 30
"""... and to the end."""
LOOPS = 6
"""Replays with a drive's steps, and as many smooth ones, that show what these do."""
ROUNDS = 3
"""So often at most that is looked at anew, where the fit has gone;"""
SAME = 0.3
"""... that is, by more than so many standard deviations."""
MORE = 1.1
"""So many times what the true axis would leave is more: a scale of some hundred rows is known no better."""
MINIMA = 8
"""So often at most a fit goes on to a better minimum. Each is judged by what a drive's steps do there, so
that of two minima each may look better from the other."""
NEAREST = 2
"""So many of the places of a kind are looked at more closely."""
APART = 0.1
"""In spreads of a parameter: fits that have come closer than this are on their way to the same place."""
OPTIONAL = (
    "velocity feed-forward", "load friction", "temperature", "current limit", "motor encoder delay",
    "encoder coupling", "friction growth", "moving average", *LOOP,
)  # fmt: skip
"""Not fitted unless asked for or earned: the ordinary motion does not show them, others can take their
place, or a calibration has told them."""


def free_parameters(truth: Truth, more: Sequence[str] = ()) -> tuple[Parameter, ...]:
    """What a fit changes: every parameter that the truth has, without those that need to be asked for."""
    free = []
    for each in PARAMETERS:
        value = value_in(truth, each)
        absent = value is None or (value <= each.least and not each.linear)
        if not absent and (each.name not in OPTIONAL or each.name in more):
            free.append(each)
    return tuple(free)


def fit(replays: Replays, progress: Progress = lambda _: None, more: Sequence[str] = ()) -> Fitted | None:
    """From the truth that the recordings were prepared with to the parameters that explain them best.

    None if its servo explains too little of them: see `hdbridge.twin.structures`.
    """
    data, roughly = replays.data, replays.rough
    start = data.base
    begun = start_of(start, data)
    parameters = free_parameters(begun, more)
    prior = np.array(coordinates(begun, parameters))
    begun = _at_best_frequency(roughly, begun)
    progress(0.1)
    first = _best_of(roughly, [begun, *lags(begun)], parameters, prior)
    progress(0.2)
    (before,) = replays([start])
    most = scales(data, before)
    ends = []
    for number, each in enumerate(first):
        progress(0.2 + 0.4 * number / len(first))
        # What a wrong simulation leaves is no measure of the noise: it makes light of the very channel
        # that tells it from the right one.
        if each.inflation < SOFT**2:
            about = loops_about(replays, each)
            near = _led(replays, parameters, prior, each.truth, NEAR_STEPS, each, about)
            ends.append(_ended(replays, near, prior, most))
    if not ends:
        return None
    progress(0.6)
    best = min(ends, key=lambda each: each.loss + (EARNED if each is not ends[0] else 0.0))
    laws = len(LAWS)  # so often at most another one is taken
    while True:
        best = _in_best_minimum(replays, best, begun, prior, most)
        wider, prior = with_last(replays, best, prior)
        if wider is not best:
            best = _ended(replays, wider, prior, most)
            continue
        # What a wrong spring leaves of the load's angle is no matter of the loop: that is asked last.
        other = with_loop(replays, best, prior) if laws else None
        if other is None:
            break
        laws, prior = laws - 1, other.prior
        best = solve(replays, other.truth, other.parameters, prior, STEPS, most=most, loops=best.scales.loops)
    limited = with_limit(replays, best, prior, start)
    best = replace(best, truth=limited.truth)
    if limited.parameters != best.parameters:
        prior = limited.prior
        best = solve(
            replays, best.truth, limited.parameters, prior, STEPS, most=most, loops=best.scales.loops
        )
    progress(0.85)
    for _ in range(ROUNDS):
        last = best
        best = _ended(replays, best, prior, most)
        if np.all(np.abs(best.place - last.place) < SAME * np.sqrt(np.diag(best.covariance))):
            break
    # So much longer differences are no guide to a minimum: next to it the loops may be unstable.
    loops, there = best.scales.loops, best.truth
    best = solve(replays, there, best.parameters, prior, 0, most=most, near=best, loops=loops, wide=True)
    progress(1.0)
    # What the loops do is told by the recording's rows; those who ask further have others.
    return replace(best, scales=replace(best.scales, loops=None))


def _in_best_minimum(replays: Replays, best: Fitted, begun: Truth, prior: FloatArray, most: Scales) -> Fitted:
    """The fit from the best of the minima about one, until none is better."""
    for _ in range(MINIMA):
        last = best
        if _leaves_more(replays.data, best):
            for there in better_places(replays.rough, best, elsewhere(best.truth, begun), begun, prior):
                best = _better(replays, best, there, prior, most)
        # A few legs know little of what the two gains do at rest, where only they differ, and a dead time
        # of the next substep leaves so little more that no channel shows it.
        for there in (exchanged(best.truth), *neighbours(best.truth)):
            best = _better(replays, best, there, prior, most)
        if best is last:
            break
    return best


def _better(replays: Replays, best: Fitted, there: Truth, prior: FloatArray, most: Scales) -> Fitted:
    """The fit from another place, if that is beyond doubt better."""
    loops = best.scales.loops
    other = solve(replays, there, best.parameters, prior, MORE_STEPS, most=most, loops=loops)
    if other.loss + EARNED >= best.loss:
        return best
    return _ended(replays, other, prior, most)


def _ended(replays: Replays, near: Fitted, prior: FloatArray, most: Scales) -> Fitted:
    """The minimum next to a fit, by rows as they count there."""
    loops = loops_about(replays, near)
    return solve(replays, near.truth, near.parameters, prior, STEPS, most=most, near=near, loops=loops)


def _leaves_more(data: Data, best: Fitted) -> bool:
    """Whether a fit leaves more of any channel, beyond its rounding, than the true axis would."""
    least = least_deviation(data) | {LOAD: expected(data).deviation[LOAD]}
    return any(best.scales.deviation[name] > MORE * least[name] for name in CHANNELS)


def better_places(
    roughly: Replays, best: Fitted, kinds: Iterable[Sequence[Truth]], begun: Truth, prior: FloatArray
) -> list[Truth]:
    """Where fits of a few legs end that begin at the best places of each kind, if as good; the best first.

    The other parameters are known by now: where the fit began, each of these was as good as any other. A few
    legs seldom say which of two minima is the true one: they may only rule one out.
    """
    (before,) = roughly([begun])
    most = scales(roughly.data, before)

    def led(truth: Truth, steps: int, near: Fitted | None = None) -> Fitted:
        return solve(roughly, truth, best.parameters, prior, steps, most=most, near=near)

    def loss(fitted: Fitted) -> float:
        return fitted.loss

    ends = [led(best.truth, STEPS)]
    for places in kinds:
        others = [each for each in (led(place, FEW_STEPS) for place in places) if _apart(each, ends[0])]
        for near in sorted(others, key=loss)[:NEAREST]:
            reached = led(near.truth, STEPS, near)
            if all(_apart(reached, each) for each in ends):
                ends.append(reached)
    least = min(map(loss, ends))
    return [each.truth for each in sorted(ends[1:], key=loss) if each.loss < least + EARNED]


def _apart(one: Fitted, other: Fitted) -> bool:
    """Whether two fits of the same parameters have come to different places."""
    spread = np.array([each.spread for each in one.parameters])
    return bool(np.any(np.abs(one.place - other.place) > APART * spread))


def loops_about(replays: Replays, fitted: Fitted) -> Loops:
    """What a drive's loops do otherwise than smooth ones about a fit, within its covariance."""
    rng = np.random.default_rng(0)
    low, high = np.array([each.bounds for each in fitted.parameters]).T
    places = rng.multivariate_normal(fitted.place, fitted.covariance, LOOPS, method="svd")
    truths = [
        at_coordinates(fitted.truth, fitted.parameters, np.clip(each, low, high).tolist()) for each in places
    ]
    shown = replays([*truths, *truths], [None] * LOOPS + ["loops"] * LOOPS)
    pairs = list(zip(shown[:LOOPS], shown[LOOPS:], strict=True))
    apart = {name: np.stack([other[name] - one[name] for one, other in pairs]) for name in CHANNELS}
    return Loops(
        {name: np.mean(each, axis=0) for name, each in apart.items()},
        {name: np.sqrt(1.0 + 1.0 / LOOPS) * np.std(each, axis=0, ddof=1) for name, each in apart.items()},
    )


def _led(
    replays: Replays,
    parameters: tuple[Parameter, ...],
    prior: FloatArray,
    start: Truth,
    steps: int,
    near: Fitted | None = None,
    loops: Loops | None = None,
) -> Fitted:
    """So many steps from a place towards the minimum, by the noise that is expected."""
    noise = replace(expected(replays.data), loops=loops)
    return solve(replays, start, parameters, prior, steps, known=noise, near=near, tempered=True)


def _best_of(
    replays: Replays, starts: Sequence[Truth], parameters: tuple[Parameter, ...], prior: FloatArray
) -> tuple[Fitted, ...]:
    """The fit from the first place, and beside it that from another one where that is better so far.

    The first is where the simulation stands: what motion does not show keeps its value, unless another place
    is better beyond doubt in the end. Of the others those that fall behind are given up.
    """
    led = partial(_led, replays, parameters, prior)

    def cost(fitted: Fitted) -> float:
        return fitted.cost

    own, *others = (led(each, FIRST_STEPS) for each in starts)
    own, other = (led(each.truth, FIRST_STEPS, each) for each in (own, min(others, key=cost)))
    third = led(exchanged(min(own, other, key=cost).truth), FIRST_STEPS)
    own, other = (led(each.truth, MORE_STEPS, each) for each in (own, min(other, third, key=cost)))
    return (own, other) if other.cost < own.cost else (own,)


def _at_best_frequency(replays: Replays, truth: Truth) -> Truth:
    """The truth with the spring at which the load's angle comes out best."""
    tried = [truth, *springs(truth)]
    off = [float(np.mean(np.abs(found[LOAD]))) for found in replays(tried)]
    return tried[int(np.argmin(off))]
