"""Thermal constants of the plant, fitted to the recorded temperature.

The plant is one body between its losses and its surroundings (`hdbridge.sim.heat`). The losses are the copper
loss, proportional to the squared torque, and the work of the motor's friction. All other parameters have
already been fitted, so two replays provide the losses. The fit itself needs no replays, because the
temperature is linear in losses and ambient temperature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chdtrc

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Channel, FloatArray
from hdbridge.axis.effects.recurrence import recurrence
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import least_change
from hdbridge.twin.fit import Fitted, Jackknife, intervals_of
from hdbridge.twin.misfit import held_out_legs
from hdbridge.twin.naming import FALSE_ALARM, Finding, finding
from hdbridge.twin.parameters import BY_NAME, Parameter, coordinates
from hdbridge.twin.replay import continuous, replay

AMBIENT: Final = replace(BY_NAME["temperature"], name="ambient temperature")
_WARM_UP = "a warm-up of half an hour and more, and a rest after it, with the temperature recorded"
RISE_K: Final = 100.0
"""Temperature rise of a winding at rated torque (IEC 60034-1 allows 105 K for class F by the resistance
method, the usual rating of motors). The housing warms less."""
MATTERS_K: Final = 5.0
"""Smallest relevant change of the temperature rise at rated torque."""
RESISTANCE: Final = Parameter(
    "thermal resistance", "temperature.resistance_k_per_w", "K/W", 1e-4, 1e3, 0.7, 0.25, AMBIENT.cause,
    _WARM_UP,
)  # fmt: skip
TIME_CONSTANT: Final = Parameter(
    "thermal time constant", "temperature.time_constant_s", "s", 1.0, 1e6, 0.7, 0.25, AMBIENT.cause, _WARM_UP
)
COPPER_LOSS: Final = Parameter(
    "copper loss", "temperature.copper_loss_w", "W", 0.0, 1e5, RISE_K, MATTERS_K, AMBIENT.cause, _WARM_UP,
    linear=True,
)  # fmt: skip
"""Copper loss at rated torque. Its spread and least change apply to a thermal resistance of 1 K/W; `_scaled`
adapts them."""
THERMAL: Final = (AMBIENT, RESISTANCE, TIME_CONSTANT, COPPER_LOSS)

STEP_S: Final = 1.0
"""Time step with constant losses: a hundredth of the time constant of the smallest motor."""
MINIMUM_STEPS: Final = 3
LARGE_S: Final = 1e6
"""Time constant of a body of 1 K/W that hardly warms: by 0.04 K in an hour at 10 W."""
LEAST_ERROR: Final = 1e-4
"""Minimum relative standard deviation of the friction's work."""
START_K: Final = 1.0
"""Standard deviation of the body's temperature about the first reading of a part, because the sensor lags
behind the body."""
CORRELATION_SHARE: Final = 0.25
"""Correlation time of the thermal model's error, as a fraction of the time constant."""
PLACES: Final = (0.0, -1.4, 1.4)
"""Start values of the time constant: logarithms of the ratio to the truth's."""
ROUNDS: Final = 3
"""Maximum number of fits, each with a new estimate of the residuals' size."""


@dataclass(frozen=True, eq=False)
class _Part:
    """One continuous part of a recording, resampled at equal time steps."""

    friction_w: FloatArray
    """Friction power, averaged over the step that ends at each time."""
    torque_squares: FloatArray
    """Square of torque over rated torque, averaged over the step that ends at each time."""
    ambient_change_k: FloatArray
    """Change of the truth's ambient temperature since the start of the part."""
    reading_c: FloatArray
    rows: NDArray[np.intp]
    """Indices of the times whose readings are fitted."""
    firsts: NDArray[np.intp]
    """Index into `rows` of the first of each run of equal readings."""

    def runs(self, column: FloatArray) -> FloatArray:
        """Returns the mean of a column over each run."""
        counted = column[self.rows]
        lengths = np.diff(np.append(self.firsts, len(counted)))
        return np.asarray(np.add.reduceat(counted, self.firsts) / lengths, dtype=np.float64)


def with_warmth(
    recording: Recording, axis: AxisConfig, fitted: Fitted, truth: Truth
) -> tuple[Truth, Finding | None]:
    """Fits the thermal constants; returns the truth with them and their intervals, and a finding.

    Returns the truth unchanged if the recording has no temperature. Constants that the recording does not
    show keep their values.
    """
    record = recording.record
    if Channel.TEMPERATURE.value not in record.columns:
        return truth, None
    parts = _parts(recording, truth, *_losses(recording, axis, truth))
    if not parts:
        return truth, None
    readings = record.columns[Channel.TEMPERATURE.value]
    step_k = min(least_change(np.diff(readings), readings), START_K)
    place, covariance = _fit(parts, truth, step_k, _friction_error(recording, fitted))
    heat = dict(zip((each.path.split(".")[-1] for each in THERMAL), _values(place), strict=True))
    if truth.temperature.friction_growth_per_k or truth.temperature.tooth_growth_per_k:
        # Keep the growth of friction and tooth error unchanged by the new ambient temperature.
        heat["reference_c"] = truth.temperature.unchanged_c
    intervals = intervals_of(THERMAL, place, covariance)
    after = truth.model_copy(
        update={
            "temperature": truth.temperature.model_copy(update=heat),
            "intervals": truth.intervals | {each.path: intervals[each.name] for each in THERMAL},
        }
    )
    # A finding is a constant that has changed significantly and by a relevant amount.
    off, spread = place - np.array(coordinates(truth, THERMAL)), np.sqrt(np.diag(covariance))
    least = np.array([each.least_change for each in _scaled(truth)])
    distance = float(off @ np.linalg.solve(covariance, off))
    moved = (np.abs(off) > least) & (np.abs(off) > NORMAL_95 * spread)
    if not np.any(moved) or float(chdtrc(len(off), distance)) > FALSE_ALARM:
        return after, None
    return after, finding(THERMAL, truth, after, intervals)


def _fit(
    parts: Sequence[_Part], truth: Truth, step_k: float, friction_error: float
) -> tuple[FloatArray, FloatArray]:
    """Fits the constants, a factor of the friction's work, and the initial temperature of each part.

    Each run of equal readings counts as a single reading, because its readings share one rounding error.
    Returns the coordinates of `THERMAL` and their covariance.
    """
    parameters = _scaled(truth)
    count = len(parameters)
    firsts = np.array([each.reading_c[0] for each in parts])
    prior = np.concatenate([coordinates(truth, parameters), [0.0], firsts])
    spread = np.concatenate(
        [[each.spread for each in parameters], [friction_error], np.full(len(parts), START_K)]
    )
    low, high = np.full((2, len(prior)), [[-np.inf], [np.inf]])
    low[:count], high[:count] = np.array([each.bounds for each in parameters]).T
    read = np.concatenate([each.runs(each.reading_c) for each in parts])
    noise_k = step_k / math.sqrt(12.0)

    def left(place: FloatArray) -> FloatArray:
        return np.append((_shown(parts, place) - read) / noise_k, (place - prior) / spread)

    for _ in range(ROUNDS):
        fits = []
        for shift in PLACES:
            begin = prior.copy()
            begin[2] = np.clip(begin[2] + shift, low[2], high[2])
            inside = np.clip(begin, low + 1e-9, high - 1e-9)
            fits.append(least_squares(left, inside, bounds=(low, high), x_scale=spread))
        end = min(fits, key=lambda each: float(each.cost))
        place, off, slopes = end.x, end.fun[: len(read)], end.jac[: len(read)]
        rest_k = noise_k * float(np.sqrt(np.mean(np.square(off))))
        if rest_k <= noise_k:
            break
        noise_k, off, slopes = rest_k, off * noise_k / rest_k, slopes * noise_k / rest_k
    numbers, goes_on = [], 0
    correlation_s = CORRELATION_SHARE * _values(place[:count])[2]
    for each in parts:
        number = (STEP_S * each.rows[each.firsts] // correlation_s).astype(np.intp)
        numbers.append(goes_on + number)
        goes_on += int(number[-1]) + 1
    covariance = Jackknife.over(np.concatenate(numbers), slopes, off, spread).covariance
    return place[:count], covariance[:count, :count]


def _values(place: FloatArray) -> list[float]:
    return [each.value(float(at)) for each, at in zip(THERMAL, place, strict=True)]


def _scaled(truth: Truth) -> list[Parameter]:
    """Returns `THERMAL` with the copper loss's prior spread scaled to the truth's thermal resistance."""
    k_per_w = max(truth.temperature.resistance_k_per_w, RESISTANCE.least)
    copper = replace(COPPER_LOSS, spread=RISE_K / k_per_w, least_change=MATTERS_K / k_per_w)
    return [AMBIENT, RESISTANCE, TIME_CONSTANT, copper]


def _shown(parts: Sequence[_Part], place: FloatArray) -> FloatArray:
    """Returns the simulated mean temperature of the body over each run of equal readings."""
    count = len(THERMAL)
    ambient_c, k_per_w, time_s, copper_w = _values(place[:count])
    friction, shown = math.exp(place[count]), []
    for part, start_c in zip(parts, place[count + 1 :].tolist(), strict=True):
        losses_w = friction * part.friction_w + copper_w * part.torque_squares
        shown.append(
            part.runs(_body(ambient_c + part.ambient_change_k + k_per_w * losses_w, start_c, time_s))
        )
    return np.concatenate(shown)


def _body(goal_c: FloatArray, start_c: float, time_s: float) -> FloatArray:
    """Returns the first-order response of a body with this time constant to ``goal_c``."""
    nearer = -math.expm1(-STEP_S / time_s)
    return recurrence(np.full(len(goal_c), 1.0 - nearer), nearer * goal_c, start_c)


def _parts(
    recording: Recording, truth: Truth, friction_j: FloatArray, torque_squares: FloatArray
) -> list[_Part]:
    """Prepares the continuous parts; skips parts that are too short or have only held-out readings.

    The losses are accumulated by row: ``friction_j`` is the friction's work, ``torque_squares`` the time
    integral of the squared ratio of torque to rated torque, s.
    """
    record, heat = recording.record, truth.temperature
    counts = np.ones(len(record), dtype=np.bool_)
    for leg in held_out_legs(recording):
        counts &= (record.time_s < leg.start_s) | (record.time_s > leg.end_s)
    found = []
    for rows in continuous(record):
        time_s = record.time_s[rows] - record.time_s[rows.start]
        at_s = np.arange(0.0, time_s[-1] + 1e-9, STEP_S)
        nearest = np.searchsorted(time_s, at_s + 1e-9, side="right") - 1
        inside = np.flatnonzero(counts[rows][nearest])
        if len(at_s) < MINIMUM_STEPS or not len(inside):
            continue
        reading_c = record.columns[Channel.TEMPERATURE.value][rows][nearest]
        friction_w, squares = (
            np.append(0.0, np.diff(np.interp(at_s, time_s, each[rows])) / STEP_S)
            for each in (friction_j, torque_squares)
        )
        ambient_change_k = heat.ambient_k_per_hour * at_s / 3600.0
        ambient_change_k = ambient_change_k + heat.ambient_swing_k * np.sin(
            math.tau * at_s / heat.ambient_period_s
        )
        new = (np.diff(reading_c[inside]) != 0.0) | (np.diff(inside) > 1)
        firsts = np.append(0, np.flatnonzero(new) + 1)
        found.append(_Part(friction_w, squares, ambient_change_k, reading_c, inside, firsts))
    return found


def _losses(recording: Recording, axis: AxisConfig, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """Computes the accumulated losses by two replays with a body so large that it hardly warms.

    Replays are needed because a recording contains the torque at the end of each cycle, while the motor is
    heated by the torque within the cycle. The friction's work is corrected to the recorded temperature.
    """
    recorded_c = recording.record.columns[Channel.TEMPERATURE.value]
    taken_j = []
    for copper_w in (0.0, 1.0):
        heat = truth.temperature.model_copy(
            update={
                "resistance_k_per_w": 1.0,
                "time_constant_s": LARGE_S,
                "copper_loss_w": copper_w,
                "ambient_k_per_hour": 0.0,
                "ambient_swing_k": 0.0,
            }
        )
        record = replay(recording, axis, truth.model_copy(update={"temperature": heat}))
        warm_c, time_s = record.columns[Channel.TEMPERATURE.value], record.time_s
        above_k = 0.5 * (warm_c[1:] + warm_c[:-1]) - heat.ambient_c
        cooled_j = np.append(0.0, np.cumsum(above_k * np.diff(time_s)))
        taken_j.append(LARGE_S * warm_c + cooled_j)
    friction_j = np.diff(taken_j[0]) * (_grown(truth, recorded_c) / _grown(truth, warm_c))[1:]
    return np.append(0.0, np.cumsum(friction_j)), taken_j[1] - taken_j[0]


def _grown(truth: Truth, warm_c: FloatArray) -> FloatArray:
    """Returns the friction at a temperature, relative to that of the truth file; at least a twentieth."""
    heat = truth.temperature
    grown = 1.0 + heat.friction_growth_per_k * (warm_c - heat.unchanged_c)
    return np.asarray(np.maximum(grown, 0.05), dtype=np.float64)


def _friction_error(recording: Recording, fitted: Fitted) -> float:
    """Returns the relative standard deviation of the friction's work, from the covariance of a fit."""
    record, motor = recording.record, fitted.truth.motor
    turned = np.abs(np.radians(np.diff(record.motor_position_deg)))
    speed = turned / np.maximum(np.diff(record.time_s), 1e-9)
    works = {
        "Coulomb friction": motor.coulomb_nm * float(np.sum(turned)),
        "viscous friction": motor.viscous_nm_s_per_rad * float(np.sum(turned * speed)),
    }
    whole, heat = sum(works.values()), fitted.truth.temperature
    warm_c = record.columns[Channel.TEMPERATURE.value][1:]
    force_nm = motor.coulomb_nm + motor.viscous_nm_s_per_rad * speed
    works["friction growth"] = float(np.sum(force_nm * turned * (warm_c - heat.unchanged_c)))
    share = np.array([works.get(each.name, 0.0) / whole if whole else 0.0 for each in fitted.parameters])
    return max(math.sqrt(float(share @ fitted.covariance @ share)), LEAST_ERROR)
