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
# Places at which a fit may have another minimum.

FILTER, DEAD_TIME = BY_NAME["command filter"], BY_NAME["servo dead time"]
FREQUENCIES_HZ = (11.0, 16.0, 23.0, 33.0, 48.0, 70.0, 100.0)
"""Start values of the load's resonance frequency, because a fit finds only the nearest minimum."""
FILTER_SHARES = (0.25, 0.5, 0.75, 0.9)
"""Start values of the command filter's share of the lag."""
INERTIA_FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Factors for start values of the motor's inertia, which shows only just after each new demand."""


def elsewhere(truth: Truth, usual: Truth) -> tuple[list[Truth], ...]:
    """Returns other start values about a truth, by kind; ``usual`` is the start of the fit."""
    return springs(truth), delays(truth), feedforwards(truth, usual), inertias(truth)


def springs(truth: Truth) -> list[Truth]:
    """Returns the truth with the load's resonance at other frequencies that its time step resolves."""
    inertia, now = truth.load_.whole_inertia_kg_m2, truth.gear.stiffness_nm_per_rad
    found = []
    for hz in FREQUENCIES_HZ:
        stiffness = inertia * (math.tau * hz) ** 2
        damping = truth.gear.damping_nm_s_per_rad * math.sqrt(stiffness / now)
        if stiffness < 0.9 * truth.highest_stiffness_nm_per_rad:
            found.append(with_values(truth, {"gear stiffness": stiffness, "gear damping": damping}))
    return found


def lags(truth: Truth) -> list[Truth]:
    """Returns the truth with the same lag divided differently between command filter and dead time."""
    return [_with_dead_time(truth, (1.0 - share) * _lag_ms(truth)) for share in FILTER_SHARES]


def delays(truth: Truth) -> list[Truth]:
    """Returns the truth with the dead time in each other substep within the lag.

    The demand changes slope at the start of a cycle, and a torque lasts for a substep. A change within a
    substep is spread over two, as by a filter, so the dead time has a minimum in every substep.
    """
    step_ms, now = truth.substep_ms, _substep(truth)
    most_ms = min(_lag_ms(truth) - 2.0 * FILTER.least, DEAD_TIME.most)
    places = range(int(most_ms / step_ms + 0.5))
    return [_with_dead_time(truth, (each + 0.5) * step_ms) for each in places if each != now]


def neighbours(truth: Truth) -> list[Truth]:
    """Returns those of `delays` whose dead time is one substep shorter or longer."""
    return [each for each in delays(truth) if abs(_substep(each) - _substep(truth)) == 1]


def as_late(truth: Truth, other: Truth, free: Collection[Parameter]) -> Truth:
    """Returns the truth with the total lag of another one, by the free one of filter and dead time."""
    lag_ms, own = _lag_ms(other), truth.servo
    if FILTER in free:
        return with_values(truth, {FILTER.name: max(0.5 * (lag_ms - own.dead_time_ms), FILTER.least)})
    if DEAD_TIME in free:
        dead_time_ms = max(lag_ms - 2.0 * own.command_filter_ms, DEAD_TIME.least)
        return with_values(truth, {DEAD_TIME.name: dead_time_ms})
    return truth


def inertias(truth: Truth) -> list[Truth]:
    """Returns the truth with other motor inertias; a spring too stiff for the time step becomes softer."""
    motor = [BY_NAME["motor inertia"]]
    (now,) = coordinates(truth, motor)
    return [at_coordinates(truth, motor, [now + math.log(factor)]) for factor in INERTIA_FACTORS]


def _substep(truth: Truth) -> int:
    """Returns the number of the substep in which a delayed demand takes effect."""
    return int(truth.servo.dead_time_ms / truth.substep_ms)


def _lag_ms(truth: Truth) -> float:
    """Returns the total delay of filter and dead time at constant speed; ms."""
    return 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms


def _with_dead_time(truth: Truth, dead_time_ms: float) -> Truth:
    """Returns the truth with another dead time and the same lag."""
    filter_ms = 0.5 * (_lag_ms(truth) - dead_time_ms)
    return with_values(truth, {FILTER.name: filter_ms, DEAD_TIME.name: dead_time_ms})


def feedforwards(truth: Truth, usual: Truth) -> list[Truth]:
    """Returns the truth with other load feed-forward frequencies and the usual division of the inertias."""
    servo, load, there = truth.servo, truth.servo.load_feedforward, usual.servo.load_feedforward
    if load is None or there is None:
        return []
    both = servo.inertia_feedforward_kg_m2 + load.inertia_kg_m2
    share = there.inertia_kg_m2 / (usual.servo.inertia_feedforward_kg_m2 + there.inertia_kg_m2)
    inertias = {"inertia feed-forward": (1.0 - share) * both, "load feed-forward": share * both}
    return [with_values(truth, {**inertias, "load feed-forward frequency": hz}) for hz in FREQUENCIES_HZ]


def exchanged(truth: Truth) -> Truth:
    """Returns the truth with position gain and inverse integral time exchanged.

    In motion this is the same loop, because its response depends only on their sum and product, so there are
    two minima.
    """
    servo = truth.servo
    return with_values(
        truth,
        {"position gain": 1e3 / servo.integral_time_ms, "integral time": 1e3 / servo.position_gain_per_s},
    )


# ----------------------------------------------------------------
# Optional parameters, which a fit adds at the end if the recording shows them.

GROWTH: Final = "friction growth"
LAST: Final = (
    ("velocity feed-forward",),
    ("encoder coupling",),
    (GROWTH,),
    ("friction's rise at rest", "Stribeck speed"),
)
"""Groups of optional parameters; each is added as a whole or not at all."""
LIMIT: Final = BY_NAME["current limit"]
EARNED = 8.0
"""Minimum log likelihood ratio for adding parameters or for leaving the start's minimum: exp(8) to one."""
SURE = 4.0
"""Minimum change of the first parameter of a group of `LAST`; standard deviations."""
EARNED_STEPS = 6
"""Steps of a trial fit with added parameters: the Stribeck speed shows only once the rise is not zero."""
LOOP_STEPS = 10
"""Steps of a trial fit of each loop law on a few legs, all else held."""


class Fitting(NamedTuple):
    """Start of a fit."""

    truth: Truth
    parameters: tuple[Parameter, ...]
    prior: FloatArray
    """Mean of the prior, shape (p,)."""


def with_last(replays: Replays, best: Fitted, prior: FloatArray) -> tuple[Fitted, FloatArray]:
    """Adds the significant groups of `LAST`; returns the fit, not yet at its minimum, and its prior."""
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
    """Returns True if the initial temperatures of the pieces differ by a relevant amount."""
    begun = [each.commands.start_c for each in data.pieces]
    known_c = [each for each in begun if each is not None]
    return len(known_c) == len(begun) and max(known_c) - min(known_c) > BY_NAME["temperature"].least_change


def with_loop(replays: Replays, best: Fitted, prior: FloatArray) -> Fitting | None:
    """Returns the start of a fit with another loop law of the gear, or None if none is better.

    There is none if the load's residuals are as small as those of the true axis, or if no law reduces them.
    Each law is fitted to a few legs, all else held. Call again after a new fit, because another law may then
    be the best.
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
    """Returns the start of a fit of the drive's torque limit if the recording shows it, else the usual limit.

    So far the fit used the highest recorded torque as the limit (`regressions`). It is the drive's limit, and
    not just the torque that the motion needed, if a replay without it has larger residuals.
    """
    highest, unchanged = free_value(usual, LIMIT), Fitting(best.truth, best.parameters, prior)
    if free_value(best.truth, LIMIT) >= highest or LIMIT in best.parameters:
        return unchanged
    without = with_values(best.truth, {LIMIT.name: highest})
    if _cost(replays, without, best) - best.cost > EARNED:
        return Fitting(best.truth, (*best.parameters, LIMIT), np.append(prior, coordinates(usual, [LIMIT])))
    return unchanged._replace(truth=without)


def _cost(replays: Replays, truth: Truth, best: Fitted) -> float:
    """Returns half the sum of squares of a truth's residuals, by the scales of a fit."""
    (found,) = replays([truth])
    left = told(found, best.scales, fitted_rows(replays.data))
    return 0.5 * float(left @ left)


# ----------------------------------------------------------------

FIT_S = 60.0
"""Duration of the pieces on which a longer recording is fitted, with all kinds of motion if possible: a
thousand replays of a quarter of an hour would take hours."""
FIRST_STEPS = 6
"""Steps from each start; as many again from the first and the best of the others, and from the better of
these with its gains exchanged."""
MORE_STEPS = 10
"""Further steps from the first start and the best of the others."""
FEW_STEPS = 4
"""First steps from each place that is tried as another minimum."""
NEAR_STEPS = 30
"""Maximum steps over the whole recording with the expected noise."""
STEPS = 30
"""Maximum steps of the final fit."""
LOOPS = 6
"""Number of replays with quantised loops, and of smooth ones, that show the difference."""
ROUNDS = 3
"""Maximum number of times that the difference of the loops is estimated again at the new place."""
SAME = 0.3
"""Change of the coordinates below which this ends; standard deviations."""
MORE = 1.1
"""Ratio to the true axis's residuals above which a fit leaves more; a scale is not known better than that."""
MINIMA = 8
"""Maximum number of moves to a better minimum. The likelihood uses the loops' deviation at the present one,
so each of two minima may look better from the other."""
NEAREST = 2
"""Number of places of each kind that are followed up."""
APART = 0.1
"""Distance below which two fits converge to the same place; spreads of a parameter."""
OPTIONAL = (
    "velocity feed-forward", "load friction", "temperature", "current limit", "motor encoder delay",
    "encoder coupling", "friction growth", "moving average", *LOOP,
)  # fmt: skip
"""Parameters fitted only on request or if significant: ordinary motion does not show them, others can replace
them, or a calibration has determined them."""


def free_parameters(truth: Truth, more: Sequence[str] = ()) -> tuple[Parameter, ...]:
    """Returns the parameters to fit: all that the truth has, except `OPTIONAL` ones not in ``more``."""
    free = []
    for each in PARAMETERS:
        value = value_in(truth, each)
        absent = value is None or (value <= each.least and not each.linear)
        if not absent and (each.name not in OPTIONAL or each.name in more):
            free.append(each)
    return tuple(free)


def fit(replays: Replays, progress: Progress = lambda _: None, more: Sequence[str] = ()) -> Fitted | None:
    """Fits the parameters, starting from the truth that the recordings were prepared with.

    Returns None if its servo explains too little of the recordings: see `hdbridge.twin.structures`.
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
        # The residuals of a wrong simulation are no estimate of the noise: they would reduce the weight of
        # the very channel that shows the error.
        if each.inflation < SOFT**2:
            about = loops_about(replays, each)
            near = _led(replays, parameters, prior, each.truth, NEAR_STEPS, each, about)
            ends.append(_ended(replays, near, prior, most))
    if not ends:
        return None
    progress(0.6)
    best = min(ends, key=lambda each: each.loss + (EARNED if each is not ends[0] else 0.0))
    laws = len(LAWS)  # maximum number of changes
    while True:
        best = _in_best_minimum(replays, best, begun, prior, most)
        wider, prior = with_last(replays, best, prior)
        if wider is not best:
            best = _ended(replays, wider, prior, most)
            continue
        # The loop comes last, because a wrong spring also leaves residuals of the load angle.
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
    # Wide differences only for the covariance: near a minimum the loops may be unstable.
    loops, there = best.scales.loops, best.truth
    best = solve(replays, there, best.parameters, prior, 0, most=most, near=best, loops=loops, wide=True)
    progress(1.0)
    # The loops' deviation belongs to these rows; later callers use others.
    return replace(best, scales=replace(best.scales, loops=None))


def _in_best_minimum(replays: Replays, best: Fitted, begun: Truth, prior: FloatArray, most: Scales) -> Fitted:
    """Moves the fit to better neighbouring minima until there are none."""
    for _ in range(MINIMA):
        last = best
        if _leaves_more(replays.data, best):
            for there in better_places(replays.rough, best, elsewhere(best.truth, begun), begun, prior):
                best = _better(replays, best, there, prior, most)
        # Always tried: exchanged gains differ only at rest, which a few legs hardly show, and a dead time in
        # the next substep increases the residuals too little for any channel to show it.
        for there in (exchanged(best.truth), *neighbours(best.truth)):
            best = _better(replays, best, there, prior, most)
        if best is last:
            break
    return best


def _better(replays: Replays, best: Fitted, there: Truth, prior: FloatArray, most: Scales) -> Fitted:
    """Returns the fit from another place if it is significantly better, else ``best``."""
    loops = best.scales.loops
    other = solve(replays, there, best.parameters, prior, MORE_STEPS, most=most, loops=loops)
    if other.loss + EARNED >= best.loss:
        return best
    return _ended(replays, other, prior, most)


def _ended(replays: Replays, near: Fitted, prior: FloatArray, most: Scales) -> Fitted:
    """Continues a fit to its minimum, with the loops' deviation estimated there."""
    loops = loops_about(replays, near)
    return solve(replays, near.truth, near.parameters, prior, STEPS, most=most, near=near, loops=loops)


def _leaves_more(data: Data, best: Fitted) -> bool:
    """Returns True if the residuals of any channel exceed those of the true axis."""
    least = least_deviation(data) | {LOAD: expected(data).deviation[LOAD]}
    return any(best.scales.deviation[name] > MORE * least[name] for name in CHANNELS)


def better_places(
    roughly: Replays, best: Fitted, kinds: Iterable[Sequence[Truth]], begun: Truth, prior: FloatArray
) -> list[Truth]:
    """Fits a few legs from the best places of each kind; returns competitive results, the best first.

    This comes after the other parameters are known, because at the start of the fit these places were equally
    good. A few legs can rule a minimum out but seldom decide between two.
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
    """Returns True if two fits of the same parameters have reached different places."""
    spread = np.array([each.spread for each in one.parameters])
    return bool(np.any(np.abs(one.place - other.place) > APART * spread))


def loops_about(replays: Replays, fitted: Fitted) -> Loops:
    """Estimates the deviation of quantised loops from smooth ones, by draws from the fit's covariance."""
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
    """Fits for at most ``steps`` steps with the expected noise."""
    noise = replace(expected(replays.data), loops=loops)
    return solve(replays, start, parameters, prior, steps, known=noise, near=near, tempered=True)


def _best_of(
    replays: Replays, starts: Sequence[Truth], parameters: tuple[Parameter, ...], prior: FloatArray
) -> tuple[Fitted, ...]:
    """Returns the fit from the first start, and the best from another start if it is better so far.

    The first start is the present simulation: parameters that the motion does not show keep their values
    unless another place is significantly better in the end. Worse starts are dropped on the way.
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
    """Returns the truth with the spring that gives the smallest residuals of the load angle."""
    tried = [truth, *springs(truth)]
    off = [float(np.mean(np.abs(found[LOAD]))) for found in replays(tried)]
    return tried[int(np.argmin(off))]
