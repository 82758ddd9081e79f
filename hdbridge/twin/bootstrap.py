"""What rounding and noise do to a fit: its bias, taken off, and its spread, by simulated recordings.

A fit holds smooth replays against a recording that is rounded. Where a motor goes an even way per cycle its
encoder errs alike in every row, so rounding is no noise that averages out, and it leads a fit astray by many
times its standard error. A simulated recording, rounded and noisy as the measured one, leads the same fit
astray by as much (parametric bootstrap; Efron and Tibshirani, An Introduction to the Bootstrap, 1993).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from hdbridge.effects import FloatArray
from hdbridge.estimation.intervals import NORMAL_95
from hdbridge.sim.truth import Truth
from hdbridge.twin.least_squares import (
    Fitted,
    fitted_rows,
    information_of,
    legs_of_rows,
    sandwich,
    scaled,
    softened,
)
from hdbridge.twin.noise import with_load_noise
from hdbridge.twin.parameters import LOAD, at_coordinates
from hdbridge.twin.replays import Replays

DRAWS = (12, 12, 24)
"""Simulated recordings of each round. The first round's are about the fit, the others about where the round
before has led. None is further away than by the wide covariance that the fit has before: a linear step from
there errs by itself, and rounds that are wider and wider would say nothing."""
JUDGES = 4
"""Simulated recordings by which the fit with and without its bias are held against the measured one."""


def unbiased(replays: Replays, fitted: Fitted) -> Fitted:
    """The fit without its bias, with the spread that simulated recordings and the legs' own residuals show.

    To each simulated recording the fit goes by one linear step. Where the place without the bias is further
    from the measured recording than the fit, by replays as rounded as that, the fit stays where it is and the
    bias is in its intervals.
    """
    rng = np.random.default_rng(0)
    parameters, low_high = fitted.parameters, np.array([each.bounds for each in fitted.parameters]).T
    rows = fitted_rows(replays.data)
    spread = np.array([each.spread for each in parameters])
    slopes = fitted.jacobian
    inverse = np.asarray(np.linalg.inv(information_of(slopes, spread)), dtype=np.float64)
    noisy = with_load_noise(fitted.truth, fitted.residuals[LOAD])
    place, covariance = fitted.place, fitted.covariance
    for count in DRAWS:
        root = np.linalg.cholesky(covariance)
        places = [np.clip(place + root @ rng.standard_normal(len(place)), *low_high) for _ in range(count)]
        drawn = replays.drawn([at_coordinates(noisy, parameters, each.tolist()) for each in places])
        missed, left = [], []
        for each, shown in zip(places, drawn, strict=True):
            # What the smooth replay of the fit leaves of the drawn recording.
            off = (scaled(fitted.residuals, fitted.scales) - scaled(shown, fitted.scales))[rows]
            missed.append(fitted.place - inverse @ (slopes.T @ softened(off)) - each)
            left.append(off - slopes @ (each - fitted.place))
        bias = np.mean(missed, axis=0)
        place = np.clip(fitted.place - bias, *low_high)
        few = float(stdtrit(count - 1, 0.975)) / NORMAL_95 * np.sqrt(1.0 + 1.0 / count)
        deviation = few * np.std(missed, axis=0, ddof=1)
        covariance = _scaled_to(inverse, np.minimum(deviation, np.sqrt(np.diag(fitted.covariance))))
    own = fitted.vector - np.mean(left, axis=0)
    apart = sandwich(slopes, own, legs_of_rows(replays.data, rows), spread)
    truths = [at_coordinates(noisy, parameters, each.tolist()) for each in (fitted.place, place)]
    if _off(replays, fitted, truths[1]) > _off(replays, fitted, truths[0]):
        deviation = np.hypot(deviation, bias)
        place = fitted.place
    truth = at_coordinates(fitted.truth, parameters, place.tolist())
    (residuals,) = replays([truth])
    deviation = np.maximum(deviation, np.sqrt(np.diag(apart)))
    vector = softened(scaled(residuals, fitted.scales)[rows])
    return replace(
        fitted,
        truth=truth,
        place=place,
        covariance=_scaled_to(apart, deviation),
        residuals=residuals,
        vector=vector,
        cost=0.5 * float(vector @ vector),
    )


def _scaled_to(covariance: FloatArray, deviation: FloatArray) -> FloatArray:
    """The covariance with other standard deviations."""
    times = deviation / np.sqrt(np.diag(covariance))
    given: FloatArray = covariance * np.outer(times, times)
    return given


def _off(replays: Replays, fitted: Fitted, truth: Truth) -> float:
    """Mean squares of what replays that are as rounded and noisy leave of the measured recording."""
    rows = fitted_rows(replays.data)
    every = [softened(scaled(each, fitted.scales)[rows]) for each in replays.drawn([truth] * JUDGES)]
    return float(np.mean(np.square(every)))
