"""The noise of a recording: what a twin leaves is held against it, and its load encoder has as much."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr, ndtr

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import CHANNELS, Data, beyond, counted, rounding
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, with_load_encoder
from hdbridge.units import ARCSEC_PER_DEG

# ----------------------------------------------------------------
# How likely a rounded reading is by a simulation that is not rounded.

FINE = 1e-3
"""Half a step of fewer deviations is as good as none."""
STRAY = 0.02
"""Share of readings that may be anywhere: how a motor that stuck breaks away, and where it stood when the
drive was switched on, is no measure of what a simulation is off by elsewhere, nor of a parameter."""


def rooted(off: FloatArray, half: FloatArray, stray: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of which half the squares are the loss of log likelihood, and their derivative by ``off``.

    ``off`` is how far each reading is from the simulation, ``half`` half the step that it is rounded to, both
    in standard deviations of the simulation, shape (n,); ``stray`` the probability of a reading in spite of
    all. Without steps they are as they came.
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
    """Minus the logarithm of the probability of a reading so far away, ``size`` from zero on."""
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
    """The standard deviation of a simulation, by readings in steps: the most likely, ``least`` at least.

    ``spread`` is what each reading is known to be off by in addition. With it the probability of a reading in
    spite of all.
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
# What the residuals of a recording are measured by: how far a simulation is off, channel by channel.

MAD_TO_SIGMA = 1.4826
MOST_ANSWERED = 1.5
"""Of a speed, the largest share that a velocity loop makes up for within a step: at two it is unstable."""


@dataclass(frozen=True, eq=False)
class Loops:
    """By channel, for each row of a recording, what loops with a drive's steps do otherwise than smooth ones.

    How a motor that has stuck breaks away hangs on where the integral came to rest, within a step.
    """

    mean: Mapping[str, FloatArray]
    spread: Mapping[str, FloatArray]

    def taken_off(self, found: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Residuals of a smooth replay without it."""
        return {name: found[name] + self.mean[name] for name in CHANNELS}


@dataclass(frozen=True, eq=False)
class Scales:
    """By channel: how far a simulation is off, and what readings are rounded to.

    Without steps rounding counts as noise like any other.
    """

    deviation: Mapping[str, float]
    step: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(CHANNELS, 0.0))
    stray: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(CHANNELS, 0.0))
    """The probability of a reading in spite of all."""
    loops: Loops | None = None

    def scaled(self, found: Mapping[str, FloatArray]) -> FloatArray:
        """Residuals of all channels, one after the other, in deviations."""
        if self.loops is None:
            return np.concatenate([found[name] / self.deviation[name] for name in CHANNELS])
        return np.concatenate([self.loops.taken_off(found)[name] / self._rows(name) for name in CHANNELS])

    def halves(self, length: int) -> tuple[FloatArray, FloatArray]:
        """Half the step of each of so many rows of each channel, in deviations, and its `stray`."""
        by_channel = [np.broadcast_to(0.5 * self.step[name] / self._rows(name), length) for name in CHANNELS]
        strays = [self.stray[name] if self.step[name] else 0.0 for name in CHANNELS]
        return np.concatenate(by_channel), np.repeat(strays, length)

    def _rows(self, name: str) -> FloatArray | np.float64:
        return np.hypot(self.deviation[name], 0.0 if self.loops is None else self.loops.spread[name])

    @property
    def noise(self) -> dict[str, float]:
        """Both together, as if rounding were noise."""
        return {name: float(np.hypot(self.deviation[name], self.step[name] / 12.0**0.5)) for name in CHANNELS}


def noise_floor(data: Data) -> dict[str, float]:
    """Least noise of each channel: its rounding, and what its encoder's rounding makes of the torque."""
    return Scales(least_deviation(data), rounding(data.axis)).noise


def least_deviation(data: Data) -> dict[str, float]:
    """By channel: what a smooth replay of the true axis is off by, beyond its readings' rounding.

    That is the steps of the encoder that the loops go by, and the load encoder's noise.
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
    """Torque, rms, that the velocity loop makes of readings that are off by so much, rms, each on its own.

    Speed is their difference by the step, and the motor answers within the next: from reading to torque
    the loop is K (1 - 1/z)^2 / (dt (1 - (1 - a)/z)) with a = K dt / J, of which this is the norm.
    """
    gain, step_s = truth.servo.velocity_gain_nm_s_per_rad, truth.substep_s
    share = min(gain * step_s / truth.motor.inertia_kg_m2, MOST_ANSWERED)
    norm = math.sqrt(1.0 + (1.0 + share) ** 2 + share**3 / (2.0 - share))
    return gain * off_rad / step_s * norm


def scales(data: Data, found: Mapping[str, FloatArray], loops: Loops | None = None) -> Scales:
    """Scales of the residuals in motion; no less than what a smooth replay has to be off by.

    Not of those at rest: where a recording rests half of the time, they would be the scale.
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
            # Half of the readings in motion are no strays, however many there are.
            typical = MAD_TO_SIGMA * float(np.median(np.abs(beyond(inside, 0.5 * steps[name]))))
            spread = None if unsteady is None else unsteady[name][rows]
            given[name], stray[name] = deviation(inside, steps[name], max(least[name], typical), spread)
    return Scales(given, steps, stray, loops)


# ----------------------------------------------------------------

ARCSEC_PER_TURN = 360.0 * ARCSEC_PER_DEG
THIRD_DIFFERENCE = math.sqrt(20.0)
"""White noise is so much larger in third differences: the root of 1 + 9 + 9 + 1."""
LEAST_ROWS = 8


def noise_in_motion(data: Data) -> dict[str, float]:
    """By channel, in its unit: what third differences leave of the signal, no less than its rounding.

    At rest an encoder says the same count again and again, and a motor that holds needs the same torque: no
    simulation of the motion can be held against that. A motion that is smooth over four rows is not in third
    differences, and of rows where it is not (a jerk, a reversal) a median takes no notice.
    """
    floor = noise_floor(data)
    found = {}
    for name in CHANNELS:
        rows = []
        for piece in data.pieces:
            moving = piece.rest == 0.0
            whole = moving[3:] & moving[2:-1] & moving[1:-2] & moving[:-3]
            rows.append(np.diff(piece.measured[name], 3)[whole])
        third = np.abs(np.concatenate(rows))
        spread = (
            MAD_TO_SIGMA * float(np.median(third)) / THIRD_DIFFERENCE if len(third) >= LEAST_ROWS else 0.0
        )
        found[name] = max(floor[name], spread)
    return found


def expected(data: Data) -> Scales:
    """By channel, in its unit: what a replay of the true axis would leave.

    Of following error and torque that is their rounding: what third differences leave of a torque is mostly
    motion. What the load encoder has beyond its rounding only the recording tells.
    """
    return Scales(noise_floor(data) | {LOAD: noise_in_motion(data)[LOAD]})


def with_load_noise(truth: Truth, left_arcsec: FloatArray) -> Truth:
    """The truth with the load encoder's noise: what differs from row to row and no replay has.

    ``left_arcsec`` are the load's residuals, zero where a row does not count. The rounding is not in it.
    """
    encoder = truth.load_.encoder
    inside = left_arcsec != 0.0
    steps = np.diff(left_arcsec)[inside[1:] & inside[:-1]]
    if not len(steps):
        return truth
    spread = MAD_TO_SIGMA * float(np.median(np.abs(steps))) / math.sqrt(2.0)
    rounding = ARCSEC_PER_TURN / encoder.counts_per_turn / math.sqrt(12.0)
    noise_arcsec = round(math.sqrt(max(spread**2 - rounding**2, 0.0)), 4)
    return with_load_encoder(truth, noise_arcsec=noise_arcsec)
