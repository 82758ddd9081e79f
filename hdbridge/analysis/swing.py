"""Oscillation of the load on the gear's spring: wind-up during acceleration and ringing after a stop.

The load follows the motor and the gear's error as a mass on a damped spring follows its base. Every axis has
this oscillation, and it is not a fault. A calibration moves too slowly to show it. Its frequency and damping
are therefore fitted to the residual of the given model, before any part of the model is free to imitate it,
and the oscillation is subtracted. Samples in which its uncertainty is too large are omitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.linalg import solve_banded, solve_triangular
from scipy.linalg.blas import dtbsv
from scipy.ndimage import maximum_filter1d
from scipy.optimize import minimize

from hdbridge.analysis.driving import SETTLE_S
from hdbridge.analysis.hypothesis import Estimator, Fitted
from hdbridge.analysis.linear import Nuisances, Prior, about_zeros
from hdbridge.analysis.nuisances import zeros
from hdbridge.analysis.prepared import Observed, Samples
from hdbridge.analysis.scales import Scales
from hdbridge.axis.effects import Effect, FloatArray, IntArray, Part, Start
from hdbridge.axis.effects.path import standing_s
from hdbridge.units import ARCSEC_PER_DEG

ORDINARY_HZ = 30.0
"""Lowest natural frequency of an ordinary load. The demo axis has 42 Hz. Of the axes that tools/blind
generates (20 to 640 Hz), one in thirty has a lower frequency."""
HERTZ = np.geomspace(0.4 * ORDINARY_HZ, 16.0 * ORDINARY_HZ, 23)
DAMPING = (0.05, 0.2, 0.5)
"""Natural frequencies and damping ratios that are tried before the refinement."""
MOST_DAMPED = 0.9
LAGS = range(-3, 2)
"""Offsets, in samples, of the second differences to which a load too stiff for the sampling responds. The
next sample is included, because the motion before it depends on it."""
UNRESOLVED = 0.1
"""Prior standard deviation of the response at each lag, relative to the second difference at that lag."""
STATIC_S2 = 7e-6
"""Prior standard deviation of the response to a constant acceleration: 1 / (2 pi f)^2 for a load with natural
frequency f = 60 Hz."""
UNEVEN = 0.3
"""Maximum relative deviation of a time step from the median for its second differences to be used."""
LEAST_SEEN = 0.1
"""Minimum fraction of a residual's sum of squares that a load oscillation must explain, because a chance fit
also explains a small fraction."""
SURE = 3.0
"""Margin by which noise must be overestimated to be reduced, standard deviations of chi square."""
CALMEST = 0.05
"""Minimum fraction of the samples that are used, those with the least uncertain load oscillation."""
RESOLVED = 4.0
"""Number of samples per period above which a spline begins to follow a wave. From twice this number on, the
spline follows it fully."""
REFINED = 40
"""Maximum number of function evaluations of the refinement."""
LONGEST = 20_000
"""Maximum number of consecutive samples to which a load oscillation is fitted: those with the highest
accelerations."""


@dataclass(frozen=True, slots=True, eq=False)
class Swing:
    """Oscillation of the load relative to its base, the unloaded output of the gear."""

    frequency_hz: float
    damping: float
    contribution_arcsec: FloatArray
    """Transmission error due to the oscillation in each sample, shape (n,)."""
    waves_arcsec2: FloatArray
    """Squared amplitude of the oscillation due to waves that are too fast for the sampling, shape (n,)."""

    def wind_up_arcsec(self, full: Samples) -> FloatArray:
        """Returns the wind-up due to motor acceleration, the slow part of the oscillation, arcsec (n,)."""
        acceleration = full.motion.motor_acceleration_deg_s2
        assert acceleration is not None
        return -acceleration * ARCSEC_PER_DEG / full.ratio / (math.tau * self.frequency_hz) ** 2

    @property
    def soft(self) -> bool:
        """True if the load is softer than an ordinary load; its wind-up is then a cause to find."""
        return self.frequency_hz <= ORDINARY_HZ

    def remark(self) -> str:
        """Describes the load oscillation for the report."""
        return (
            f"the load oscillates on its spring at {self.frequency_hz:.0f} Hz (damping ratio "
            f"{self.damping:.2f}) by up to {np.max(np.abs(self.contribution_arcsec)):.2g} arcsec: "
            + ("its ringing is allowed for" if self.soft else "ordinary dynamics, which are allowed for")
        )


def swing(
    bend: FloatArray, step_s: FloatArray, first: Sequence[int], frequency_hz: float, damping: float
) -> Swing:
    """Computes the load's motion e relative to its base.

    ``bend`` (n,) is the second derivative of the base's position, and ``step_s`` (n - 1,) contains the times
    between samples. The load is at rest at the ``first`` sample of each part. The equation
    e'' + 2 z w e' + w^2 e = -bend is solved exactly for a bend that is linear between samples.
    """
    w, begins = math.tau * frequency_hz, np.asarray(first)
    damped = w * math.sqrt(1.0 - damping**2)
    fall = np.exp(-damping * w * step_s)
    cosine, sine = fall * np.cos(damped * step_s), fall * np.sin(damped * step_s)
    # Transition matrix of position and of speed divided by w, and the response to the second derivative.
    own, cross = cosine + damping * w / damped * sine, w / damped * sine
    other = cosine - damping * w / damped * sine
    slope = np.diff(bend) / step_s / w**3
    before = -bend[:-1] / w**2 + 2.0 * damping * slope
    after = -bend[1:] / w**2 + 2.0 * damping * slope
    right = np.zeros(2 * len(bend))
    right[2::2] = after - own * before + cross * slope
    right[3::2] = -slope + cross * before + other * slope
    for each in (own, cross, other):
        each[begins[1:] - 1] = 0.0
    right.reshape(-1, 2)[begins[1:]] = 0.0
    band = np.zeros((4, len(right)), order="F")
    band[2, 0:-2:2], band[1, 1:-1:2] = -own, -cross
    band[3, 0:-2:2], band[2, 1:-1:2] = cross, -other
    state = dtbsv(3, band, right, lower=1, diag=1, overwrite_x=1)  # the diagonal is one
    return Swing(frequency_hz, damping, state[::2], np.zeros(len(bend)))


def bend_of(base_arcsec: FloatArray, step_s: FloatArray, parts: Sequence[slice]) -> FloatArray:
    """Returns the second derivative of a natural spline through the base angles of each part, shape (n,)."""
    ends = [row for each in parts for row in (each.start, each.stop - 1)]
    band, right = np.zeros((3, len(base_arcsec))), np.zeros(len(base_arcsec))
    band[1, 1:-1] = (step_s[:-1] + step_s[1:]) / 3.0
    band[0, 2:], band[2, :-2] = step_s[1:] / 6.0, step_s[:-1] / 6.0
    right[1:-1] = np.diff(np.diff(base_arcsec) / step_s)
    band[1, ends], right[ends] = 1.0, 0.0
    for each in ends:  # these rows set the second derivative to zero
        band[0, each + 1 : each + 2] = band[2, max(each - 1, 0) : each] = 0.0
    return np.asarray(solve_banded((1, 1), band, right, check_finite=False))


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Base of the load's spring: the motor angle divided by the ratio, plus the error due to the effects."""

    full: Samples
    period_s: float
    residual_arcsec: FloatArray
    """Measured error minus the error due to the effects, shape (n,)."""
    slow_arcsec: FloatArray
    """Angle of the base, load arcsec, without the waves that are too fast for a spline, shape (n,)."""
    fast: tuple[_Fast, ...]

    @classmethod
    def of(cls, data: Observed, effects: Sequence[Effect]) -> Base:
        """Returns the base for these effects, with the initial elastic state that fits best."""
        full = data.full
        weight = full.usable / full.sigma_arcsec**2

        def cost(error: FloatArray) -> float:
            return float(weight @ about_zeros(full.error_arcsec - error, full.zero, weight) ** 2)

        errors = (
            sum((each.predict(full.motion, start) for each in effects), np.zeros(len(full)))
            for start in Start
        )
        error = min(errors, key=cost)
        fast = tuple(_fast_waves(full, effects, data.period_s))
        slow = ARCSEC_PER_DEG / full.ratio * full.motor_deg + error
        for each in fast:
            slow[each.rows] -= each.phasor.real
        return cls(full, data.period_s, full.error_arcsec - error, slow, fast)


def between_samples(base: Base, scales: Scales) -> Nuisances:
    """Returns columns of the load oscillation due to motion between samples, arcsec, shape (n, k).

    A drive may follow its command in straight lines, or with a ripple of its own. Its acceleration between
    samples is then not visible in a spline through them. The load's response is modelled as a filter of the
    samples' second differences. One column is for a constant acceleration; each of the others is the
    difference between one of the remaining `LAGS` and lag 0. There are no columns if they explain little of
    the residual, or more than such a load can.
    """
    full = base.full
    even = np.abs(np.diff(full.time_s) / base.period_s - 1.0) < UNEVEN
    columns = np.zeros((len(full), len(LAGS)))
    for rows in (each.rows for each in full.chains if each.rows.stop - each.rows.start > 2):
        alike = even[rows.start : rows.stop - 1]
        bend = np.pad(np.diff(base.slow_arcsec[rows], 2) * (alike[1:] & alike[:-1]), 1)
        columns[rows] = sliding_window_view(np.pad(bend, (-LAGS.start, LAGS.stop - 1)), len(LAGS))
    now = LAGS.index(0)
    columns[:, np.arange(len(LAGS)) != now] -= columns[:, [now]]
    sizes = np.array([UNRESOLVED if each else STATIC_S2 / base.period_s**2 for each in LAGS])
    names = tuple(f"between samples {each}" for each in LAGS)
    found = Nuisances(columns, names, tuple(Prior(0.0, each**-2) for each in sizes.tolist()))
    nothing, every = found.without(lambda _: True), slice(0, len(full))
    (whole, _), (rest, sought) = (
        _beside(full, each, every)(base.residual_arcsec) for each in (nothing, found)
    )
    strain = float(np.sum((sought / sizes) ** 2))  # large if the load is not too stiff for the sampling
    return found if _seen(whole, rest, len(names), scales) and strain < scales.enter else nothing


def _beside(
    full: Samples, nuisances: Nuisances, rows: slice
) -> Callable[[FloatArray], tuple[float, FloatArray]]:
    """Returns a function that fits zero offsets and ``nuisances`` to a residual in some rows.

    The function returns the remaining chi square and the nuisances' values. Zero offsets without a usable
    sample in these rows are omitted.
    """
    root = np.sqrt(full.usable[rows]) / full.sigma_arcsec[rows]
    columns = zeros(full.zero[rows], full.zeros).and_also(replace(nuisances, columns=nuisances.columns[rows]))
    held = np.diag(np.sqrt([each.information for each in columns.prior]))
    stacked = np.vstack([root[:, np.newaxis] * columns.columns, held])
    seen = np.any(stacked, axis=0)
    q, r = np.linalg.qr(stacked[:, seen])

    def fitted(left_arcsec: FloatArray) -> tuple[float, FloatArray]:
        left = root * left_arcsec
        moment = q[: len(root)].T @ left
        found = np.zeros(len(seen))
        found[seen] = solve_triangular(r, moment)
        return float(left @ left - moment @ moment), found[full.zeros :]

    return fitted


def _seen(whole: float, rest: float, parameters: int, scales: Scales) -> bool:
    return whole - rest >= max(scales.enter + parameters * scales.penalty, LEAST_SEEN * whole)


def visible_swing(base: Base, between: Nuisances, scales: Scales) -> Swing | None:
    """Fits the load oscillation to the residual of the base's effects; returns None if none is visible.

    The oscillation must improve on a fit of ``between``, the columns of the motion between samples.
    """
    full, residual = base.full, base.residual_arcsec
    step_s, parts = np.maximum(np.diff(full.time_s), 1e-9), [each.rows for each in full.chains]
    bend = bend_of(base.slow_arcsec, step_s, parts)
    size = np.concatenate([[0.0], np.cumsum(bend**2)])
    begin = int(np.argmax(size[LONGEST:] - size[:-LONGEST])) if len(full) > LONGEST else 0
    rows = slice(begin, min(begin + LONGEST, len(full)))
    first = [0, *(each.start - begin for each in parts if rows.start < each.start < rows.stop)]
    inside = [each.within(rows) for each in base.fast]
    beside = _beside(full, between, rows)

    def tried(hertz: float, damping: float) -> float:
        damping = min(damping, MOST_DAMPED)
        one = swing(bend[rows], step_s[rows.start : rows.stop - 1], first, hertz, damping)
        for each in inside:
            one.contribution_arcsec[each.rows] += each.contribution(hertz, damping).real
        return beside(residual[rows] - one.contribution_arcsec)[0]

    start = min(product(HERTZ.tolist(), DAMPING), key=lambda each: tried(*each))
    found = minimize(
        lambda x: tried(*np.exp(x).tolist()), np.log(start), method="Nelder-Mead", options={"maxfev": REFINED}
    )
    if not _seen(beside(residual[rows])[0], found.fun, 2, scales):
        return None
    hertz, damping = np.exp(found.x).tolist()
    damping = min(damping, MOST_DAMPED)
    seen = swing(bend, step_s, [each.start for each in parts], hertz, damping)
    for each in base.fast:
        contribution = each.contribution(hertz, damping)
        seen.contribution_arcsec[each.rows] += contribution.real
        seen.waves_arcsec2[each.rows] += np.abs(contribution) ** 2
    return seen


class _Fast(NamedTuple):
    """Part of a wave of the gear's error that is too fast for a spline; the response is quasi-steady."""

    rows: IntArray
    """Indices of the samples with fewer than twice `RESOLVED` samples per period, shape (k,)."""
    phasor: NDArray[np.complex128]
    """Complex value of the wave, arcsec, faded in below that number, shape (k,)."""
    rad_s: FloatArray
    """Angular frequency, signed, shape (k,)."""

    def within(self, rows: slice) -> _Fast:
        """Returns the part within ``rows``, with indices relative to the first of these rows."""
        part = slice(*np.searchsorted(self.rows, (rows.start, rows.stop)))
        return _Fast(self.rows[part] - rows.start, self.phasor[part], self.rad_s[part])

    def contribution(self, frequency_hz: float, damping: float) -> NDArray[np.complex128]:
        """Returns the load's motion relative to its base as a phasor, arcsec, shape (k,)."""
        ratio = self.rad_s / (math.tau * frequency_hz)
        return np.asarray(ratio**2 / (1.0 - ratio**2 + 2j * damping * ratio) * self.phasor)


def _fast_waves(full: Samples, effects: Sequence[Effect], period_s: float) -> Iterator[_Fast]:
    """Yields the fast part of each wave of a model's orders."""
    for turns, amplitude, phase_deg in (
        wave for each in effects if each.part is Part.ORDERS for wave in each.waves()
    ):
        rad_s = turns * np.radians(full.speed_deg_s)
        share = 2.0 - math.tau / (RESOLVED * period_s) / np.maximum(np.abs(rad_s), 1e-9)
        rows = np.flatnonzero(share > 0.0)
        angle = np.radians(turns * full.motor_deg[rows] + phase_deg)
        phasor = amplitude * np.minimum(share[rows], 1.0) * np.exp(1j * angle)
        yield _Fast(rows, np.asarray(phasor), rad_s[rows])


def without(data: Observed, found: Swing) -> Observed:
    """Subtracts the load oscillation from the data; a soft load's wind-up remains, as a cause to find."""
    full = data.full
    contribution = (
        found.contribution_arcsec - found.wind_up_arcsec(full) if found.soft else found.contribution_arcsec
    )
    return data.having(replace(full, error_arcsec=full.error_arcsec - contribution))


def settled(estimator: Estimator, fitted: Fitted, effects: Sequence[Effect], found: Swing | None) -> Observed:
    """Excludes samples with too uncertain a load oscillation, and increases the noise of the others.

    The error of a ``found`` oscillation is proportional to the wind-up and to waves that are too fast for the
    sampling. The factor is found by regression on the squared residuals in motion. The noise of each sample
    is increased by this error and by that of the turning points. The latter is computed with the given
    ``effects``, because the ``fitted`` loop may have changed to imitate it. The calmest samples are always
    kept.
    """
    data, unknown = estimator.data, np.zeros(len(estimator.data.full))
    moving = (data.points.speed_deg_s != 0.0)[estimator.index]
    square = (fitted.residual / estimator.weight) ** 2
    if found is not None:
        wind_up = _accelerated(data.full, data.period_s) / (math.tau * found.frequency_hz) ** 2
        swung = wind_up**2 + found.waves_arcsec2
        unknown = np.sqrt(_share(square[moving], estimator.at_points(swung)[moving]) * swung)
    crept = estimator.crept(effects, fitted.hypothesis.start)
    calm = (standing_s(estimator.motion) > 2.0 * SETTLE_S)[estimator.index]  # after the ringing has decayed
    crept = crept * math.sqrt(_share(square[calm], estimator.at_points(crept**2)[calm]))
    most = max(estimator.scales.floor_arcsec, float(np.quantile(unknown[data.full.usable], CALMEST)))
    usable = data.full.usable & (unknown <= most)
    _, turned = estimator.turned(effects, fitted.hypothesis.start)
    errors = (data.full.sigma_arcsec, unknown, turned, crept, estimator.first_branch(effects))
    sigma = np.sqrt(sum(each**2 for each in errors))
    return data.having(replace(data.full, usable=usable, sigma_arcsec=sigma))


def noise_bounded(estimator: Estimator, fitted: Fitted) -> Observed:
    """Returns the data with less noise if the residual of a fit is certainly smaller than the stated noise.

    A residual contains all the noise. Differences of neighbouring samples may contain more, if the axis never
    rests, and so may the uncertainty of the oscillation.
    """
    data, freedom = estimator.data, max(len(fitted.residual) - fitted.free(), 1)
    most = fitted.chi_square / freedom * (1.0 + SURE * math.sqrt(2.0 / freedom))
    if most >= 1.0:
        return data
    full = replace(data.full, sigma_arcsec=data.full.sigma_arcsec * math.sqrt(most))
    return replace(data.having(full), noise_arcsec=data.noise_arcsec * math.sqrt(most))


def _share(square: FloatArray, size: FloatArray) -> float:
    """Returns the factor, 0 to 1, by which ``size`` contributes to the squared residuals ``square``, (k,)."""
    about = size - np.mean(size) if len(size) else size
    return min(max(float(about @ square) / max(float(about @ about), 1e-300), 0.0), 1.0)


def _accelerated(full: Samples, period_s: float) -> FloatArray:
    """Returns the largest acceleration of the base within `SETTLE_S` before each sample, arcsec/s^2, (n,).

    The next sample is included.
    """
    size, rows = full.motion.motor_acceleration_deg_s2, max(1, round(SETTLE_S / period_s))
    assert size is not None
    result = np.empty(len(full))
    for each in full.chains:
        known = min(rows, each.rows.stop - each.rows.start)
        part = np.abs(size[each.rows]) / full.ratio * ARCSEC_PER_DEG
        result[each.rows] = maximum_filter1d(part, known + 2, origin=known // 2, mode="nearest")
    return result
