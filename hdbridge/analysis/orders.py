"""Selects the orders in a record, by least squares at the true angles.

Samples are never evenly spaced in angle. A stepping test with steps of 43.56 degrees, for example, samples a
motor turn 8.26 times, and a Fourier transform by sample number would show order 6 at 2.26 and order 8 at
0.26. A fit at the true angles shows each order at its own number, or reports that it is not separable from
another.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hdbridge.analysis.linear import seen_directions, solve_symmetric
from hdbridge.axis.effects import FloatArray, IntArray

NOT_APART = 0.95
"""Canonical correlation above which two orders or two causes are not separable in a record."""


class System(NamedTuple):
    """Normal equations of [cosine and sine pairs of the candidates | all other columns of the fit]."""

    information: FloatArray
    """J' K^-1 J plus the prior information, shape (c, c)."""
    right: FloatArray
    """J' K^-1 y, shape (c,)."""
    limited: IntArray
    """Columns whose coefficients a prior limits. They increase the uncertainty of an order, but are ignored
    in deciding whether the order is separable."""
    zeros: IntArray
    """Columns of the zero offsets."""


class Family(Enum):
    """Angle to which an order refers; N is the gear ratio, k the order's number."""

    MOTOR = "motor"
    """k periods per motor turn: wave generator, motor encoder."""
    LOAD = "load"
    """k / N periods per motor turn: load encoder, pitch of circular spline or flexspline."""
    FLEXSPLINE = "flexspline"
    """k (1 + 1/N) periods per motor turn: wave generator relative to the flexspline."""


@dataclass(frozen=True, slots=True)
class Order:
    """An order: a harmonic of the motor angle, the load angle or the angle relative to the flexspline."""

    family: Family
    number: int
    per_motor_turn: float

    @classmethod
    def motor(cls, number: int) -> Order:
        """Returns the order with this number of periods per motor turn."""
        return cls(Family.MOTOR, number, float(number))

    @classmethod
    def load(cls, number: int, ratio: float) -> Order:
        """Returns the order with this number of periods per load turn."""
        return cls(Family.LOAD, number, number / ratio)

    @classmethod
    def flexspline(cls, number: int, ratio: float) -> Order:
        """Returns the order with this number of periods per turn of the wave generator in the flexspline."""
        return cls(Family.FLEXSPLINE, number, number * (1.0 + 1.0 / ratio))

    def __str__(self) -> str:
        return f"{self.family.value} order {self.number}"


@dataclass(frozen=True, slots=True)
class Selection:
    """Result of the selection of orders."""

    chosen: tuple[Order, ...]
    unresolved: tuple[Order, ...]
    """Candidates that are not separable from zero offset, hysteresis or a selected order in this record."""


@dataclass(frozen=True, slots=True)
class Line:
    """Estimate of one order in a fit with the selected orders, whether or not it is selected itself."""

    order: Order
    amplitude_arcsec: float
    phase_deg: float
    """Phase in amplitude * cos(order * motor angle + phase)."""
    standard_error_arcsec: float
    """Standard error of the cosine or sine coefficient, whichever is larger."""
    threshold_arcsec: float
    """Amplitude that noise alone exceeds, in any candidate order, with the family-wise error probability."""
    aliases: tuple[Order, ...] = ()
    """Orders that are not separable from this order in the record."""

    @property
    def significant(self) -> bool:
        """True if the amplitude exceeds its threshold and the order has no aliases."""
        return self.amplitude_arcsec > self.threshold_arcsec and not self.aliases

    @property
    def fall_in_chi_square(self) -> float:
        """Decrease in chi square due to the order."""
        return (self.amplitude_arcsec / max(self.standard_error_arcsec, 1e-12)) ** 2

    @property
    def threshold(self) -> float:
        """Decrease in chi square that corresponds to `threshold_arcsec`."""
        return (self.threshold_arcsec / max(self.standard_error_arcsec, 1e-12)) ** 2


def threshold(candidates: int, family_wise: float) -> float:
    """Returns the decrease in chi square that the best of the candidates exceeds by chance.

    ``family_wise`` is the probability of this chance. Each candidate has two coefficients.
    """
    return -2.0 * math.log(family_wise / max(candidates, 1))


class _Left(NamedTuple):
    """Part of an order that the other orders in a fit do not explain."""

    share: float
    """Fraction of the order's information that remains."""
    fall: float
    """Decrease in chi square due to the order."""
    cosine: float
    sine: float
    error: float
    """Standard error of the cosine or sine coefficient, whichever is larger."""

    @property
    def apart(self) -> bool:
        return self.share >= 1.0 - NOT_APART**2

    @property
    def amplitude(self) -> float:
        return math.hypot(self.cosine, self.sine)


class _Candidates:
    """Candidate orders, after elimination of all other columns of the fit."""

    def __init__(self, number: int, system: System) -> None:
        information, right, limited, zeros = system
        own, rest = np.arange(2 * number), np.arange(2 * number, len(right))

        self._information, explained = _eliminated(information, own, rest)
        self._right = right[own] - explained.T @ right[rest]
        self._if_limited_known, _ = _eliminated(information, own, np.setdiff1d(rest, limited))
        # Relative to the zero offsets, because a long standstill at one angle does not determine any order.
        centred, _ = _eliminated(information, own, zeros)
        self._alone = np.maximum(np.diag(centred), 1e-9 * np.diag(information)[own])
        self.number = number

    def left(self, index: int, inside: Collection[int]) -> _Left:
        """Returns the part of a candidate that the others ``inside`` the fit do not explain."""
        own = 2 * index + np.arange(2)
        others = np.array([2 * each + part for each in inside if each != index for part in (0, 1)], np.intp)
        left, explained = _eliminated(self._information, own, others)
        moment = self._right[own] - explained.T @ self._right[others]
        cosine, sine = solve_symmetric(left, moment).tolist()
        seen = np.diag(_eliminated(self._if_limited_known, own, others)[0]) / np.maximum(
            self._alone[own], 1e-300
        )
        floor = np.maximum(np.diag(left), 1e-9 * self._alone[own])
        error = float(np.max(1.0 / np.sqrt(floor)))
        return _Left(float(np.min(seen)), float(moment @ [cosine, sine]), cosine, sine, error)


def _eliminated(information: FloatArray, own: IntArray, others: IntArray) -> tuple[FloatArray, FloatArray]:
    """Eliminates the ``others`` from an information matrix.

    Returns the information that remains in the ``own`` columns, and the coefficients of their regression on
    the ``others``.
    """
    cross = information[np.ix_(others, own)]
    explained = solve_symmetric(information[np.ix_(others, others)], cross)
    return information[np.ix_(own, own)] - cross.T @ explained, explained


def select(
    candidates: Sequence[Order], system: System, family_wise: float = 0.01, smallest_arcsec: float = 0.1
) -> Selection:
    """Selects orders by forward selection with removal.

    An order enters if it lowers chi square by more than `threshold` and its amplitude is at least
    ``smallest_arcsec``. The probability that any candidate exceeds the threshold by chance is
    ``family_wise``. An order is removed if orders that enter later replace it.
    """
    waves = _Candidates(len(candidates), system)
    needed = threshold(len(candidates), family_wise)
    inside: list[int] = []

    def outside() -> dict[int, _Left]:
        return {at: waves.left(at, inside) for at in range(len(candidates)) if at not in inside}

    for _ in range(2 * len(candidates)):
        passing = {
            at: each.fall
            for at, each in outside().items()
            if each.apart and each.fall > needed and each.amplitude >= smallest_arcsec
        }
        if not passing:
            break
        inside.append(max(passing, key=lambda at: passing[at]))
        for at in inside[:-1]:
            still = waves.left(at, inside)
            if not still.apart or still.fall <= needed or still.amplitude < 0.5 * smallest_arcsec:
                inside.remove(at)
    return Selection(
        tuple(candidates[at] for at in sorted(inside)),
        tuple(candidates[at] for at, each in outside().items() if not each.apart),
    )


def spectrum(
    orders: Sequence[Order], chosen: Collection[Order], system: System, family_wise: float = 0.01
) -> tuple[Line, ...]:
    """Returns the spectral line of each order, in a fit with the ``chosen`` orders."""
    waves = _Candidates(len(orders), system)
    root = math.sqrt(threshold(len(orders), family_wise))
    inside = [at for at, each in enumerate(orders) if each in chosen]
    alike = _aliases(orders, system[0])
    lines = []
    for at, order in enumerate(orders):
        found = waves.left(at, inside)
        phase = math.degrees(math.atan2(-found.sine, found.cosine))
        lines.append(
            Line(order, found.amplitude, phase, found.error, found.error * root, tuple(alike[order]))
        )
    return tuple(lines)


def _aliases(orders: Sequence[Order], information: FloatArray) -> dict[Order, list[Order]]:
    """Returns, for each order, the orders whose largest canonical correlation with it exceeds `NOT_APART`."""
    pairs = {order: [2 * at, 2 * at + 1] for at, order in enumerate(orders)}
    roots = {order: seen_directions(information[np.ix_(own, own)]) for order, own in pairs.items()}
    result: dict[Order, list[Order]] = {order: [] for order in orders}
    for one, other in combinations(orders, 2):
        between = roots[one].T @ information[np.ix_(pairs[one], pairs[other])] @ roots[other]
        if np.linalg.norm(between, 2) > NOT_APART:
            result[one].append(other)
            result[other].append(one)
    return result
