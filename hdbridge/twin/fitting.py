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
from hdbridge.twin.minima import elsewhere, exchanged, lags, springs
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
from hdbridge.twin.scales import Loops, Scales, scales

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
OPTIONAL = (
    "velocity feed-forward", "load friction", "temperature", "current limit", "motor encoder delay",
    "friction growth", *LOOP,
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


def fit(replays: Replays, progress: Progress = lambda _: None, more: Sequence[str] = ()) -> Fitted:
    """From the truth that the recordings were prepared with to the parameters that explain them best."""
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
            near = _led(replays, parameters, prior, each.truth, NEAR_STEPS, each)
            ends.append(solve(replays, near.truth, parameters, prior, STEPS, most=most, near=near))
    if not ends:
        # This axis has what no simulation has, in the channel that led the way. By the noise, however
        # tempered, the others had no say; by what each of them is left with they have.
        ends = [solve(replays, begun, parameters, prior, STEPS, most=most)]
    progress(0.6)
    best = min(ends, key=lambda each: each.loss + (EARNED if each is not ends[0] else 0.0))
    laws = len(LAWS)  # so often at most another one is taken
    while True:
        if _leaves_more(data, best):
            for there in better_places(roughly, best, elsewhere(best.truth, begun), begun, prior):
                best = _better(replays, best, there, prior, most)
        # A rough fit knows little of what the two gains do at rest, where only they differ.
        best = _better(replays, best, exchanged(best.truth), prior, most)
        wider, prior = with_last(replays, best, prior)
        if wider is not best:
            best = solve(replays, wider.truth, wider.parameters, prior, STEPS, most=most, near=wider)
            continue
        # What a wrong spring leaves of the load's angle is no matter of the loop: that is asked last.
        other = with_loop(replays, best, prior) if laws else None
        if other is None:
            break
        laws, prior = laws - 1, other.prior
        best = solve(replays, other.truth, other.parameters, prior, STEPS, most=most)
    limited = with_limit(replays, best, prior, start)
    best = replace(best, truth=limited.truth)
    if limited.parameters != best.parameters:
        prior = limited.prior
        best = solve(replays, best.truth, limited.parameters, prior, STEPS, most=most)
    progress(0.85)
    for _ in range(ROUNDS):
        last, loops = best, loops_about(replays, best)
        best = solve(replays, best.truth, best.parameters, prior, STEPS, most=most, near=best, loops=loops)
        if np.all(np.abs(best.place - last.place) < SAME * np.sqrt(np.diag(best.covariance))):
            break
    # So much longer differences are no guide to a minimum: next to it the loops may be unstable.
    best = solve(replays, best.truth, best.parameters, prior, 0, most=most, near=best, loops=loops, wide=True)
    progress(1.0)
    return best


def _better(replays: Replays, best: Fitted, there: Truth, prior: FloatArray, most: Scales) -> Fitted:
    """The fit from another place, if that is beyond doubt better."""
    other = solve(replays, there, best.parameters, prior, MORE_STEPS, most=most)
    if other.loss + EARNED >= best.loss:
        return best
    return solve(replays, other.truth, best.parameters, prior, STEPS, most=most, near=other)


def _leaves_more(data: Data, best: Fitted) -> bool:
    """Whether a fit leaves more of any channel than the true axis would."""
    noise = expected(data).deviation
    return any(best.scales.deviation[name] > noise[name] for name in CHANNELS)


def better_places(
    roughly: Replays, best: Fitted, kinds: Iterable[Sequence[Truth]], begun: Truth, prior: FloatArray
) -> list[Truth]:
    """Of each kind of places the one that is led to a better fit of a few legs, if one is.

    The other parameters are known by now: where the fit began, each of these was as good as any other.
    """
    (before,) = roughly([begun])
    most = scales(roughly.data, before)

    def led(truth: Truth, steps: int, near: Fitted | None = None) -> Fitted:
        return solve(roughly, truth, best.parameters, prior, steps, most=most, near=near)

    def loss(fitted: Fitted) -> float:
        return fitted.loss

    own = led(best.truth, FEW_STEPS + FIRST_STEPS)
    found = []
    for places in kinds:
        if places:
            nearest = min((led(each, FEW_STEPS) for each in places), key=loss)
            reached = led(nearest.truth, FIRST_STEPS, nearest)
            if reached.loss + EARNED < own.loss:
                found.append(reached.truth)
    return found


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
) -> Fitted:
    """So many steps from a place towards the minimum, by the noise that is expected."""
    noise = expected(replays.data)
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
