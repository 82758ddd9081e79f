"""Spectra over the angle: by least squares at the true angles, and a plain one to look at.

Samples are never even in angle, and a stepping test of 43.56 degrees samples a motor turn 8.26 times: a
Fourier transform by sample number would put order 6 at 2.26 and order 8 at 0.26. Fitted at the true angles
each order stands where it is, or is reported as one that the record cannot tell from another.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.estimation.linear import solve_symmetric
from hdbridge.identify.orders import NOT_APART, Order, System, correlation, given, threshold
from hdbridge.units import DEG_PER_TURN

BINS_PER_TURN = 128


@dataclass(frozen=True, slots=True)
class Line:
    """One order of a spectrum."""

    order: Order
    amplitude_arcsec: float
    phase_deg: float
    """Of amplitude * cos(order * motor angle + phase)."""
    standard_error_arcsec: float
    """Of the cosine and of the sine coefficient (the larger)."""
    threshold_arcsec: float
    """An amplitude that noise alone reaches at any of the orders in one record of a hundred."""
    aliases: tuple[Order, ...] = ()
    """Orders that this record cannot tell from it."""

    @property
    def significant(self) -> bool:
        """Whether it is more than noise."""
        return self.amplitude_arcsec > self.threshold_arcsec and not self.aliases


@dataclass(frozen=True, slots=True)
class Resolution:
    """What the angles of a record can tell apart."""

    turns: float
    """Motor turns between the extremes."""
    load_turns: float
    nearest_orders: float
    """Orders closer than this run into each other: one over the turns."""
    aliases: tuple[tuple[Order, Order, float], ...]
    """Pairs whose correlation is above `NOT_APART`."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A spectrum for the eye: amplitude against order, on an even grid."""

    order: FloatArray
    amplitude_arcsec: FloatArray


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Lines, what could be distinguished, and a curve to plot."""

    lines: tuple[Line, ...]
    resolution: Resolution
    curve: Curve


def spectrum(
    orders: Sequence[Order],
    chosen: Collection[Order],
    system: System,
    motor_deg: FloatArray,
    ratio: float,
    curve: Curve,
    family_wise: float = 0.01,
) -> Spectrum:
    """Each order's line, everything that is in the fit allowed for: what it is, or would add.

    ``system`` is J' K^-1 J and J' K^-1 y of [the orders' cosine and sine pairs | all that is in the fit
    anyway]; of the orders those ``chosen`` are in the fit.
    """
    information, right = system
    root = math.sqrt(threshold(len(orders), family_wise))
    waves = 2 * len(orders)
    inside = [2 * at + part for at, each in enumerate(orders) if each in chosen for part in (0, 1)]
    always = list(range(waves, len(information)))
    resolved = resolution(orders, information[:waves, :waves], motor_deg, ratio)
    lines = []
    for index, order in enumerate(orders):
        own = [2 * index, 2 * index + 1]
        others = [each for each in inside if each not in own] + always
        left, moment = given(information, right, own, others)
        cosine, sine = solve_symmetric(left, moment).tolist()
        floor = 1e-9 * np.diag(information)[own]
        error = float(np.max(1.0 / np.sqrt(np.maximum(np.diag(left), floor))))
        alike = tuple(b if a == order else a for a, b, _ in resolved.aliases if order in {a, b})
        amplitude, phase = math.hypot(cosine, sine), math.degrees(math.atan2(-sine, cosine))
        lines.append(Line(order, amplitude, phase, error, error * root, alike))
    return Spectrum(tuple(lines), resolved, curve)


def resolution(
    orders: Sequence[Order], information: FloatArray, motor_deg: FloatArray, ratio: float
) -> Resolution:
    """What the angles can tell apart; ``information`` of the orders' cosine and sine pairs."""
    turns = float(np.ptp(motor_deg)) / DEG_PER_TURN
    pairs = [np.array([2 * index, 2 * index + 1]) for index in range(len(orders))]
    aliases = []
    for a in range(len(orders)):
        for b in range(a + 1, len(orders)):
            value = correlation(information, pairs[a], pairs[b])
            if value > NOT_APART:
                aliases.append((orders[a], orders[b], min(value, 1.0)))
    return Resolution(turns, turns / ratio, 1.0 / turns if turns else math.inf, tuple(aliases))


def plain_spectrum(
    motor_deg: FloatArray, error_arcsec: FloatArray, count: FloatArray | None = None, highest: float = 32.0
) -> Curve:
    """Amplitudes of the error averaged in even bins of the motor angle, by FFT; for plots only.

    Empty bins count as zero; amplitudes are scaled by the share of bins that are filled.
    """
    weight = np.ones(len(motor_deg)) if count is None else count
    lowest = float(np.min(motor_deg)) if len(motor_deg) else 0.0
    turns = max(math.ceil(float(np.ptp(motor_deg)) / DEG_PER_TURN), 1) if len(motor_deg) else 1
    size = turns * BINS_PER_TURN
    place = np.minimum(((motor_deg - lowest) / DEG_PER_TURN * BINS_PER_TURN).astype(np.intp), size - 1)
    total = np.bincount(place, weight * error_arcsec, size)
    filled = np.bincount(place, weight, size)
    binned = np.divide(total, filled, out=np.zeros(size), where=filled > 0)
    share = max(float(np.mean(filled > 0)), 1e-9)
    # A bin's mean attenuates high orders; the sinc of half a bin puts them right.
    order = np.fft.rfftfreq(size, 1.0 / BINS_PER_TURN)
    amplitude = 2.0 * np.abs(np.fft.rfft(binned)) / (size * share) / np.sinc(order / BINS_PER_TURN)
    shown = order <= highest
    return Curve(np.asarray(order[shown], dtype=np.float64), np.asarray(amplitude[shown]))
