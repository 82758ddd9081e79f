"""Error budget of the article's Table 3, treated as a measurement: `article_table3.py --as-data`.

Four runs of one test give four scatters and four means. If all four have the same uncompensated error e, from
which the runs removed a synchronous correction w, a hysteresis correction h, or both, then

    var(e - w) = var e + var w - 2 cov(e, w)                               and likewise for h and w + h,

so the four scatters give cov(e, w), cov(w, h) and, for each var h, cov(e, h). A covariance matrix has no
negative eigenvalue. This bounds var h and, with the means, the size of h and the fraction of the steps in one
direction. No assumption is made about the shape of any part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

Row = tuple[float, float]
"""3 sigma and mean of one run, arcsec."""


def budget(table: Mapping[str, Row], wave: float, offset: float, floor: float) -> dict[str, Any]:
    """Returns all figures that follow from the four rows of the table; arcsec.

    ``wave`` and ``floor`` are 3 sigma of Table 1's synchronous error and of one motor count; ``offset`` is
    that of Table 2.
    """
    three = {name: each[0] for name, each in table.items()}
    least = min(three.values())
    return {
        "one error under four schemes": {
            **_means(table),
            **_scatter({name: (each / 3.0) ** 2 for name, each in three.items()}, (wave / 3.0) ** 2),
            **_two_values(table, (wave / 3.0) ** 2),
        },
        "what one cause alone would have to be": {
            "white noise or another unknown part, the same in each run: 3 sigma at most": least,
            "... and of 'none' it leaves": math.sqrt(three["none"] ** 2 - least**2),
            "one unmodelled order: amplitude at most": math.sqrt(2.0) * least / 3.0,
            "one motor count: coarser by": three["both"] / floor,
            "a wrong offset in 'both': arcsec": math.hypot(three["both"] / 3.0, table["both"][1]),
            "... with this share of the steps one way, %": _share(three["both"] / 3.0, table["both"][1]),
            "the shift of the mean by hysteresis compensation: beyond Table 2's offset": abs(
                table["hysteresis"][1] - table["none"][1]
            )
            - offset,
        },
    }


def _means(table: Mapping[str, Row]) -> dict[str, float]:
    """Returns the deviation of the corrections' means from additivity, which one common error requires."""
    mean = {name: each[1] for name, each in table.items()}
    apart = mean["both"] - mean["synchronous"] - mean["hysteresis"] + mean["none"]
    return {
        "means: they add up to within": abs(apart),
        "... so a zero that moved at random between the runs, each": abs(apart) / 2.0,
    }


def _scatter(variance: Mapping[str, float], wave: float) -> dict[str, float]:
    along = (variance["none"] + wave - variance["synchronous"]) / 2.0
    return {
        "wave of Table 1: it goes along with the error this many times its size": along / wave,
        "... of the variance of 'none' it can explain, %": 100.0 * along**2 / wave / variance["none"],
        "covariance of the two corrections, arcsec^2": _between(variance),
    }


def _between(variance: Mapping[str, float]) -> float:
    return (variance["both"] - variance["synchronous"] - variance["hysteresis"] + variance["none"]) / 2.0


def _two_values(table: Mapping[str, Row], wave: float) -> dict[str, Any]:
    """Returns the scatter of the hysteresis correction, and its size if it has one value per direction."""
    variance = {name: (each[0] / 3.0) ** 2 for name, each in table.items()}
    shift = 0.5 * (table["none"][1] - table["hysteresis"][1] + table["synchronous"][1] - table["both"][1])
    possible = possible_variances(variance, wave)
    if not len(possible):
        return {"hysteresis correction: no variance of it is possible": True}
    ends = [float(possible[0]), float(possible[-1])]
    left = max(_neither(variance, wave, float(each)) for each in possible)
    return {
        "hysteresis correction, mean": shift,
        "hysteresis correction, standard deviation": [math.sqrt(each) for each in ends],
        "... if of two values: its size": [math.hypot(shift, math.sqrt(each)) for each in ends],
        "... and the share of the steps one way, %": [
            _share(math.sqrt(each), shift) for each in reversed(ends)
        ],
        "neither along the wave nor along the correction: 3 sigma at most": 3.0 * math.sqrt(left),
    }


def possible_variances(variance: Mapping[str, float], wave: float, most: float = 1e4) -> np.ndarray:
    """Returns the possible variances of the hysteresis correction, arcsec^2, ascending.

    A variance is possible if the resulting covariance matrix has no negative eigenvalue.
    """
    grid = np.geomspace(1e-2, most, 6_001)
    matrices = np.array([_covariances(variance, wave, float(each)) for each in grid])
    return np.asarray(grid[np.linalg.eigvalsh(matrices)[:, 0] >= 0.0])


def _covariances(variance: Mapping[str, float], wave: float, correction: float) -> list[list[float]]:
    """Returns the covariance matrix of the error, the synchronous and the hysteresis correction."""
    error = variance["none"]
    along_wave = (error + wave - variance["synchronous"]) / 2.0
    along = (error + correction - variance["hysteresis"]) / 2.0
    between = _between(variance)
    return [[error, along_wave, along], [along_wave, wave, between], [along, between, correction]]


def _neither(variance: Mapping[str, float], wave: float, correction: float) -> float:
    """Returns the variance of the error that no scaling of the two corrections removes."""
    whole = np.array(_covariances(variance, wave, correction))
    return float(whole[0, 0] - whole[0, 1:] @ np.linalg.pinv(whole[1:, 1:]) @ whole[1:, 0])


def _share(deviation: float, mean: float) -> float:
    """Returns the percentage of the more frequent of two opposite values, given their scatter and mean."""
    return 50.0 * (1.0 + abs(mean) / math.hypot(deviation, mean))
