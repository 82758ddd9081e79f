"""Noise of a recording: the reference for a twin's residuals, and the noise of its load encoder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr, ndtr

from hdbridge.analysis.readings import median_deviation, third_deviation
from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import CHANNELS, Data, beyond, counted, rounding
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, with_load_encoder
from hdbridge.units import ARCSEC_PER_DEG

# ----------------------------------------------------------------
# Likelihood of a rounded reading under an unrounded simulation.

FINE = 1e-3
"""Half step, in standard deviations, below which rounding is negligible."""
STRAY = 0.02
"""Share of outliers among the readings: the break-away of a stuck motor and its position at switching on are
not evidence of the simulation's error or of a parameter."""


def rooted(off: FloatArray, half: FloatArray, stray: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns residuals whose half squares are the loss of log likelihood, and their derivative by ``off``.

    ``off`` is reading minus simulation, ``half`` half the resolution, both in standard deviations of the
    simulation, shape (n,); ``stray`` the probability of an outlier. Without resolution, ``off`` is returned
    unchanged.
    """
    size, plain = np.abs(off), half == 0.0
    stray = np.where(half < FINE, stray * FINE / np.where(plain, 1.0, half), stray)
    half = np.maximum(half, FINE)
    least = surprise(np.zeros_like(half), half, stray)
    lost = surprise(size, half, stray)
    root = np.sqrt(2.0 * np.maximum(lost - least, 0.0))
    rise = np.exp(lost - 0.5 * np.square(size - half)) * -np.expm1(-2.0 * size * half) / np.sqrt(2.0 * np.pi)
    flat = np.sqrt(2.0 * half * np.exp(least - 0.5 * np.square(half)) / np.sqrt(2.0 * np.pi))
    inner = root < 1e-4
    slope = np.where(inner, flat, rise / np.where(inner, 1.0, root))
    root = np.where(inner, flat * size, root)
    return np.sign(off) * np.where(plain, size, root), np.where(plain, 1.0, slope)


def surprise(size: FloatArray, half: FloatArray, stray: FloatArray) -> FloatArray:
    """Returns the negative log probability of a reading at distance ``size`` >= 0."""
    outer, inner = -size - half, size - half
    near = np.log1p(-np.minimum(ndtr(outer) + ndtr(inner), 1.0 - 1e-15))
    tail = log_ndtr(-inner)
    beyond = tail + np.log1p(-np.exp(np.minimum(log_ndtr(outer) - tail, -1e-12)))
    with np.errstate(divide="ignore"):
        anyhow = np.log(stray)
    return np.asarray(-np.logaddexp(np.where(inner < -1.0, near, beyond), anyhow), dtype=np.float64)


def deviation(
    off: FloatArray, step: float, least: float, spread: FloatArray | None = None
) -> tuple[float, float]:
    """Estimates a simulation's standard deviation from rounded readings (maximum likelihood, >= ``least``).

    ``spread`` is the additional known deviation of each reading. Also returns the probability of an outlier.
    """
    size, known = np.abs(off), np.zeros_like(off) if spread is None else spread
    farthest = max(float(np.max(size)), least)
    stray = STRAY / (1.0 - STRAY) * step / (2.0 * farthest + step)

    def cost(log_deviation: float) -> float:
        each = np.hypot(np.exp(log_deviation), known)
        half = 0.5 * step / each
        times = np.minimum(1.0, half / FINE)
        return float(
            np.sum(surprise(size / each, np.maximum(half, FINE), stray / times)) - np.sum(np.log(times))
        )

    bounds = (np.log(least), np.log(2.0 * farthest))
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02})
    return float(np.exp(found.x)), stray


# ----------------------------------------------------------------
# Scales of the residuals: standard deviation of a simulation's error by channel.

MOST_ANSWERED = 1.5
"""Maximum share of a speed error that a velocity loop corrects within a step; it is unstable at two."""


@dataclass(frozen=True, eq=False)
class Loops:
    """Deviation of quantised loops from smooth ones, by channel, for each row of a recording.

    The break-away of a stuck motor depends on the value of the integral within an encoder step.
    """

    mean: Mapping[str, FloatArray]
    spread: Mapping[str, FloatArray]

    def taken_off(self, found: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Returns the residuals of a smooth replay corrected by the mean deviation."""
        return {name: found[name] + self.mean[name] for name in CHANNELS}


@dataclass(frozen=True, eq=False)
class Scales:
    """Standard deviation of a simulation's error and resolution of the readings, by channel.

    Without resolutions, rounding counts as noise.
    """

    deviation: Mapping[str, float]
    step: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(CHANNELS, 0.0))
    stray: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(CHANNELS, 0.0))
    """Probability of an outlier."""
    loops: Loops | None = None

    def scaled(self, found: Mapping[str, FloatArray]) -> FloatArray:
        """Returns the residuals of all channels, one after the other, in standard deviations."""
        if self.loops is None:
            return np.concatenate([found[name] / self.deviation[name] for name in CHANNELS])
        return np.concatenate([self.loops.taken_off(found)[name] / self._rows(name) for name in CHANNELS])

    def halves(self, length: int) -> tuple[FloatArray, FloatArray]:
        """Returns half the resolution in standard deviations and `stray`, for ``length`` rows per channel."""
        by_channel = [np.broadcast_to(0.5 * self.step[name] / self._rows(name), length) for name in CHANNELS]
        strays = [self.stray[name] if self.step[name] else 0.0 for name in CHANNELS]
        return np.concatenate(by_channel), np.repeat(strays, length)

    def _rows(self, name: str) -> FloatArray | np.float64:
        return np.hypot(self.deviation[name], 0.0 if self.loops is None else self.loops.spread[name])

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation with the rounding included as noise."""
        return {name: float(np.hypot(self.deviation[name], self.step[name] / 12.0**0.5)) for name in CHANNELS}


def noise_floor(data: Data) -> dict[str, float]:
    """Returns the minimum noise of each channel: rounding, and the torque noise from encoder rounding."""
    return Scales(least_deviation(data), rounding(data.axis)).noise


def least_deviation(data: Data) -> dict[str, float]:
    """Returns, by channel, the error of a smooth replay of the true axis beyond the readings' rounding.

    It comes from the resolution of the loops' encoder and the load encoder's noise.
    """
    truth = data.base
    encoder = truth.motor.encoder
    fine_deg = 360.0 / (encoder.counts_per_turn * encoder.interpolation)
    return {
        FOLLOWING: fine_deg / 12.0**0.5,
        TORQUE: _shaken_nm(truth, math.radians(fine_deg)) / 12.0**0.5,
        LOAD: float(
            np.hypot(truth.load_.encoder.noise_arcsec, fine_deg * ARCSEC_PER_DEG / data.axis.gear.ratio)
        ),
    }


def _shaken_nm(truth: Truth, off_rad: float) -> float:
    """Returns the rms torque that the velocity loop makes of independent reading errors of this rms.

    Speed is the readings' difference over the step, and the motor responds within the next step. The transfer
    function is K (1 - 1/z)^2 / (dt (1 - (1 - a)/z)) with a = K dt / J; the result is its norm times the
    error.
    """
    gain, step_s = truth.servo.velocity_gain_nm_s_per_rad, truth.substep_s
    share = min(gain * step_s / truth.motor.inertia_kg_m2, MOST_ANSWERED)
    norm = math.sqrt(1.0 + (1.0 + share) ** 2 + share**3 / (2.0 - share))
    return gain * off_rad / step_s * norm


def scales(data: Data, found: Mapping[str, FloatArray], loops: Loops | None = None) -> Scales:
    """Estimates the scales of the residuals in motion; at least the error of a smooth replay.

    Residuals at rest are excluded, because they would dominate a recording that rests half of the time.
    """
    least, counts, steps = least_deviation(data), counted(data), rounding(data.axis)
    found = found if loops is None else loops.taken_off(found)
    moving = np.concatenate([each.rest for each in data.pieces]) == 0.0
    unsteady = None if loops is None else loops.spread
    given, stray = dict(least), dict.fromkeys(CHANNELS, 0.0)
    for name in CHANNELS:
        rows = moving & (counts[name] > 0.0)
        inside = found[name][rows]
        if len(inside):
            # At least half of the readings in motion are not outliers.
            typical = median_deviation(beyond(inside, 0.5 * steps[name]))
            spread = None if unsteady is None else unsteady[name][rows]
            given[name], stray[name] = deviation(inside, steps[name], max(least[name], typical), spread)
    return Scales(given, steps, stray, loops)


# ----------------------------------------------------------------

ARCSEC_PER_TURN = 360.0 * ARCSEC_PER_DEG
LEAST_ROWS = 8


def noise_in_motion(data: Data) -> dict[str, float]:
    """Estimates the noise in motion by channel, in its unit, from third differences; at least the rounding.

    At rest, count and torque stay constant, which is no reference for a simulation in motion. Motion that is
    smooth over four rows vanishes in third differences, and the median ignores rows where it is not smooth (a
    jerk, a reversal).
    """
    floor = noise_floor(data)
    found = {}
    for name in CHANNELS:
        rows = []
        for piece in data.pieces:
            moving = piece.rest == 0.0
            whole = moving[3:] & moving[2:-1] & moving[1:-2] & moving[:-3]
            rows.append(np.diff(piece.measured[name], 3)[whole])
        third = np.concatenate(rows)
        found[name] = max(floor[name], third_deviation(third) if len(third) >= LEAST_ROWS else 0.0)
    return found


def expected(data: Data) -> Scales:
    """Returns the expected scales of the residuals of the true axis, by channel.

    For following error and torque this is the rounding, because third differences of a torque are mostly
    motion. The load encoder's noise beyond its rounding is estimated from the recording.
    """
    return Scales(noise_floor(data) | {LOAD: noise_in_motion(data)[LOAD]})


def with_load_noise(truth: Truth, left_arcsec: FloatArray) -> Truth:
    """Returns the truth with the load encoder's noise, from differences of residuals between rows.

    ``left_arcsec`` are the load's residuals, zero for rows that do not count. Rounding is subtracted.
    """
    encoder = truth.load_.encoder
    inside = left_arcsec != 0.0
    steps = np.diff(left_arcsec)[inside[1:] & inside[:-1]]
    if not len(steps):
        return truth
    spread = median_deviation(steps) / math.sqrt(2.0)
    rounding = ARCSEC_PER_TURN / encoder.counts_per_turn / math.sqrt(12.0)
    noise_arcsec = round(math.sqrt(max(spread**2 - rounding**2, 0.0)), 4)
    return with_load_encoder(truth, noise_arcsec=noise_arcsec)
