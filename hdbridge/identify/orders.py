"""Which orders a record shows: best first, by a test that all candidates together pass by chance 1 in 100."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hdbridge.effects import FloatArray, IntArray
from hdbridge.estimation.linear import solve_symmetric

NOT_APART = 0.95
"""Correlation above which two orders cannot be distinguished in a record."""

System = tuple[FloatArray, FloatArray]
"""J' K^-1 J and J' K^-1 y of columns J and observations y."""


class Family(Enum):
    """What an order belongs to."""

    MOTOR = "motor"
    """k: the wave generator, the motor encoder."""
    LOAD = "load"
    """k / N: load encoder, circular spline or flexspline pitch."""
    FLEXSPLINE = "flexspline"
    """k (1 + 1/N): the wave generator as the flexspline sees it."""


@dataclass(frozen=True, slots=True)
class Order:
    """An order of the motor angle."""

    family: Family
    number: int
    per_motor_turn: float

    @classmethod
    def motor(cls, number: int) -> Order:
        """Periods per motor turn."""
        return cls(Family.MOTOR, number, float(number))

    @classmethod
    def load(cls, number: int, ratio: float) -> Order:
        """Periods per load turn."""
        return cls(Family.LOAD, number, number / ratio)

    @classmethod
    def flexspline(cls, number: int, ratio: float) -> Order:
        """Periods per turn of the wave generator against the flexspline."""
        return cls(Family.FLEXSPLINE, number, number * (1.0 + 1.0 / ratio))

    def __str__(self) -> str:
        """For people."""
        return f"{self.family.value} order {self.number}"


@dataclass(frozen=True, slots=True)
class Selection:
    """What the selection found."""

    chosen: tuple[Order, ...]
    unresolved: tuple[Order, ...]
    """Candidates that this record cannot distinguish from the zero, the hysteresis or an order already in."""


def threshold(candidates: int, family_wise: float) -> float:
    """Fall in chi square (two coefficients) that the best of so many reaches by chance this often."""
    return -2.0 * math.log(family_wise / max(candidates, 1))


def select(
    candidates: Sequence[Order],
    information: FloatArray,
    right: FloatArray,
    family_wise: float = 0.01,
    smallest_arcsec: float = 0.1,
) -> Selection:
    """Forward selection with look-back.

    ``information`` and ``right`` are J' K^-1 J and J' K^-1 y of [candidates' cosine and sine pairs | all that
    is in the fit anyway]. An order enters when it lowers chi square by more than `threshold` and its
    amplitude is at least ``smallest_arcsec``; it leaves again when later ones take its place.
    """
    pairs = [np.array([2 * index, 2 * index + 1]) for index in range(len(candidates))]
    split = 2 * len(candidates)
    own = np.diag(information)[:split]
    # What is in the fit anyway is eliminated once; the search works on what is left of the candidates.
    information, right = given(information, right, range(split), range(split, len(right)))
    needed = threshold(len(candidates), family_wise)
    inside: list[int] = []
    for _ in range(2 * len(candidates)):
        scores = _scores(inside, pairs, own, information, right)
        best = max(
            (index for index in range(len(pairs)) if index not in inside),
            key=lambda index: scores[index][0],
            default=None,
        )
        if best is None or scores[best][0] <= needed or scores[best][1] < smallest_arcsec:
            # The largest may be too small in arcsec while a less certain one is larger.
            passing = [
                index
                for index in range(len(pairs))
                if index not in inside and scores[index][0] > needed and scores[index][1] >= smallest_arcsec
            ]
            if not passing:
                break
            best = max(passing, key=lambda index: scores[index][0])
        inside.append(best)
        for index in list(inside[:-1]):
            rest = [each for each in inside if each != index]
            score, amplitude, _ = _scores(rest, pairs, own, information, right, only=index)[index]
            if score <= needed or amplitude < 0.5 * smallest_arcsec:
                inside.remove(index)
    scores = _scores(inside, pairs, own, information, right)
    unresolved = [
        index for index in range(len(pairs)) if index not in inside and scores[index][2] < 1.0 - NOT_APART**2
    ]
    return Selection(
        tuple(candidates[index] for index in sorted(inside)),
        tuple(candidates[index] for index in unresolved),
    )


def given(
    information: FloatArray, right: FloatArray, own: Collection[int], others: Collection[int]
) -> System:
    """Information and right side of some columns with others eliminated."""
    mine, rest = np.array([*own], dtype=np.intp), np.array([*others], dtype=np.intp)
    cross = information[np.ix_(rest, mine)]
    explained = solve_symmetric(information[np.ix_(rest, rest)], cross)
    return information[np.ix_(mine, mine)] - cross.T @ explained, right[mine] - explained.T @ right[rest]


def _scores(
    inside: Sequence[int],
    pairs: Sequence[IntArray],
    own: FloatArray,
    information: FloatArray,
    right: FloatArray,
    only: int | None = None,
) -> dict[int, tuple[float, float, float]]:
    """For each candidate: fall in chi square, amplitude, and the share of it that those inside leave over."""
    active = [each for index in inside for each in pairs[index].tolist()]
    wanted = range(len(pairs)) if only is None else [only]
    columns = [each for index in wanted for each in pairs[index].tolist()]
    left, score = given(information, right, columns, active)
    result = {}
    for at, index in enumerate(wanted):
        two = slice(2 * at, 2 * at + 2)
        share = float(np.min(np.diag(left[two, two]) / np.maximum(own[pairs[index]], 1e-300)))
        if share < 1.0 - NOT_APART**2:
            result[index] = (0.0, 0.0, share)
            continue
        coefficients = solve_symmetric(left[two, two], score[two])
        result[index] = (float(score[two] @ coefficients), float(np.hypot(*coefficients)), share)
    return result


def correlation(information: FloatArray, one: IntArray, other: IntArray) -> float:
    """Largest canonical correlation of two sets of columns: 1 when one can stand for the other."""
    roots = []
    for each in (one, other):
        values, vectors = np.linalg.eigh(information[np.ix_(each, each)])
        roots.append(vectors / np.sqrt(np.maximum(values, 1e-300)))
    between = roots[0].T @ information[np.ix_(one, other)] @ roots[1]
    return float(np.linalg.svd(between, compute_uv=False)[0])
