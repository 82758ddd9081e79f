"""Tests of least-squares spectra over the true angles, and of the separability of orders."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.orders import Order, System, select, spectrum, threshold


def waves(motor_deg, orders):
    return sum(a * np.cos(k * np.deg2rad(motor_deg) + np.deg2rad(p)) for k, a, p in orders)


def motor_orders(highest):
    return [Order.motor(number) for number in range(1, highest + 1)]


def system(motor_deg, error_arcsec, orders):
    """Returns the normal equations for the orders and the mean, with white noise of 1 arcsec."""
    angles = np.deg2rad(np.outer(motor_deg, [each.per_motor_turn for each in orders]))
    columns = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(len(motor_deg), -1)
    columns = np.concatenate([columns, np.ones((len(motor_deg), 1))], axis=1)
    mean = np.array([columns.shape[1] - 1])
    return System(columns.T @ columns, columns.T @ error_arcsec, np.array([], dtype=int), mean)


def all_fitted(motor_deg, error_arcsec, orders):
    return spectrum(orders, orders, system(motor_deg, error_arcsec, orders))


def test_indistinguishable_orders_are_named():
    motor = np.arange(200) * 45.0 + 1e-6
    found = all_fitted(motor, waves(motor, [(1, 3.0, 0.0)]), motor_orders(9))
    pairs = {(each.order.number, other.number) for each in found for other in each.aliases}
    assert {(1, 7), (1, 9), (7, 9), (2, 6), (3, 5)} <= pairs
    assert (1, 2) not in pairs
    first = found[0]
    assert {each.number for each in first.aliases} == {7, 9}
    assert not first.significant


def test_motor_and_flexspline_orders_are_separable_over_two_load_turns():
    orders = [Order.motor(2), Order.flexspline(2, 50.0)]
    rng = np.random.default_rng(1)
    short = np.sort(rng.uniform(0.0, 360.0 * 2, 3000))
    long = np.sort(rng.uniform(0.0, 360.0 * 100, 3000))
    for angles, aliased in ((short, [True, True]), (long, [False, False])):
        assert [bool(each.aliases) for each in all_fitted(angles, np.zeros(3000), orders)] == aliased


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 12), st.floats(0.5, 50.0), st.floats(-179.0, 179.0), st.integers(0, 10_000))
def test_any_line_is_found_at_any_uneven_angles(order, amplitude, phase, seed):
    motor = np.sort(np.random.default_rng(seed).uniform(0.0, 3600.0, 400))
    found = all_fitted(motor, waves(motor, [(order, amplitude, phase)]), motor_orders(12))
    line = found[order - 1]
    assert line.amplitude_arcsec == pytest.approx(amplitude, rel=1e-6)
    assert line.phase_deg == pytest.approx(phase, abs=1e-4)


def test_standard_errors_are_those_of_many_records():
    rng = np.random.default_rng(2)
    motor = np.sort(rng.uniform(0.0, 7200.0, 800))
    found = [
        all_fitted(motor, waves(motor, [(3, 4.0, 50.0)]) + rng.normal(size=800), motor_orders(4))
        for _ in range(100)
    ]
    scatter = np.std([each[2].amplitude_arcsec for each in found])
    reported = np.mean([each[2].standard_error_arcsec for each in found])
    assert reported == pytest.approx(scatter, rel=0.25)
    assert reported == pytest.approx(np.sqrt(2.0 / 800.0), rel=0.25)


def test_noise_seldom_makes_an_order():
    rng = np.random.default_rng(3)
    motor = np.sort(rng.uniform(0.0, 7200.0, 400))
    orders = motor_orders(16)
    false = sum(
        bool(select(orders, system(motor, rng.normal(size=400), orders), smallest_arcsec=0.0).chosen)
        for _ in range(200)
    )
    assert false <= 8  # 1 % of 200 is 2; more than 8 would be less likely than 1 in 1000


def test_selection_takes_all_that_are_there_and_prefers_the_one_that_explains():
    rng = np.random.default_rng(4)
    motor = np.sort(rng.uniform(0.0, 3600.0, 2000))
    orders = motor_orders(12)
    error = waves(motor, [(2, 5.0, 10.0), (5, 0.5, 0.0), (11, 0.3, 90.0)]) + rng.normal(size=2000)
    chosen = select(orders, system(motor, error, orders))
    assert [each.number for each in chosen.chosen] == [2, 5, 11]


def test_a_long_standstill_hides_no_order():
    rng = np.random.default_rng(6)
    motor = np.append(np.full(50_000, 77.0), rng.uniform(0.0, 3600.0, 1000))
    orders = motor_orders(12)
    error = waves(motor, [(2, 5.0, 10.0), (6, 3.0, 90.0)]) + rng.normal(size=len(motor))
    chosen = select(orders, system(motor, error, orders))
    assert [each.number for each in chosen.chosen] == [2, 6]


@pytest.mark.parametrize("seed", range(4))
def test_no_order_is_replaced_by_a_column_that_a_prior_limits(seed):
    """At one speed, the load oscillation excited by the other orders resembles the largest fast order."""
    rng = np.random.default_rng(seed)
    motor = np.sort(rng.uniform(0.0, 3600.0, 2000))
    orders = motor_orders(8)
    true = [(2, 5.0, 10.0), (4, 4.0, -60.0), (6, 5.0, 100.0)]
    swing = waves(motor, [(order, 0.01 * order**2 * size, phase) for order, size, phase in true])
    error = waves(motor, true) + 0.1 * swing + rng.normal(size=2000)
    plain = system(motor, error, orders)
    angles = np.deg2rad(np.outer(motor, [each.per_motor_turn for each in orders]))
    columns = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(len(motor), -1)
    cross = np.append(columns.T @ swing, np.sum(swing))
    information = np.block([[plain.information, cross[:, np.newaxis]], [cross, swing @ swing + 0.2**-2]])
    right, limited = np.append(plain.right, swing @ error), np.array([len(plain.right)])
    with_swing = System(information, right, limited, plain.zeros)
    assert [each.number for each in select(orders, with_swing).chosen] == [2, 4, 6]


def test_the_threshold_grows_with_the_number_of_candidates():
    assert threshold(1, 0.01) == pytest.approx(9.21, abs=0.01)
    assert threshold(32, 0.01) > threshold(8, 0.01)
