"""Second looks at names whose twin is commoner: a delayed sample that is the load's own wind-up, a drag that
is a delayed sample, a load order that is the wind-up under the load's torque.
"""

from __future__ import annotations

import numpy as np

from hdbridge.diagnose.search import FLOOR_ARCSEC, Search
from hdbridge.effects import (
    Channel,
    ChannelSkew,
    Compliance,
    InertialWindup,
    LoadOrders,
    VelocityWindup,
)
from hdbridge.estimation.hypothesis import Estimator, Fitted
from hdbridge.observations.reading import third_deviation

INERTIA_SHARE = 0.15
"""A skew whose part in speed is less than this of its part in acceleration is none."""
STRAIGHT = 20.0
"""A drag whose shear speed is so many times the fastest there was has been seen as a straight line."""
TWIN = 1e-3
"""A spring is a first load order's better where it misses less than this share of its data."""

NOISY = 1.5
"""... and so many times what the noise of its torque channel costs it."""


def inertial(estimator: Estimator, search: Search, fitted: Fitted) -> Fitted:
    """A skew that has all but no part in speed is an inertial wind-up, or nothing."""
    for place, effect in enumerate(fitted.hypothesis.effects[search.base :], search.base):
        if not isinstance(effect, ChannelSkew):
            continue
        parts = np.abs(estimator.columns(effect, fitted.hypothesis.start) * effect.coefficients())
        speed, acceleration = np.quantile(parts, 0.998, axis=0)
        if speed < INERTIA_SHARE * acceleration:
            plain = InertialWindup(ratio=effect.ratio, inertia_over_stiffness_s2=1e-5)
            trial = estimator.fit(fitted.hypothesis.instead(place, plain))
            small = search.peak(trial, place) < FLOOR_ARCSEC
            if small or trial.hypothesis.effects[place].violations():
                return estimator.fit(fitted.hypothesis.without(place))
            return trial
    return fitted


def late(estimator: Estimator, search: Search, fitted: Fitted) -> Fitted:
    """A drag that does not bend is a delayed sample.

    The dry part of such a drag is what counts leave: a command in whole counts is followed at a fixed part of
    one, with the sign of the direction.
    """
    speed = estimator.motion.motor_speed_deg_s
    for place, effect in enumerate(fitted.hypothesis.effects[search.base :], search.base):
        if not isinstance(effect, VelocityWindup) or speed is None:
            continue
        if effect.coulomb_arcsec > 0.5 * estimator.data.motor_count_arcsec:
            continue
        if effect.shear_deg_s < STRAIGHT * float(np.max(np.abs(speed))):
            continue
        without = estimator.fit(fitted.hypothesis.without(place))
        if any(isinstance(each, ChannelSkew) for each in fitted.hypothesis.effects):
            return without
        skew = ChannelSkew(ratio=estimator.data.ratio, delay_ms=1.0, second_order_ms2=1.0)
        trial = estimator.fit(fitted.hypothesis.instead(place, skew))
        if trial.chi_square - fitted.chi_square < TWIN * (without.chi_square - fitted.chi_square):
            return trial
    return fitted


def wound_up(estimator: Estimator, fitted: Fitted, base: int) -> Fitted:
    """A first load order that follows the load's torque is the torque's wind-up.

    An order takes any phase, a spring only that of the torque: where it does as well but for what the noise
    of the torque channel takes from it, the order would be a coincidence. Together with a spring it makes up
    for that noise, and takes most of what is the spring's.
    """
    if Channel.LOAD_TORQUE not in estimator.motion.available():
        return fitted
    spring = next((each for each in fitted.hypothesis.effects[base:] if isinstance(each, Compliance)), None)
    for place, effect in enumerate(fitted.hypothesis.effects[base:], base):
        if not isinstance(effect, LoadOrders) or all(each.order != 1 for each in effect.orders):
            continue
        others = tuple(each for each in effect.orders if each.order != 1)
        without = (
            fitted.hypothesis.instead(place, effect.model_copy(update={"orders": others}))
            if others
            else fitted.hypothesis.without(place)
        )
        if spring is not None:
            trial, neither = estimator.fit(without), without.without(without.effects.index(spring, base))
        else:
            linear = Compliance(
                c1_arcsec_per_nm=1.0, c2_arcsec_per_nm=1.0, c3_arcsec_per_nm=1.0,
                torque1_nm=1e4, torque2_nm=2e4, torque=Channel.LOAD_TORQUE.value,
            )  # fmt: skip
            trial, neither = estimator.fit(without.plus(linear)), without
        own = estimator.fit(neither).chi_square - fitted.chi_square
        worse = trial.chi_square - fitted.chi_square
        springs = [each for each in trial.hypothesis.effects if isinstance(each, Compliance)]
        if any(each.violations() for each in springs):
            continue
        if worse < TWIN * own + NOISY * sum(_lost_to_noise(estimator, each) for each in springs):
            return trial
    return fitted


def _lost_to_noise(estimator: Estimator, spring: Compliance) -> float:
    """Chi square that a spring leaves because its torque was measured with noise."""
    torque = estimator.motion.channel(Channel(spring.torque), spring.name)
    noise_nm = third_deviation(np.diff(torque, 3))
    return float(np.sum((estimator.weight * spring.coefficients()[0] * noise_nm) ** 2))
