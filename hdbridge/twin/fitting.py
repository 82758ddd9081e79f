"""Fitting the plant's parameters to recordings: regressions first, then least squares over replays."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.defaults import with_sections
from hdbridge.twin.least_squares import SOFT, Fitted, Progress, fitted_rows, solve, told
from hdbridge.twin.loop_laws import LAWS, LOOP, by_each_law, loop_parameters
from hdbridge.twin.misfit import CHANNELS, Data
from hdbridge.twin.noise import Loops, Scales, expected, least_deviation, scales
from hdbridge.twin.parameters import (
    BY_NAME,
    ELASTIC,
    LOAD,
    PARAMETERS,
    Parameter,
    at_coordinates,
    coordinates,
    free_value,
    value_in,
    with_values,
)
from hdbridge.twin.regressions import start_of
from hdbridge.twin.replays import Replays

# ----------------------------------------------------------------
# Places where a fit may have a minimum of its own, beside the one that it has come to.

FILTER, DEAD_TIME = BY_NAME["command filter"], BY_NAME["servo dead time"]
FREQUENCIES_HZ = (11.0, 16.0, 23.0, 33.0, 48.0, 70.0, 100.0)
"""Where a resonance of the load is looked for: a fit finds only the nearest of its minima."""
FILTER_SHARES = (0.25, 0.5, 0.75, 0.9)
"""Shares of the lag that may be the command filter's, as long as nothing else is known."""
INERTIA_FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Factors of the motor's inertia, which shows only in the first milliseconds of each new demand."""


def elsewhere(truth: Truth, usual: Truth) -> tuple[list[Truth], ...]:
    """The truth at other places, by what is other there; ``usual`` is where the fit began."""
    return springs(truth), delays(truth), feedforwards(truth, usual), inertias(truth)


def springs(truth: Truth) -> list[Truth]:
    """The truth with springs at which the load resonates elsewhere, as far as its time step resolves them."""
    inertia, now = truth.load_.whole_inertia_kg_m2, truth.gear.stiffness_nm_per_rad
    found = []
    for hz in FREQUENCIES_HZ:
        stiffness = inertia * (math.tau * hz) ** 2
        damping = truth.gear.damping_nm_s_per_rad * math.sqrt(stiffness / now)
        if stiffness < 0.9 * truth.highest_stiffness_nm_per_rad:
            found.append(with_values(truth, {"gear stiffness": stiffness, "gear damping": damping}))
    return found


def lags(truth: Truth) -> list[Truth]:
    """The truth with other shares of command filter and dead time in the same lag."""
    return [_with_dead_time(truth, (1.0 - share) * _lag_ms(truth)) for share in FILTER_SHARES]


def delays(truth: Truth) -> list[Truth]:
    """The truth with a dead time in each other one of the substeps that the lag has room for.

    The demand turns where a cycle begins, and a torque lasts a substep. A turn that comes within one is seen
    in two halves, which is how a filter shows it too: between two whole numbers of substeps the dead time
    has a minimum of its own.
    """
    step_ms, now = truth.substep_ms, _substep(truth)
    most_ms = min(_lag_ms(truth) - 2.0 * FILTER.least, DEAD_TIME.most)
    places = range(int(most_ms / step_ms + 0.5))
    return [_with_dead_time(truth, (each + 0.5) * step_ms) for each in places if each != now]


def neighbours(truth: Truth) -> list[Truth]:
    """Those of `delays` whose dead time is a substep shorter or longer."""
    return [each for each in delays(truth) if abs(_substep(each) - _substep(truth)) == 1]


def as_late(truth: Truth, other: Truth, free: Collection[Parameter]) -> Truth:
    """The truth with the whole lag of another one, by whichever of filter and dead time is free."""
    lag_ms, own = _lag_ms(other), truth.servo
    if FILTER in free:
        return with_values(truth, {FILTER.name: max(0.5 * (lag_ms - own.dead_time_ms), FILTER.least)})
    if DEAD_TIME in free:
        dead_time_ms = max(lag_ms - 2.0 * own.command_filter_ms, DEAD_TIME.least)
        return with_values(truth, {DEAD_TIME.name: dead_time_ms})
    return truth


def inertias(truth: Truth) -> list[Truth]:
    """The truth with other inertias of the motor; a spring too stiff for the time step becomes softer."""
    motor = [BY_NAME["motor inertia"]]
    (now,) = coordinates(truth, motor)
    return [at_coordinates(truth, motor, [now + math.log(factor)]) for factor in INERTIA_FACTORS]


def _substep(truth: Truth) -> int:
    """The number of the substep in which a delayed demand comes."""
    return int(truth.servo.dead_time_ms / truth.substep_ms)


def _lag_ms(truth: Truth) -> float:
    """What filter and dead time are late by together, at a constant speed."""
    return 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms


def _with_dead_time(truth: Truth, dead_time_ms: float) -> Truth:
    """The truth with another share of the dead time in its lag."""
    filter_ms = 0.5 * (_lag_ms(truth) - dead_time_ms)
    return with_values(truth, {FILTER.name: filter_ms, DEAD_TIME.name: dead_time_ms})


def feedforwards(truth: Truth, usual: Truth) -> list[Truth]:
    """The truth with the load's feed-forward at other frequencies, and its usual share of both inertias'."""
    servo, load, there = truth.servo, truth.servo.load_feedforward, usual.servo.load_feedforward
    if load is None or there is None:
        return []
    both = servo.inertia_feedforward_kg_m2 + load.inertia_kg_m2
    share = there.inertia_kg_m2 / (usual.servo.inertia_feedforward_kg_m2 + there.inertia_kg_m2)
    inertias = {"inertia feed-forward": (1.0 - share) * both, "load feed-forward": share * both}
    return [with_values(truth, {**inertias, "load feed-forward frequency": hz}) for hz in FREQUENCIES_HZ]


def exchanged(truth: Truth) -> Truth:
    """The truth with position gain and the inverse of the integral time exchanged.

    While the axis moves that is the same loop, for only their sum and their product are in its answer: each
    of the two has a minimum of its own.
    """
    servo = truth.servo
    return with_values(
        truth,
        {"position gain": 1e3 / servo.integral_time_ms, "integral time": 1e3 / servo.position_gain_per_s},
    )


# ----------------------------------------------------------------
# What a fit takes in where the recording shows it, once all else is known: parameters that earn their place.

GROWTH: Final = "friction growth"
LAST: Final = (
    ("velocity feed-forward",),
    ("encoder coupling",),
    (GROWTH,),
    ("friction's rise at rest", "Stribeck speed"),
)
"""Taken in together or not at all."""
LIMIT: Final = BY_NAME["current limit"]
EARNED = 8.0
"""Half the drop of the scaled squares that these have to bring, and a place that is not the start's to be
gone on from: exp(8) to one."""
SURE = 4.0
"""... and the distance of the first one of `LAST` from where it was, in standard deviations."""
EARNED_STEPS = 6
"""Steps that show whether they are: how fast friction falls off is seen only once it is known to."""
LOOP_STEPS = 10
"""... and of a loop by each law, all else held, on a few legs."""


class Fitting(NamedTuple):
    """Where a fit is to begin."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    prior: FloatArray
    """The coordinates that their prior is about."""


def with_last(replays: Replays, best: Fitted, prior: FloatArray) -> tuple[Fitted, FloatArray]:
    """A fit with those of `LAST` that earn it, not yet led to the minimum, and what its prior is about."""
    for names in LAST:
        extra = [BY_NAME[name] for name in names if BY_NAME[name] not in best.parameters]
        if not extra or (GROWTH in names and not _warms(replays.data)):
            continue
        wider, there = (*best.parameters, *extra), with_sections(best.truth, extra)
        around = np.append(prior, coordinates(there, extra))
        tried = solve(replays, there, wider, around, EARNED_STEPS, known=best.scales)
        new = len(best.parameters)
        off = abs(float(tried.place[new] - around[new]))
        sure = off > SURE * math.sqrt(float(tried.covariance[new, new]))
        if sure and best.cost - tried.cost > EARNED:
            best, prior = tried, around
    return best, prior


def _warms(data: Data) -> bool:
    """Whether the pieces began at temperatures that differ by as much as matters."""
    begun = [each.commands.start_c for each in data.pieces]
    known_c = [each for each in begun if each is not None]
    return len(known_c) == len(begun) and max(known_c) - min(known_c) > BY_NAME["temperature"].least_change


def with_loop(replays: Replays, best: Fitted, prior: FloatArray) -> Fitting | None:
    """Where a fit with another loop of the gear begins; None where nothing speaks for one.

    That is where the load's angle is left with no more than the true axis would leave, or no law makes that
    better. Each law is led to what explains a few legs, all else held: another may be the nearest once all
    else is fitted to the first, so this is asked again then.
    """
    noise, few = expected(replays.data), replays.rough
    if best.scales.deviation[LOAD] <= noise.deviation[LOAD]:
        return None
    led, fitted = [], any(each.cause == ELASTIC for each in best.parameters)
    for there in by_each_law(best.truth)[fitted:]:
        own = loop_parameters(there)
        if own:
            around = np.array(coordinates(there, own))
            led.append((solve(few, there, own, around, LOOP_STEPS, known=noise), around))
    if not led:
        return None
    nearest, around = min(led, key=lambda each: each[0].cost)
    if best.cost - _cost(replays, nearest.truth, best) < EARNED:
        return None
    rest = [number for number, each in enumerate(best.parameters) if each.cause != ELASTIC]
    parameters = (*(best.parameters[number] for number in rest), *nearest.parameters)
    return Fitting(nearest.truth, parameters, np.append(prior[rest], around))


def with_limit(replays: Replays, best: Fitted, prior: FloatArray, usual: Truth) -> Fitting:
    """Where a fit with the drive's torque limit begins, if the recording shows it; else the usual limit's.

    The fit has gone on within the highest torque that the recording holds (`regressions`): no motion that it
    shows needs more. That this is the drive's limit, and not as much as was needed, shows in what a replay
    without it leaves.
    """
    highest, unchanged = free_value(usual, LIMIT), Fitting(best.truth, best.parameters, prior)
    if free_value(best.truth, LIMIT) >= highest or LIMIT in best.parameters:
        return unchanged
    without = with_values(best.truth, {LIMIT.name: highest})
    if _cost(replays, without, best) - best.cost > EARNED:
        return Fitting(best.truth, (*best.parameters, LIMIT), np.append(prior, coordinates(usual, [LIMIT])))
    return unchanged._replace(truth=without)


def _cost(replays: Replays, truth: Truth, best: Fitted) -> float:
    """Half the sum of squares of what a truth leaves, by the scales of a fit."""
    (found,) = replays([truth])
    left = told(found, best.scales, fitted_rows(replays.data))
    return 0.5 * float(left @ left)


# ----------------------------------------------------------------

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
