"""What the residuals of a recording are measured by: how far a simulation is off, channel by channel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.likelihood import deviation
from hdbridge.twin.misfit import CHANNELS, Data, beyond, counted, rounding
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE
from hdbridge.units import ARCSEC_PER_DEG

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
