"""Swing of the load on its spring, which every axis has: wind-up in acceleration and ringing after a stop.

The load follows the motor and the gear's error as a mass on a spring with damping follows its base. A
calibration moves too slowly to show it, and it is no fault. So its frequency and damping are fitted to the
residual of the given model, and what it does is part of the baseline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import solve_banded
from scipy.ndimage import maximum_filter1d

from hdbridge.analysis.driving import SETTLE_S
from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import about_zeros
from hdbridge.analysis.prepared import LEAST_SETTLED, Observed, averaged
from hdbridge.axis.effects import FloatArray
from hdbridge.units import ARCSEC_PER_DEG

ORDINARY_HZ = 30.0
"""Lowest natural frequency of a load that is ordinary. The demo axis has 42 Hz; of the axes that tools/blind
draws, 20 to 640 Hz, one in thirty is softer."""
HERTZ = tuple(float(each) for each in np.geomspace(0.4 * ORDINARY_HZ, 16.0 * ORDINARY_HZ, 23))
DAMPING = (0.05, 0.1, 0.2, 0.4)
"""Natural frequencies and damping ratios that are tried, before a refinement."""


@dataclass(frozen=True, slots=True, eq=False)
class Swing:
    """Lag of the load behind its base in each sample, arcsec, shape (n,)."""

    frequency_hz: float
    damping: float
    does_arcsec: FloatArray
    envelope_arcsec: FloatArray
    """Amplitude of the swing, whatever its phase."""

    def remark(self) -> str:
        """Describes it for the report."""
        return (
            f"the load swings on its spring at {self.frequency_hz:.0f} Hz (damping ratio "
            f"{self.damping:.2f}) by up to {np.max(np.abs(self.does_arcsec)):.2g} arcsec: ordinary dynamics, "
            "which are allowed for"
        )


def swing(
    base_arcsec: FloatArray, time_s: FloatArray, parts: Sequence[slice], frequency_hz: float, damping: float
) -> Swing:
    """Computes the load's motion relative to its base (n,); it is at rest at the start of each part.

    e'' + 2 z w e' + w^2 e = -base'', solved exactly for a second derivative that is linear between samples.
    """
    w = math.tau * frequency_hz
    step_s = np.maximum(np.diff(time_s), 1e-9)
    bend = _bend(base_arcsec, time_s)
    first = np.array([each.start for each in parts])
    last = np.array([each.stop - 1 for each in parts])
    bend[first] = bend[last] = 0.0
    damped = w * math.sqrt(1.0 - damping**2)
    fall = np.exp(-damping * w * step_s)
    cosine, sine = fall * np.cos(damped * step_s), fall * np.sin(damped * step_s)
    # Transition of deviation and speed over w, and the response to the second derivative.
    own, cross = cosine + damping * w / damped * sine, w / damped * sine
    other = cosine - damping * w / damped * sine
    slope = np.diff(bend) / step_s / w**3
    before = -bend[:-1] / w**2 + 2.0 * damping * slope
    after = -bend[1:] / w**2 + 2.0 * damping * slope
    right = np.zeros(2 * len(base_arcsec))
    right[2::2] = after - own * before + cross * slope
    right[3::2] = -slope + cross * before + other * slope
    for each in (own, cross, other):
        each[first[1:] - 1] = 0.0
    right.reshape(-1, 2)[first[1:]] = 0.0
    band = np.zeros((4, len(right)))
    band[0] = 1.0
    band[2, 0:-2:2], band[1, 1:-1:2] = -own, -cross
    band[3, 0:-2:2], band[2, 1:-1:2] = cross, -other
    state = solve_banded((3, 0), band, right, overwrite_ab=True, overwrite_b=True, check_finite=False)
    return Swing(frequency_hz, damping, state[::2], np.hypot(state[::2], state[1::2]))


def seen_swing(estimator: Estimator, fitted: Fitted) -> Swing | None:
    """Fits the swing to the residual of a fit; None if nothing of it is seen."""
    full, start = estimator.data.full, fitted.hypothesis.start
    error = sum(each.predict(full.motion, start) for each in fitted.hypothesis.effects)
    base = ARCSEC_PER_DEG / full.ratio * full.motor_deg + error
    parts = [each.rows for each in full.chains]
    residual, weight = fitted.residual / estimator.weight, estimator.weight**2

    def tried(frequency_hz: float, damping: float) -> tuple[float, Swing]:
        one = swing(base, full.time_s, parts, frequency_hz, damping)
        left = about_zeros(residual - estimator.at_points(one.does_arcsec), estimator.zero, weight)
        return float(np.sum(weight * left**2)), one

    best = min((tried(*each) for each in product(HERTZ, DAMPING)), key=lambda each: each[0])
    for factor in (1.1, 1.05):
        here = best[1]
        near = product((1.0 / factor, 1.0, factor), (1.0 / factor**2, 1.0, factor**2))
        trials = (tried(here.frequency_hz * f, min(here.damping * z, 0.7)) for f, z in near)
        best = min((best, *trials), key=lambda each: each[0])
    scales, whole = estimator.scales, float(np.sum(fitted.residual**2))
    seen = whole - best[0] > scales.enter + 2.0 * scales.penalty
    # Of what a model lacks otherwise, a swing may take a part.
    clear = best[0] < scales.large * len(residual) or best[0] < 0.5 * whole
    return best[1] if seen and clear else None


def allowed_for(estimator: Estimator, fitted: Fitted, found: Swing | None) -> Observed:
    """Returns the data less the swing; samples in which more of it is unknown than matters are left out.

    What the law leaves, and what the samples are too far apart to show, scales with the swing's amplitude and
    with the wind-up at `ORDINARY_HZ`. Both shares are regressed on the squares of the residual in motion.
    """
    data, weight, full = estimator.data, estimator.weight, estimator.data.full
    shaken = _accelerated(data) / (math.tau * ORDINARY_HZ) ** 2
    sizes, left = [shaken], fitted.residual / weight
    if found is not None:
        sizes.insert(0, found.envelope_arcsec)
        left = left - estimator.at_points(found.does_arcsec)
        full = replace(full, error_arcsec=full.error_arcsec - found.does_arcsec)
    moving = (data.points.speed_deg_s != 0.0)[estimator.index]
    square, unknown = left[moving] ** 2, np.zeros(len(full))
    size = estimator.at_points(sizes[-1])[moving]
    quiet = size <= np.median(size) if len(size) else moving[moving]
    if len(size) and float(np.mean((square * weight[moving] ** 2)[quiet])) > estimator.scales.large:
        sizes = []  # the model lacks more than dynamics, and its residual says nothing about them
    for each in sizes:
        size = estimator.at_points(each**2)[moving]
        about = (size - np.mean(size)) if len(size) else size
        share = max(float(about @ square) / max(float(about @ about), 1e-300), 0.0)
        if share > 1.0 and each is shaken:
            continue  # more than any ordinary axis has
        share = min(share, 1.0)
        square = square - share * size
        unknown += share * each**2
    if found is None and not np.any(unknown):
        return data
    unknown = np.sqrt(unknown)
    most = max(estimator.scales.floor_arcsec, 2.0 * float(np.min(full.sigma_arcsec)))
    usable = full.usable & (unknown <= most)
    if np.mean(usable) < LEAST_SETTLED:
        usable = full.usable
    full = replace(full, sigma_arcsec=np.hypot(full.sigma_arcsec, unknown), usable=usable)
    return replace(data, full=full, points=averaged(full, data.runs))


def _accelerated(data: Observed) -> FloatArray:
    """Returns the largest acceleration of the base from one sample after to `SETTLE_S` before each, (n,)."""
    full, rows = data.full, max(1, round(SETTLE_S / data.period_s))
    result = np.zeros(len(full))
    for each in full.chains:
        size = np.abs(_bend(ARCSEC_PER_DEG / full.ratio * full.motor_deg[each.rows], full.time_s[each.rows]))
        known = min(rows, len(size))
        result[each.rows] = maximum_filter1d(size, known + 2, origin=known // 2, mode="nearest")
    return result


def _bend(base_arcsec: FloatArray, time_s: FloatArray) -> FloatArray:
    """Returns the second derivative, zero at both ends, shape (n,)."""
    step_s = np.maximum(np.diff(time_s), 1e-9)
    bend = np.zeros(len(base_arcsec))
    if len(bend) < 3:
        return bend
    bend[1:-1] = np.diff(np.diff(base_arcsec) / step_s) / (0.5 * (step_s[1:] + step_s[:-1]))
    return bend
