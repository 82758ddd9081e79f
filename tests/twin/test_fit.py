"""Least squares of a fit: starts, slopes, minima, rounded readings, and the uncertainty of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr
from support.demo import AXIS
from support.demo import TRUTH as DEMO
from support.exercised import moved, record_of

from hdbridge.axis.effects import FloatArray
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import (
    Fitted,
    Jackknife,
    along_valley,
    by_halving,
    continued,
    delays,
    exchanged,
    feedforwards,
    fit,
    lags,
    principal,
    slopes_at,
    solve,
    widened,
)
from hdbridge.twin.misfit import Data, Replays, deviance_residuals, deviation, expected, misfit, prepare
from hdbridge.twin.parameters import (
    BY_NAME,
    FOLLOWING,
    Parameter,
    at_coordinates,
    coordinates,
    free_value,
    named,
    with_values,
)


def test_remaining_descent_is_not_scatter_of_the_legs() -> None:
    rng = np.random.default_rng(1)
    slopes = rng.standard_normal((600, 1)) + 0.01 * rng.standard_normal((600, 3))  # a valley
    spread, legs = np.full(3, 0.7), np.repeat([0, 1], 300)
    white = rng.standard_normal(600)
    for left in (white, white + 5.0 * slopes[:, 0]):
        covariance = Jackknife.over(legs, slopes, left, spread).covariance
        least = np.linalg.inv(slopes.T @ slopes + np.diag(spread**-2.0))
        times = np.linalg.eigvals(covariance @ np.linalg.inv(least)).real
        assert np.all(times > 0.9), "never better than by independent residuals"
        assert np.all(times < 8.0), "nor much worse where they are"
        assert np.all(np.linalg.eigvalsh(covariance / 0.49) < 1.0 + 1e-9), "nor than before the fit"


def test_intervals_cover_the_truth_with_a_dominant_leg() -> None:
    """Each leg has an independent error, and one of the eight legs has as much information as four others."""
    legs = np.repeat(np.arange(8), 50)
    slopes = np.where(legs == 0, 2.0, 1.0)[:, None]
    off = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        own = rng.standard_normal(8)
        seen = slopes[:, 0] * own[legs] + rng.standard_normal(400)
        found = np.linalg.lstsq(slopes, seen, rcond=None)[0]
        left = seen - slopes @ found
        covariance = Jackknife.over(legs, slopes, left, np.full(1, 10.0)).covariance
        off.append(float(found[0]) / float(np.sqrt(covariance[0, 0])))
    assert 0.88 <= np.mean(np.abs(off) < 1.96) <= 0.98


@pytest.mark.parametrize(("size", "low", "high"), [(0.0, 0.3, 2.0), (0.6, 4.0, 15.0), (1.2, 12.0, 60.0)])
def test_legs_agree_about_the_parameters_of_a_right_simulation_only(
    size: float, low: float, high: float
) -> None:
    """A wrong simulation has a smooth error in each leg, which is not larger than the noise."""
    rng = np.random.default_rng(4)
    place, legs = np.linspace(0.0, 1.0, 200), np.repeat(np.arange(20), 200)
    slopes = np.tile(np.column_stack([np.ones(200), place, place**2]), (20, 1))
    bends = np.concatenate([np.sin(np.pi * frequency * place) for frequency in rng.uniform(0.3, 2.0, 20)])
    seen = rng.standard_normal(4000) + size * bends
    left = seen - slopes @ np.linalg.lstsq(slopes, seen, rcond=None)[0]
    between = Jackknife.over(legs, slopes, left, np.full(3, 10.0)).scatter
    assert np.sqrt(np.mean(np.square(left))) < 1.3
    assert low < between < high


def test_a_nearly_unstable_simulation_informs_one_direction_only() -> None:
    rng = np.random.default_rng(2)
    slopes = 1e10 * np.outer(rng.standard_normal(200), [1.0, 2.0, -1.0])
    along = principal(slopes, np.full(3, 0.7))
    assert np.all(np.isfinite(along))
    lengths = np.sort(np.linalg.norm(along, axis=0))
    assert lengths[0] < 1e-9
    np.testing.assert_allclose(lengths[1:], 0.7, rtol=1e-6)


Rows = NDArray[np.float64]
TRUE = np.random.default_rng(3).standard_normal((400, 2))
BOUNDS = (np.full(2, -5.0), np.full(2, 5.0))


def sight(shape: Callable[[Rows], Rows]) -> Callable[[Sequence[Rows]], list[Rows]]:
    return lambda places: [shape(place) for place in places]


def test_wide_differences_average_out_replay_noise() -> None:
    rng = np.random.default_rng(4)
    where, rough = rng.uniform(size=400), 0.2

    def shape(place: Rows) -> Rows:
        """Returns rows that break away earlier or later after any change of the parameters, however small."""
        return TRUE @ place + rough * np.sin(2e3 * where * (1.0 + place.sum()))

    moves = 0.05 * np.eye(2)
    off = [
        float(
            np.linalg.norm(
                slopes_at(sight(shape), shape(np.zeros(2)), np.zeros(2), moves, BOUNDS, wide=wide) - TRUE
            )
        )
        for wide in (True, False)
    ]
    assert off[0] < 0.4 * off[1]


@pytest.mark.parametrize(("at", "wide", "unstable"), [(5.0, True, 9.0), (5.0, False, 9.0), (0.0, True, 0.05)])
def test_slopes_are_taken_within_the_bounds_and_where_the_loops_are_stable(
    at: float, wide: bool, unstable: float
) -> None:
    def shape(place: Rows) -> Rows:
        return TRUE @ place + (1e9 * np.sin(np.arange(400.0)) if place[0] > unstable else 0.0)

    place = np.array([at, 0.0])
    found = slopes_at(sight(shape), shape(place), place, 0.03 * np.eye(2), BOUNDS, wide=wide)
    np.testing.assert_allclose(found, TRUE, atol=1e-9)


SPRUNG = with_values(DEMO, {"load feed-forward frequency": 75.0})


@cache
def data() -> Data:
    """Two quick steps with free ringing of the load after each."""

    steps = moved(*((each, 1500.0, 60_000.0, 0.25) for each in (60.0, -60.0)))
    record = record_of(SPRUNG, steps)
    legs = (Segment(kind="step", start_s=0.0, end_s=float(record.time_s[-1])),)
    return prepare(Recording(record, legs, axis="demo", ratio=50.0), AXIS, SPRUNG)


def test_a_load_feed_forward_that_was_fitted_at_a_wrong_frequency_is_found_at_the_true_one() -> None:
    names = ("inertia feed-forward", "load feed-forward", "load feed-forward frequency")
    parameters = tuple(BY_NAME[name] for name in names)
    begun = with_values(SPRUNG, {"load feed-forward frequency": 20.0})
    with Replays(data(), 1) as replays:
        there = solve(replays, begun, parameters, 3)
        assert free_value(there.truth, parameters[2]) < 40.0, "a minimum of its own"
        tried = [(each, parameters) for each in feedforwards(there.truth, begun)]
        place = by_halving(replays, tried, expected(data())).truth
        found, true = (continued(replays, there, 3, truth=each) for each in (place, SPRUNG))
    assert found.loss < there.loss
    assert free_value(found.truth, parameters[2]) == pytest.approx(
        free_value(true.truth, parameters[2]), rel=0.1
    )


class Counted(Replays):
    """Replays that count themselves."""

    count = 0

    def __call__(self, truths: Iterable[Truth]) -> list[dict[str, FloatArray]]:
        truths = list(truths)
        self.count += len(truths)
        return super().__call__(truths)


def test_no_start_is_tried_after_one_that_suffices() -> None:
    parameters = (BY_NAME["load feed-forward"],)
    begun = [(with_values(SPRUNG, {"load feed-forward": each}), parameters) for each in (1e-6, 2e-6, 4e-6)]
    seen: list[Fitted] = []

    def suffices(fitted: Fitted) -> bool:
        seen.append(fitted)
        return len(seen) == 2

    with Counted(data(), 1) as replays:
        found = by_halving(replays, begun, expected(data()), suffices=suffices)
    assert len(seen) == 2
    assert found.cost <= seen[1].cost
    assert found.truth != seen[0].truth


def test_no_start_is_continued_if_the_best_is_hopeless() -> None:
    parameters = (BY_NAME["load feed-forward"],)
    begun = [(with_values(SPRUNG, {"load feed-forward": each}), parameters) for each in (1e-6, 2e-6, 4e-6)]
    needed, costs = [], []
    for hopeless in (True, False):
        with Counted(data(), 1) as replays:
            found = by_halving(replays, begun, expected(data()), hopeless=lambda _, each=hopeless: each)
        needed.append(replays.count)
        costs.append(found.cost)
    assert needed[0] < needed[1]
    assert costs[0] >= costs[1]


def test_a_fit_that_does_not_approach_its_rival_is_given_up() -> None:
    """At a wrong frequency, both feed-forward inertias approach a minimum far from the true one."""
    parameters = (BY_NAME["inertia feed-forward"], BY_NAME["load feed-forward"])
    begun, needed = with_values(SPRUNG, {"load feed-forward frequency": 20.0}), []
    with Replays(data(), 1) as replays:
        true = solve(replays, SPRUNG, parameters, 0)
    for rival in (None, math.inf, true.loss):
        with Counted(data(), 1) as replays:
            found = solve(replays, begun, parameters, 12, rival=rival)
        assert found.loss > true.loss
        needed.append(replays.count)
    assert needed[2] < min(needed[:2])


LATE = with_values(
    SPRUNG, {"servo dead time": 1.4, "command filter": 0.3, "load feed-forward": 1e-6, "gear stiffness": 2e4}
)


def lag_ms(truth: Truth) -> float:
    return 2.0 * truth.servo.command_filter_ms + truth.servo.dead_time_ms


def fed_forward(truth: Truth) -> float:
    load = truth.servo.load_feedforward
    return truth.servo.inertia_feedforward_kg_m2 + (load.inertia_kg_m2 if load else 0.0)


@pytest.mark.parametrize(
    ("places", "kept"),
    [
        (lags, lag_ms),
        (delays, lag_ms),
        (lambda truth: feedforwards(truth, SPRUNG), fed_forward),
    ],
)
def test_a_start_elsewhere_keeps_known_values(
    places: Callable[[Truth], list[Truth]], kept: Callable[[Truth], float]
) -> None:
    found = places(LATE)
    assert len({each.model_dump_json() for each in found}) == len(found) > 2
    assert [kept(each) for each in found] == pytest.approx([kept(LATE)] * len(found))


def test_without_a_load_feed_forward_there_is_none_elsewhere() -> None:
    servo = SPRUNG.servo.model_copy(update={"load_feedforward": None})
    assert feedforwards(SPRUNG.model_copy(update={"servo": servo}), SPRUNG) == []


@pytest.mark.parametrize(("filter_ms", "dead_time_ms"), [(0.05, 0.0), (0.3, 1.4), (1.0, 0.0), (2.0, 19.9)])
def test_a_dead_time_is_tried_in_each_other_substep_that_the_lag_has_room_for(
    filter_ms: float, dead_time_ms: float
) -> None:
    late = with_values(SPRUNG, {"command filter": filter_ms, "servo dead time": dead_time_ms})
    found, own = {each.servo.dead_time_ms for each in delays(late)}, int(dead_time_ms / late.substep_ms)
    middles = {each: (each + 0.5) * late.substep_ms for each in range(39) if each != own}
    assert found == {each for each in middles.values() if each <= lag_ms(late) - 0.1 + 1e-9}
    assert {each.servo.dead_time_ms for each in delays(late, 1.0)} == {each for each in found if each <= 1.0}


def test_position_gain_and_integral_rate_exchanged_are_the_same_loop_while_the_axis_moves() -> None:
    other = exchanged(SPRUNG)
    softer = with_values(SPRUNG, {"position gain": other.servo.position_gain_per_s})
    with Replays(data(), 1) as replays:
        own, same, wrong = (each[FOLLOWING] for each in replays([SPRUNG, other, softer]))
    moving = data().moving
    assert np.std((same - own)[moving]) < 0.1 * np.std((wrong - own)[moving])
    assert other.servo.position_gain_per_s < 0.5 * SPRUNG.servo.position_gain_per_s
    assert exchanged(other).servo.position_gain_per_s == pytest.approx(SPRUNG.servo.position_gain_per_s)


def test_other_parameters_compensate_a_change_of_the_dead_time_along_the_valley() -> None:
    late = with_values(SPRUNG, {"servo dead time": 1.0})
    parameters = named("command filter", "servo dead time", "inertia feed-forward", "viscous feed-forward")
    with Replays(replace(data(), base=late), 1) as replays:
        best = solve(replays, late, parameters, 0)
        valley = along_valley(best)
        alone = [with_values(late, {"servo dead time": each.servo.dead_time_ms}) for each in valley]
        seen = [best.scales.scaled(each) for each in replays([late, *valley, *alone])]
    changes = [float(np.linalg.norm(each - seen[0])) for each in seen[1:]]
    assert [each.servo.dead_time_ms < 1.0 for each in valley] == [True, False]
    assert max(changes[:2]) < 0.5 * min(changes[2:])
    assert along_valley(replace(best, parameters=parameters[:1])) == []


@given(st.integers(0, 1000), st.lists(st.floats(0.0, 50.0), min_size=1, max_size=4))
def test_intervals_reach_as_far_as_equally_likely_places(seed: int, losses: list[float]) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3, 3)) + 3.0 * np.eye(3)
    fitted: Any = SimpleNamespace(place=np.zeros(3), covariance=root @ root.T, loss=100.0)
    places = 10.0 * rng.standard_normal((len(losses), 3))
    visited = [(place, fitted.loss + more) for place, more in zip(places, losses, strict=True)]
    wide = widened(fitted, visited)
    assert np.all(np.linalg.eigvalsh(wide - fitted.covariance) > -1e-9)
    for place, loss in visited:
        assert place @ np.linalg.solve(wide, place) < 1.0 + 2.0 * (loss - fitted.loss) + 1e-6
    far = [(place, fitted.loss + 1e6) for place in places]
    assert np.array_equal(widened(fitted, far), fitted.covariance)


SERVO = named("position gain", "integral time", "command filter", "servo dead time", "velocity feed-forward")


@given(st.tuples(*(st.floats(0.0, 1.0) for _ in SERVO)))
def test_starts_from_any_servo_within_the_bounds_are_within_them(shares: tuple[float, ...]) -> None:
    place = [low + share * (high - low) for share, (low, high) in zip(shares, bounds(SERVO), strict=True)]
    truth = at_coordinates(SPRUNG, SERVO, place)
    for there in (exchanged(truth), *lags(truth), *delays(truth), *feedforwards(truth, SPRUNG)):
        for each, (low, high) in zip(SERVO, bounds(SERVO), strict=True):
            (now,) = coordinates(there, [each])
            assert low - 1e-9 <= now <= high + 1e-9, each.name


def bounds(parameters: Sequence[Parameter]) -> list[tuple[float, float]]:
    return [each.bounds for each in parameters]


def interrupted_at(least: float) -> Callable[[float], None]:
    def progress(share: float) -> None:
        if share >= least:
            raise KeyboardInterrupt

    return progress


def test_an_interrupted_fit_keeps_the_best_parameters_so_far() -> None:
    wrong = with_values(SPRUNG, {"Coulomb friction": 2.0 * SPRUNG.motor.coulomb_nm})
    with Replays(replace(data(), base=wrong), 1) as replays:
        found = fit(replays, interrupted_at(0.2))
        (before,) = replays([wrong])
    assert found.interrupted
    assert misfit(data(), found.residuals) < 0.5 * misfit(data(), before)


def test_a_fit_interrupted_before_its_first_result_leaves_nothing() -> None:
    with Replays(data(), 1) as replays, pytest.raises(KeyboardInterrupt):
        fit(replays, interrupted_at(0.0))


TRUTH = with_values(DEMO, {"command filter": 1.06})
"""At 90 motor degrees per second, the motor lags by 4.24 counts, but its encoder reads 4."""
PARAMETERS = (BY_NAME["command filter"],)


def sweeps(bench: Exercise) -> None:
    """Moves at whole counts per cycle, so that the motor encoder's error is the same in every row."""
    bench.hold(0.4)
    for speed_deg_s in (90.0, -90.0):
        bench.lead(lambda seconds, speed=speed_deg_s: speed * seconds, 4.0)
    bench.hold(0.2)


def test_rounding_misleads_only_a_fit_that_treats_it_as_noise() -> None:
    recording = Recording(record_of(TRUTH, sweeps), axis="demo", ratio=50.0)
    true = np.array(coordinates(TRUTH, PARAMETERS))
    data = prepare(recording, AXIS, TRUTH)
    with Replays(data, 1) as replays:
        plain = solve(replays, TRUTH, PARAMETERS, 2, known=expected(data))
        fitted = continued(replays, plain, 8)
    (astray,), (off,) = plain.place - true, fitted.place - true
    assert abs(astray) > 2.0 * float(np.sqrt(plain.covariance[0, 0]))
    assert abs(off) < 0.2 * abs(astray)
    assert abs(off) < 1.96 * float(np.sqrt(fitted.covariance[0, 0]))


@pytest.mark.parametrize("half", [0.0, 0.01, 0.3, 4.0])
@pytest.mark.parametrize("outlier_probability", [0.0, 1e-4])
def test_half_the_squares_are_the_loss_of_log_likelihood(half: float, outlier_probability: float) -> None:
    if half == 0.0:
        outlier_probability = 0.0  # no rounding steps: ordinary least squares
    off = np.array([-7.0, -3.9, -0.2, 0.0, 0.05, 1.0, 4.1, 6.0])
    halves, outlier_probabilities = np.full(8, half), np.full(8, outlier_probability)

    def loss(off: np.ndarray) -> np.ndarray:
        if half == 0.0:
            return np.asarray(0.5 * off**2)
        size = np.abs(off)
        return -np.log(ndtr(half - size) - ndtr(-half - size) + outlier_probability)

    root, slope = deviance_residuals(off, halves, outlier_probabilities)
    assert 0.5 * root**2 == pytest.approx(loss(off) - loss(np.zeros(8)), rel=1e-6, abs=1e-9)
    assert np.all(np.sign(root) == np.sign(off))
    ahead, behind = (deviance_residuals(off + by, halves, outlier_probabilities)[0] for by in (1e-5, -1e-5))
    assert slope == pytest.approx((ahead - behind) / 2e-5, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("spread", [0.02, 0.1, 0.5, 2.0])
def test_quantised_readings_show_the_simulation_error(spread: float) -> None:
    rng = np.random.default_rng(0)
    angle = rng.uniform(-100.0, 100.0, 4000)
    read = np.round(angle + spread * rng.standard_normal(4000))
    read[:60] += 20.0 * rng.standard_normal(60)  # some are far off
    found, _ = deviation(read - angle, 1.0, 0.004)
    assert found == pytest.approx(spread, rel=0.15)
