"""Least squares shared by calibration and diagnosis: minima, bounds, priors, signs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from hdbridge.analysis.linear import FREE, Nuisances, Prior, Terms
from hdbridge.analysis.noise import White
from hdbridge.analysis.separable import Separable
from hdbridge.axis.effects import (
    Creep,
    DirectionPhase,
    Effect,
    FloatArray,
    Hysteresis,
    Motion,
    Start,
    Synchronous,
)
from hdbridge.axis.effects.creep import Relaxation
from hdbridge.axis.effects.orders import MotorOrder

TIME_S = np.arange(0.0, 120.0, 0.05)
MOTION = Motion(400.0 * np.sin(0.11 * TIME_S) + 60.0 * np.sin(0.9 * TIME_S), TIME_S)
LOOP = Hysteresis(offset_arcsec=40.0, width_deg=20.0, exponent=1.6)
RIPPLE = Synchronous(
    orders=(
        MotorOrder(order=2, amplitude_arcsec=9.0, phase_deg=30.0),
        MotorOrder(order=4, amplitude_arcsec=6.0, phase_deg=-70.0),
    )
)
SIGMA_ARCSEC = 0.4


def terms(truth: tuple[Effect, ...], seed: int = 3) -> Terms:
    rng = np.random.default_rng(seed)
    observed = 5.0 + sum(each.predict(MOTION, Start.FORWARD) for each in truth)
    observed = observed + SIGMA_ARCSEC * rng.standard_normal(len(TIME_S))
    return Terms(
        observed,
        lambda effect: effect.columns(MOTION, Start.FORWARD),
        White(np.full(len(TIME_S), 1.0 / SIGMA_ARCSEC)),
        Nuisances(np.ones((len(TIME_S), 1)), ("zero",), (FREE,)),
    )


def test_minimum_equals_that_of_scipy() -> None:
    given = terms((RIPPLE, LOOP))
    found = Separable(given).fit((RIPPLE, LOOP.model_copy(update={"width_deg": 33.0, "exponent": 2.3})))

    def residual(x: FloatArray) -> FloatArray:
        loop = LOOP.fitted(x[1:2], {"width_deg": float(np.exp(x[2])), "exponent": float(x[3])})
        predicted = RIPPLE.fitted(x[4:]).predict(MOTION) + loop.predict(MOTION, Start.FORWARD)
        return (given.observed - x[0] - predicted) / SIGMA_ARCSEC

    start = np.array([5.0, 40.0, np.log(20.0), 1.6, *RIPPLE.coefficients()])
    best = least_squares(residual, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    loop = found.effects[1]
    assert isinstance(loop, Hysteresis)
    assert found.chi_square == pytest.approx(2.0 * best.cost, rel=1e-6)
    assert loop.width_deg == pytest.approx(float(np.exp(best.x[2])), rel=1e-3)
    assert loop.exponent == pytest.approx(float(best.x[3]), abs=1e-3)
    # Columns: zero, four of the ripple, offset, width and exponent.
    spread = np.linalg.inv(found.information)
    other = np.linalg.inv(best.jac.T @ best.jac)[np.ix_([0, 4, 5, 6, 7, 1, 2, 3], [0, 4, 5, 6, 7, 1, 2, 3])]
    assert np.diag(spread) == pytest.approx(np.diag(other), rel=0.02)


def test_shape_parameters_stop_at_their_bounds() -> None:
    narrow = LOOP.model_copy(update={"exponent": 1.02})
    data = terms((narrow,))
    steep = replace(data, observed=data.observed + 15.0 * np.sign(np.diff(MOTION.motor_deg, prepend=0.0)))
    found = Separable(steep).fit((LOOP,))
    assert (0, "exponent") in found.at_bound


def test_a_prior_acts_like_observations() -> None:
    """A prior is equivalent to an additional row of the least squares."""
    data = terms((LOOP,))
    prior = {(0, "0"): Prior(30.0, 4.0), (0, "width_deg"): Prior(float(np.log(25.0)), 900.0)}
    plain, held = Separable(data).fit((LOOP,)), Separable(replace(data, prior=prior)).fit((LOOP,))
    before, after = plain.effects[0], held.effects[0]
    assert isinstance(before, Hysteresis)
    assert isinstance(after, Hysteresis)
    penalty = 4.0 * (after.offset_arcsec - 30.0) ** 2 + 900.0 * np.log(after.width_deg / 25.0) ** 2
    left = float(np.sum((held.residual / SIGMA_ARCSEC) ** 2))
    assert held.chi_square == pytest.approx(left + penalty, rel=1e-9)
    assert plain.chi_square < left
    assert left + penalty < plain.chi_square + (
        4.0 * (before.offset_arcsec - 30.0) ** 2 + 900.0 * np.log(before.width_deg / 25.0) ** 2
    )
    # At the minimum, the gradients of data and prior cancel.
    slope = held.jacobian.T @ (held.residual / SIGMA_ARCSEC**2) + held.known[:, 1]
    assert np.abs(slope) == pytest.approx(0.0, abs=0.02 * np.sqrt(np.max(np.diag(held.information))))


def test_unobserved_parameters_stay_at_their_prior() -> None:
    unseen = Creep(parts=(Relaxation(amplitude_arcsec=1.0, tau_s=3.0),))
    data = terms((RIPPLE,))
    blind = replace(
        data,
        columns=lambda effect: (
            np.zeros((len(TIME_S), 1)) if isinstance(effect, Creep) else effect.columns(MOTION)
        ),
        prior={(1, "0"): Prior(2.5, 4.0)},
    )
    found = Separable(blind).fit((RIPPLE, unseen)).effects[1]
    assert found.coefficients() == pytest.approx([2.5])


def test_a_coefficient_of_the_wrong_sign_is_held_at_zero() -> None:
    data = replace(terms((LOOP.model_copy(update={"offset_arcsec": -8.0}),)), sign=lambda _: 1.0)
    found = Separable(data).fit((LOOP,))
    assert found.effects[0].coefficients() == pytest.approx([0.0])
    assert found.free() == 1


def test_nested_parameters_are_updated_during_the_fit() -> None:
    """The shift between the directions applies to the fitted orders, not to the initial ones."""
    phase = DirectionPhase(orders=RIPPLE.orders, shift_deg=4.0)
    data = replace(terms((RIPPLE, phase)), columns=lambda effect: effect.columns(MOTION, Start.FORWARD))
    half = RIPPLE.fitted(0.5 * RIPPLE.coefficients())
    found = Separable(data).fit((half, DirectionPhase(orders=half.orders, shift_deg=1.0)))
    assert found.effects[1].coefficients() == pytest.approx([4.0], abs=0.05)
    assert found.effects[0].coefficients() == pytest.approx(RIPPLE.coefficients(), abs=0.1)
