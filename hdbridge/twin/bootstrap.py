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
    legs_of_rows,
    principal,
    sandwich,
    scaled,
    softened,
)
from hdbridge.twin.noise import with_load_noise
from hdbridge.twin.parameters import LOAD, at_coordinates
from hdbridge.twin.replays import Replays

DRAWS = (12, 12, 24)
"""Simulated recordings of each round. The first round's are about the fit, the others about where the round
before has led, if that is no further from the measured recording. None is further away than by the wide
covariance that the fit has before: a linear step from there errs by itself, and rounds that are further and
further, wider and wider, would say nothing."""
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
    along = principal(slopes, spread)
    back, inverse = np.asarray(np.linalg.inv(along), dtype=np.float64), along @ along.T
    widest = _deviations(fitted.covariance, back)
    noisy = with_load_noise(fitted.truth, fitted.residuals[LOAD])
    place, covariance = fitted.place, fitted.covariance
    nearest = _off(replays, fitted, noisy, place)
    for count in DRAWS:
        root = np.linalg.cholesky(covariance)
        places = [within(place, root @ rng.standard_normal(len(place)), *low_high) for _ in range(count)]
        drawn = replays.drawn([at_coordinates(noisy, parameters, each.tolist()) for each in places])
        missed, left = [], []
        for each, shown in zip(places, drawn, strict=True):
            # What the smooth replay of the fit leaves of the drawn recording.
            off = (scaled(fitted.residuals, fitted.scales) - scaled(shown, fitted.scales))[rows]
            missed.append(fitted.place - inverse @ (slopes.T @ softened(off)) - each)
            left.append(off - slopes @ (each - fitted.place))
        bias = np.mean(missed, axis=0)
        place = np.clip(fitted.place - bias, *low_high)
        astray = _off(replays, fitted, noisy, place) > nearest
        if astray:
            place = fitted.place
        few = float(stdtrit(count - 1, 0.975)) / NORMAL_95 * np.sqrt(1.0 + 1.0 / count)
        deviation = few * np.std(missed @ back.T, axis=0, ddof=1)
        near = np.minimum(deviation, widest)
        covariance = (along * near**2) @ along.T
    own = fitted.vector - np.mean(left, axis=0)
    apart = sandwich(slopes, own, legs_of_rows(replays.data, rows), spread)
    if astray:
        deviation = np.hypot(deviation, back @ bias)
    truth = at_coordinates(fitted.truth, parameters, place.tolist())
    (residuals,) = replays([truth])
    deviation = np.maximum(deviation, _deviations(apart, back))
    vector = softened(scaled(residuals, fitted.scales)[rows])
    return replace(
        fitted,
        truth=truth,
        place=place,
        covariance=(along * deviation**2) @ along.T,
        residuals=residuals,
        vector=vector,
        cost=0.5 * float(vector @ vector),
    )


def within(place: FloatArray, step: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Where a step leads, or its opposite, as far as the bounds leave room for all of it.

    Of a step along a valley some coordinates alone would lead far off it.
    """
    best = place
    for each in (step, -step):
        room = np.where(each > 0.0, high - place, place - low)
        share = np.divide(room, np.abs(each), out=np.ones_like(room), where=np.abs(each) > room)
        ahead = place + float(np.min(share, initial=1.0)) * each
        best = max(best, ahead, key=lambda one: float(np.linalg.norm(one - place)))
    return np.clip(best, low, high)


def _deviations(covariance: FloatArray, back: FloatArray) -> FloatArray:
    """Standard deviations along the principal directions, to which ``back`` leads from the coordinates."""
    return np.asarray(np.sqrt(np.diag(back @ covariance @ back.T)), dtype=np.float64)


def _off(replays: Replays, fitted: Fitted, noisy: Truth, place: FloatArray) -> float:
    """Mean squares of what replays that are as rounded and noisy leave of the measured recording."""
    rows, truth = fitted_rows(replays.data), at_coordinates(noisy, fitted.parameters, place.tolist())
    every = [softened(scaled(each, fitted.scales)[rows]) for each in replays.drawn([truth] * JUDGES)]
    return float(np.mean(np.square(every)))
