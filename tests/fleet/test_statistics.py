"""Promises of the statistics of a fleet, on fleets of known truth."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.fleet.statistics import (
    Series,
    identities,
    normal_range,
    outliers,
    prevalence,
    repeats,
    trends,
    within_false_discoveries,
)

SEEDS = st.integers(0, 2**32 - 1)


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), min_size=1, max_size=6))
def test_shares_lie_within_their_intervals_between_none_and_all(pairs):
    cases = {str(number): (min(pair), max(pair)) for number, pair in enumerate(pairs)}
    for each in prevalence(cases).values():
        assert 0.0 <= each.low <= each.value <= each.high <= 1.0


def test_small_groups_shrink_toward_the_fleet():
    found = prevalence({"small": (2, 2), "large": (180, 200), "a": (4, 100), "b": (6, 100), "c": (5, 100)})
    assert found["small"].value < 0.9
    assert found["large"].value == pytest.approx(0.9, abs=0.04)
    assert found["small"].high - found["small"].low > 4.0 * (found["large"].high - found["large"].low)


def test_share_intervals_have_nominal_coverage():
    rng = np.random.default_rng(1)
    held = total = 0
    for _ in range(40):
        true = rng.beta(2.0, 10.0, size=8)
        sizes = rng.integers(3, 60, size=8)
        cases = {str(g): (int(rng.binomial(sizes[g], true[g])), int(sizes[g])) for g in range(8)}
        for name, each in prevalence(cases).items():
            held += each.low <= true[int(name)] <= each.high
            total += 1
    assert 0.84 <= held / total <= 0.96


def test_a_cause_that_repeats_is_distinguished_from_names_at_random():
    chosen_ill = chosen_well = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ill = np.arange(200) < 20
        onset = rng.integers(0, 6, 200)
        rate = np.where(ill[:, None] & (np.arange(6) >= onset[:, None]), 0.9, 0.05)
        found = repeats((rng.random((200, 6)) < rate).tolist())
        chosen = within_false_discoveries(found.probability, 0.05)
        chosen_ill += np.sum(chosen[ill])
        chosen_well += np.sum(chosen[~ill])
        assert found.wrongly < 0.1 < 0.8 < found.named
    assert chosen_ill >= 0.6 * 20 * 20
    assert chosen_well <= 0.06 * (chosen_ill + chosen_well)


def test_a_cause_named_now_and_then_everywhere_is_attributed_to_no_joint():
    rng = np.random.default_rng(3)
    found = repeats((rng.random((300, 5)) < 0.2).tolist())
    assert np.sum(within_false_discoveries(found.probability, 0.05)) == 0


@given(st.lists(st.floats(0, 1), max_size=40), st.floats(0.001, 0.5))
def test_the_family_wise_error_rate_holds(values, rate):
    probability = np.array(values)
    chosen = within_false_discoveries(probability, rate)
    if chosen.any():
        assert np.mean(1.0 - probability[chosen]) <= rate + 1e-12
        assert probability[chosen].min() >= probability[~chosen].max(initial=0.0)


@settings(max_examples=30)
@given(SEEDS)
def test_normal_values_are_no_outliers_and_far_ones_are(seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(10.0, 1.0, 100)
    values[:3] = 30.0
    chosen = outliers(values)
    assert chosen[:3].all()
    assert np.sum(chosen[3:]) <= 6
    assert 8.0 < normal_range(values).value < 12.0


def test_few_or_equal_values_have_no_outlier():
    assert not outliers(np.array([1.0, 1.0, 1.0, 99.0])).any()
    assert not outliers(np.ones(50)).any()
    assert outliers(np.array([])).shape == (0,)


def aged(rng, joints, changing, recordings=5, scatter=0.3, sd=0.2):
    """Series of a fleet in which the first ``changing`` joints grow, with their slopes."""
    slope = np.where(
        np.arange(joints) < changing, rng.uniform(0.5, 2.0, joints), rng.normal(0.0, 0.01, joints)
    )
    series = []
    for each in slope:
        hours = np.sort(rng.uniform(0.0, 8000.0, recordings))
        value = 5.0 + each * hours / 1000.0 + rng.normal(0.0, np.hypot(scatter, sd), recordings)
        series.append(Series(hours, value, np.full(recordings, sd)))
    return series, slope


def test_hours_to_a_limit_have_nominal_coverage():
    rng = np.random.default_rng(7)
    held = known = stay = 0
    for _ in range(6):
        series, slope = aged(rng, 60, 15)
        for place, (each, trend) in enumerate(zip(series, trends(series), strict=True)):
            found = trend.hours_to(30.0)
            if place >= 15:
                stay += found is not None
            elif found is not None:
                true = 1000.0 * (30.0 - 5.0) / slope[place] - each.hours.max()
                held += found.low <= true <= found.high
                known += 1
    assert known >= 80
    assert 0.82 <= held / known <= 0.98
    assert stay <= 3


@pytest.mark.parametrize("height", [200.0, 2000.0])
def test_a_step_in_one_joint_is_not_a_trend(height):
    for seed in range(3):
        series, _ = aged(np.random.default_rng(seed), 25, 5)
        step = replace(series[-1], value=series[-1].value + height * (np.arange(5) == 4))
        found = trends([*series[:-1], step])
        assert min(each.growing() for each in found[:5]) > 0.95
        assert found[-1].hours_to(1e6) is None


def test_a_passed_limit_is_reached_now():
    hours = np.arange(5.0) * 1000.0
    (trend,) = trends([Series(hours, 10.0 + hours / 500.0, np.full(5, 0.01))])
    assert trend.hours_to(5.0).high == 0.0


def test_one_or_no_recording_has_no_trend():
    alone = Series(np.array([5.0]), np.array([1.0]), np.array([0.1]))
    assert trends([alone]) == [None]
    assert trends([]) == []
    empty = Series(np.empty(0), np.empty(0), np.empty(0))
    assert trends([empty, alone]) == [None, None]


def test_temperature_effects_are_not_ageing():
    rng = np.random.default_rng(5)
    series = []
    for _ in range(30):
        hours = np.arange(8.0) * 1000.0
        temperature = 20.0 + hours / 700.0 + rng.normal(0.0, 4.0, 8)
        value = 5.0 + 0.5 * temperature + rng.normal(0.0, 0.05, 8)
        series.append(Series(hours, value, np.full(8, 0.05), temperature))
    assert sum(each.hours_to(40.0) is not None for each in trends(series)) <= 1


def drawn_orders(rng, joints, recordings):
    reference = rng.uniform(2.0, 15.0, (joints, 8)) * np.exp(1j * rng.uniform(-np.pi, np.pi, (joints, 8)))
    seen = reference[:, None] * rng.normal(1.0, 0.015, (joints, recordings, 8))
    noise = rng.normal(0.0, 0.05, (2, joints, recordings, 8))
    return seen + noise[0] + 1j * noise[1]


def flat(orders):
    joints, recordings, _ = orders.shape
    return (
        orders.reshape(joints * recordings, -1),
        np.repeat(np.arange(joints), recordings).tolist(),
        np.tile(np.arange(recordings), joints).tolist(),
    )


@settings(max_examples=25)
@given(SEEDS, st.integers(1, 3), st.floats(20.0, 340.0))
def test_swapped_and_turned_joints_are_found_and_nothing_else(seed, since, angle):
    rng = np.random.default_rng(seed)
    orders = drawn_orders(rng, 12, 4)
    orders[[2, 7], since:] = orders[[7, 2], since:]
    orders[5, since:] *= np.exp(1j * np.radians(angle) * np.arange(1, 9))
    found = identities(*flat(orders))
    for place, each in enumerate(found):
        joint, number = divmod(place, 4)
        if joint in {2, 7} and number >= since:
            assert each.kind == "swapped"
            assert each.other == 9 - joint
        elif joint == 5 and number >= since:
            assert each.kind == "turned"
            assert abs(each.angle_deg - angle) < 1.5
        else:
            assert each is None


def test_a_growing_order_does_not_change_the_joint_identity():
    rng = np.random.default_rng(4)
    orders = drawn_orders(rng, 10, 5)
    orders[3, :, 4] += np.arange(5) * 3.0
    kinds = {each.kind for each in identities(*flat(orders)) if each}
    assert kinds <= {"changed"}


def test_recordings_without_orders_are_left_out():
    orders = np.full((3, 8), np.nan + 0j)
    assert identities(orders, [0, 0, 1], [0, 1, 2]) == [None, None, None]
    assert identities(np.empty((0, 8), dtype=complex), [], []) == []
    assert identities(np.empty((2, 0), dtype=complex), [0, 0], [0, 1]) == [None, None]
