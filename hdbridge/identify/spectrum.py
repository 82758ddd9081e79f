"""Spectra over the angle: by least squares at the true angles, and a plain one to look at.

Samples are never even in angle, and a stepping test of 43.56 degrees samples a motor turn 8.26 times: a
Fourier transform by sample number would put order 6 at 2.26 and order 8 at 0.26. Fitted at the true angles
each order stands where it is, or is reported as one that the record cannot tell from another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.effects import FloatArray
from hdbridge.errors import InputError
from hdbridge.estimation.linear import inverse_symmetric
from hdbridge.identify.orders import NOT_APART, Order, correlation, threshold
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
    condition: float
    """Condition number of the orders' columns, scaled to one: 1 at best."""
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
    motor_deg: FloatArray,
    error_arcsec: FloatArray,
    orders: Sequence[Order],
    ratio: float,
    family_wise: float = 0.01,
    count: FloatArray | None = None,
) -> Spectrum:
    """Spectrum of an error by least squares at the true angles; all orders and the mean fitted at once.

    ``count`` is how many samples each row stands for. Standard errors come from stretches of the record
    (sandwich), so noise need not be white. For a record with hysteresis take one direction's part, or use
    `fit`, which takes everything together. InputError where there are fewer rows than columns.
    """
    if len(motor_deg) < 2 * len(orders) + 2:
        raise InputError(
            f"{len(motor_deg)} samples for {len(orders)} orders; expected more than twice as many samples as "
            "orders: record more, or ask for fewer orders"
        )
    weight = np.ones(len(motor_deg)) if count is None else count
    columns = _columns(motor_deg, orders)
    information = columns.T @ (weight[:, np.newaxis] * columns)
    inverse = inverse_symmetric(information)
    coefficients = inverse @ (columns.T @ (weight * error_arcsec))
    residual = error_arcsec - columns @ coefficients
    free = max(len(motor_deg) - columns.shape[1], 1)
    white = inverse * float(weight @ residual**2) / free
    stretches = np.array_split(
        columns * (weight * residual)[:, np.newaxis], min(60, max(len(motor_deg) // 8, 1))
    )
    sums = np.array([each.sum(axis=0) for each in stretches])
    robust = inverse @ (sums.T @ sums) @ inverse
    errors = np.sqrt(np.maximum(np.diag(white), np.diag(robust)))
    curve = Curve(*plain_spectrum(motor_deg, error_arcsec - coefficients[0], weight))
    waves = information[1:, 1:]
    return assemble(orders, coefficients[1:], errors[1:], waves, motor_deg, ratio, family_wise, curve)


def assemble(
    orders: Sequence[Order],
    coefficients: FloatArray,
    errors: FloatArray,
    information: FloatArray,
    motor_deg: FloatArray,
    ratio: float,
    family_wise: float,
    curve: Curve,
) -> Spectrum:
    """A spectrum from fitted cosine and sine coefficients, their errors and their information matrix."""
    root = math.sqrt(threshold(len(orders), family_wise))
    resolved = resolution(orders, information, motor_deg, ratio)
    lines = []
    for index, order in enumerate(orders):
        cosine, sine = (float(each) for each in coefficients[2 * index : 2 * index + 2])
        error = float(np.max(errors[2 * index : 2 * index + 2]))
        others = tuple(b if a == order else a for a, b, _ in resolved.aliases if order in {a, b})
        amplitude, phase = math.hypot(cosine, sine), math.degrees(math.atan2(-sine, cosine))
        lines.append(Line(order, amplitude, phase, error, error * root, others))
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
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values = np.linalg.eigvalsh(information / np.outer(scale, scale)) if len(orders) else np.ones(1)
    condition = math.sqrt(float(values[-1] / max(values[0], 1e-300 + values[-1] * 1e-15)))
    return Resolution(turns, turns / ratio, 1.0 / turns if turns else math.inf, condition, tuple(aliases))


def plain_spectrum(
    motor_deg: FloatArray, error_arcsec: FloatArray, count: FloatArray | None = None, highest: float = 32.0
) -> tuple[FloatArray, FloatArray]:
    """Orders and amplitudes of the error averaged in even bins of the motor angle, by FFT; for plots only.

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
    return np.asarray(order[shown], dtype=np.float64), np.asarray(amplitude[shown])


def _columns(motor_deg: FloatArray, orders: Sequence[Order]) -> FloatArray:
    angles = np.deg2rad(np.outer(motor_deg, [each.per_motor_turn for each in orders]))
    waves = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(len(motor_deg), -1)
    return np.concatenate([np.ones((len(motor_deg), 1)), waves], axis=1)
