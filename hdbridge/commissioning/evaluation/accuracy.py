"""Accuracy and repeatability of an axis as defined by ISO 230-2.

The standard test approaches m targets P_i from both directions, n times each (n = 5; for a rotary axis up to
360 degrees at least 3 targets to 90 degrees, 5 to 180, 8 beyond, none a multiple of the pitch of a periodic
error). The positioning deviation is x_ij = P_ij - P_i; the arrow gives the direction of approach. All
definitions are those of ISO 230-2:2014, clause 3, for expanded results without measurement uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdbridge.axis.effects import FloatArray
from hdbridge.errors import InputError

MINIMUM_TARGETS = 2
MINIMUM_RUNS = 2


@dataclass(frozen=True, slots=True)
class AxisAccuracy:
    """Accuracy and repeatability of a rotary axis as defined by ISO 230-2:2014; angles in arcsec."""

    accuracy_arcsec: float
    """A, bi-directional: largest of mean + 2 s minus smallest of mean - 2 s, over both directions."""
    accuracy_forward_arcsec: float
    """A (arrow up): the same for the forward approaches."""
    accuracy_backward_arcsec: float
    """A (arrow down): the same for the backward approaches."""
    repeatability_arcsec: float
    """R, bi-directional: largest max(2 s_i forward + 2 s_i backward + |B_i|; 4 s_i of either)."""
    repeatability_forward_arcsec: float
    """R (arrow up): largest 4 s_i of the forward approaches."""
    repeatability_backward_arcsec: float
    """R (arrow down): largest 4 s_i of the backward approaches."""
    reversal_arcsec: float
    """B: largest |B_i|, B_i = mean forward - mean backward at target i."""
    mean_reversal_arcsec: float
    """B (bar): mean of the B_i, with its sign."""
    systematic_arcsec: float
    """E, bi-directional: largest minus smallest of all unidirectional means."""
    systematic_forward_arcsec: float
    """E (arrow up): largest minus smallest of the forward means."""
    systematic_backward_arcsec: float
    """E (arrow down): largest minus smallest of the backward means."""
    range_arcsec: float
    """M: largest minus smallest of the bi-directional means (mean of both directions) of the targets."""
    targets: int
    runs: int
    """Minimum number of approaches to a target from either direction."""


def axis_accuracy(
    target_deg: Sequence[float] | FloatArray,
    deviation_arcsec: Sequence[float] | FloatArray,
    forward: Sequence[bool] | np.ndarray[tuple[int], np.dtype[np.bool_]],
    same_deg: float = 1e-6,
) -> AxisAccuracy:
    """Computes the values from any number of approaches in any order; the arrays have shape (approaches,).

    ``deviation_arcsec`` is the actual position minus the target, ``forward`` is True for approaches in the
    positive direction. Targets closer than ``same_deg`` count as one. Raises `InputError` if a target was
    approached fewer than `MINIMUM_RUNS` times from either direction, as required for a standard deviation.
    """
    target = np.asarray(target_deg, dtype=np.float64)
    deviation = np.asarray(deviation_arcsec, dtype=np.float64)
    up = np.asarray(forward, dtype=np.bool_)
    if not target.shape == deviation.shape == up.shape or target.ndim != 1:
        raise InputError(
            f"targets {target.shape}, deviations {deviation.shape}, directions {up.shape}: expected one of "
            "each per approach"
        )
    order = np.argsort(target, kind="stable")
    group = np.empty(len(target), dtype=np.intp)
    group[order] = np.concatenate([[0], np.cumsum(np.diff(target[order]) > same_deg)]) if len(target) else []
    count = int(group.max()) + 1 if len(target) else 0
    if count < MINIMUM_TARGETS:
        raise InputError(
            f"{count} targets were approached; expected at least {MINIMUM_TARGETS}, preferably 8 per turn"
        )
    runs_up, mean_up, s_up = _statistics(group[up], deviation[up], count)
    runs_down, mean_down, s_down = _statistics(group[~up], deviation[~up], count)
    least = np.minimum(runs_up, runs_down)
    if least.min() < MINIMUM_RUNS:
        place = float(target[group == int(least.argmin())][0])
        raise InputError(
            f"the target at {place:g} deg was approached {int(runs_up[least.argmin()])} times forwards "
            f"and {int(runs_down[least.argmin()])} times backwards; "
            f"expected at least {MINIMUM_RUNS} in each direction, preferably 5"
        )
    reversal = mean_up - mean_down
    both = (mean_up + mean_down) / 2.0
    spread = np.maximum(2.0 * s_up + 2.0 * s_down + np.abs(reversal), 4.0 * np.maximum(s_up, s_down))
    upper = np.maximum(mean_up + 2.0 * s_up, mean_down + 2.0 * s_down)
    lower = np.minimum(mean_up - 2.0 * s_up, mean_down - 2.0 * s_down)
    return AxisAccuracy(
        accuracy_arcsec=float(upper.max() - lower.min()),
        accuracy_forward_arcsec=float((mean_up + 2.0 * s_up).max() - (mean_up - 2.0 * s_up).min()),
        accuracy_backward_arcsec=float((mean_down + 2.0 * s_down).max() - (mean_down - 2.0 * s_down).min()),
        repeatability_arcsec=float(spread.max()),
        repeatability_forward_arcsec=float(4.0 * s_up.max()),
        repeatability_backward_arcsec=float(4.0 * s_down.max()),
        reversal_arcsec=float(np.abs(reversal).max()),
        mean_reversal_arcsec=float(reversal.mean()),
        systematic_arcsec=float(np.maximum(mean_up, mean_down).max() - np.minimum(mean_up, mean_down).min()),
        systematic_forward_arcsec=float(np.ptp(mean_up)),
        systematic_backward_arcsec=float(np.ptp(mean_down)),
        range_arcsec=float(np.ptp(both)),
        targets=count,
        runs=int(least.min()),
    )


def _statistics(
    group: np.ndarray[tuple[int], np.dtype[np.intp]], deviation: FloatArray, count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns number of runs, and mean and standard deviation (n - 1) of the deviations, at each target."""
    runs = np.bincount(group, minlength=count).astype(np.float64)
    mean = np.bincount(group, deviation, count) / np.maximum(runs, 1.0)
    squares = np.bincount(group, (deviation - mean[group]) ** 2, count)
    return runs, mean, np.sqrt(squares / np.maximum(runs - 1.0, 1.0))
