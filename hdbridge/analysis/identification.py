"""Results, options, sample selection and intermediate state of an identification of a model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from hdbridge.analysis.blocks import REST_DEG_S, Design, harmonics, make_blocks
from hdbridge.analysis.driving import SETTLE_S, settling
from hdbridge.analysis.gain import Gain
from hdbridge.analysis.intervals import Interval
from hdbridge.analysis.linear import Effort, Nuisances, Terms, Weighting, unknown
from hdbridge.analysis.noise import NoiseModel, Precision
from hdbridge.analysis.nuisances import nuisances_of
from hdbridge.analysis.orders import Family, Line, Order, Selection, System, select
from hdbridge.analysis.prepared import ON_THE_WAY, Measured, Samples, observe
from hdbridge.analysis.readings import median_deviation
from hdbridge.analysis.separable import Separable, Solution
from hdbridge.axis.effects import (
    CATALOGUE,
    USUAL_LOOP,
    BoolArray,
    Effect,
    FloatArray,
    Start,
    in_place,
    is_ripple,
    ripple,
)
from hdbridge.axis.effects.path import branches
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

WORTH = 0.01
"""Minimum relative decrease in the held-out rms error for an improvement.

A smaller decrease does not affect any stepping test and can be due to noise alone: a second calibration of
the unchanged demo axis lowers the rms by 0.8 %."""


@dataclass(frozen=True, slots=True)
class NoiseFigures:
    """Noise of the record, and the model's residual for comparison."""

    standing_arcsec: float | None
    """Rms of the load encoder at rest, about the mean of each rest; None without a long enough rest."""
    laps_arcsec: float | None
    """Rms difference between passes over the same angles in one direction, divided by the square root of
    2."""
    model: NoiseModel
    """Noise model of the residual, white and correlated, on which the intervals are based."""
    residual_arcsec: float
    """Rms residual of the samples with the model to be stored, after subtraction of each zero offset."""
    fitted_arcsec: float
    """Rms residual of the samples if the nuisances (delay, rounding, other orders) are subtracted too."""
    samples: int
    """Number of samples in the fit."""
    effective_samples: float
    """Number of independent samples of the same rms that would determine the zero offset equally well."""


@dataclass(frozen=True, slots=True)
class Outliers:
    """Numbers of isolated outliers, whose weight is zero."""

    samples: int
    swinging: int
    """Number of outliers in or just after high acceleration, while the load oscillates on its spring."""
    longest_run: int
    """Length of the longest run of consecutive outliers other than those counted in ``swinging``, samples."""


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """Result of one test of the residual."""

    name: str
    """Name of the test: motor_angle, load_angle, direction, time, whiteness or noise_level."""
    passed: bool
    size_arcsec: float
    """Size of the deviation that the test found."""
    text: str


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Prediction error on held-out parts of the record."""

    gain: Gain | None
    """Gain over the active model (or no model), each residual without its zero offset; None without held-out
    data."""
    in_addition: Gain | None
    """Same gain with the nuisances (delay, load orders) subtracted for both models."""
    fitted_arcsec: float
    """Rms residual of the fit with nuisances, over the data that are held out in turn."""
    text: str

    @property
    def improves(self) -> bool:
        """True if the model is a significant improvement.

        With nuisances subtracted, the rms error must fall significantly and by at least `WORTH`. Without
        subtraction, it must not rise.
        """
        gain = self.in_addition
        return (
            gain is not None
            and gain.sure
            and gain.after_arcsec <= (1.0 - WORTH) * gain.before_arcsec
            and not self.worse
        )

    @property
    def worse(self) -> bool:
        """True if the model predicts held-out data less accurately than the active model (or no model)."""
        return self.gain is not None and self.gain.recovered < 0.0


@dataclass(frozen=True, slots=True)
class Nuisance:
    """Parameter that is fitted so that a measurement error does not bias the model."""

    name: str
    text: str
    value: float
    half_width: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Block averages for plots; arrays of shape (b,)."""

    time_s: FloatArray
    motor_deg: FloatArray
    load_deg: FloatArray
    direction: FloatArray
    """Direction of motion: 1, -1, or 0 at rest."""
    kind: tuple[str, ...]
    """Kinds of legs, indexed by ``kind_index``."""
    kind_index: np.ndarray[Any, np.dtype[np.intp]]
    error_arcsec: FloatArray
    """Observed transmission error minus its zero offset."""
    predicted_arcsec: FloatArray
    """Transmission error predicted by the fit, the sum of its effects."""
    residual_arcsec: FloatArray
    """Observed error minus model, with the best-fitting zero offsets subtracted."""
    orders_arcsec: FloatArray
    """Observed error minus all effects except the motor orders, minus zero offset and nuisances."""


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """Fitted model with its uncertainty, tests and plot data."""

    model: TransmissionModel
    """Fitted model. Its ``uncertainty`` contains 95 % half widths, nested like the parameters."""
    intervals: tuple[Interval, ...]
    zeros_arcsec: tuple[float, ...]
    """Fitted zero offsets, one per encoder zero, relative to the median error of the samples with that
    zero."""
    nuisances: tuple[Nuisance, ...]
    noise: NoiseFigures
    outliers: Outliers
    orders: tuple[Line, ...]
    """Spectral lines of the motor orders in the model."""
    spectrum: tuple[Line, ...]
    """Spectral lines of all candidate orders."""
    residual_tests: tuple[ResidualTest, ...]
    held_out: HeldOut
    traces: Traces
    warnings: tuple[str, ...]
    """Limitations of the data, in words."""

    def interval(self, effect: str, parameter: str) -> Interval:
        """Returns the interval of one parameter; KeyError if it was not fitted."""
        for each in self.intervals:
            if (each.effect, each.parameter) == (effect, parameter):
                return each
        raise KeyError(f"{effect}: {parameter}")


# Estimates of the noise without a model: at rest, and between repeated passes.


SHORTEST_REST_S = 1.0
LONGEST_GAP_S = 0.5
LAP_BIN_DEG = 30.0
WINDOW = 51
"""Window of the running median with which each sample is compared, samples."""
OUTLYING = 6.0
"""Minimum deviation of an outlier, robust standard deviations."""


def standing_arcsec(samples: Samples) -> float | None:
    """Returns the rms of the load encoder about the mean of each rest, arcsec; None without a long rest.

    Only the load encoder is used, because a motor encoder that rests between two counts flickers. Sines and
    sweeps are excluded: within one motor count they seem to rest while the load moves.
    """
    still = samples.usable & (np.abs(samples.speed_deg_s) < REST_DEG_S)
    still &= ~samples.of_kind(*SLOW)
    # The axis may have moved in a gap of the record.
    pause = np.diff(samples.time_s, prepend=samples.time_s[0]) > LONGEST_GAP_S
    rest = np.where(still, np.cumsum(pause) + 1, 0)
    edges = np.flatnonzero(np.diff(rest, prepend=-1, append=-1))
    runs = [
        slice(begin, end)
        for begin, end in pairwise(edges.tolist())
        if still[begin]
        and end - begin >= 20
        and samples.time_s[end - 1] - samples.time_s[begin] >= SHORTEST_REST_S
    ]
    if not runs:
        return None
    loads = [samples.load_deg[run] * ARCSEC_PER_DEG for run in runs]
    return float(np.sqrt(np.mean(np.concatenate([load - np.mean(load) for load in loads]) ** 2)))


def laps_arcsec(samples: Samples) -> float | None:
    """Returns the rms difference between passes in one direction, divided by the square root of 2, arcsec.

    Errors are averaged over bins of `LAP_BIN_DEG`. Returns None if too few bins have two passes.
    """
    passes: dict[int, list[dict[int, float]]] = {1: [], -1: []}
    sweep = samples.usable & samples.of_kind("sweep")
    for chain in samples.chains:
        turning, signs = branches(samples.motor_deg[chain.rows])
        for (first, last), sign in zip(pairwise(turning), signs, strict=True):
            rows = chain.rows.start + 1 + np.arange(first, last)
            rows = rows[sweep[rows]]
            if len(rows) >= 20:
                cells, inverse = np.unique(samples.motor_deg[rows] // LAP_BIN_DEG, return_inverse=True)
                means = np.bincount(inverse, samples.error_arcsec[rows]) / np.bincount(inverse)
                # In its first cells a pass still traverses the hysteresis loop.
                keep = slice(5, None) if sign > 0 else slice(None, -5)
                passes[sign].append(dict(zip(cells[keep].tolist(), means[keep].tolist(), strict=True)))
    differences = [
        earlier[cell] - later[cell]
        for each in passes.values()
        for earlier, later in pairwise(each)
        for cell in earlier.keys() & later.keys()
    ]
    return float(np.sqrt(np.mean(np.square(differences)) / 2.0)) if len(differences) >= 8 else None


def outlying(
    residual: FloatArray, swings: BoolArray, count_arcsec: float = 0.0
) -> tuple[FloatArray, Outliers]:
    """Returns the weight of each sample (n,), 0 for outliers and else 1 (also for NaN), and their numbers.

    Outliers are far from the median of their neighbours. The comparison is with neighbours rather than with
    the model, so effects that the model lacks and lasting steps (lost counts) are kept. ``swings`` is the
    mask of `swinging`, shape (n,). ``count_arcsec`` is one count of the motor encoder at the load. The
    threshold is increased by this count, because the reading of a motor between two counts alternates, and
    only its mean is right.
    """
    weight = np.ones(len(residual))
    index = np.flatnonzero(np.isfinite(residual))
    if len(index) < WINDOW:
        return weight, Outliers(0, 0, 0)
    values = residual[index]
    off = np.abs(values - median_filter(values, WINDOW, mode="nearest"))
    scale = max(median_deviation(off), 0.1)
    out = off > OUTLYING * scale + count_arcsec
    weight[index[out]] = 0.0
    others = out & ~swings[index]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], others, [False]]).astype(np.int8)))
    runs = edges[1::2] - edges[::2]
    samples = int(np.count_nonzero(out))
    return weight, Outliers(samples, samples - int(np.count_nonzero(others)), int(np.max(runs, initial=0)))


def swinging(samples: Samples) -> BoolArray:
    """Returns a mask of samples with load acceleration above `GENTLE_DEG_S2`, or within `SETTLE_S` after."""
    return settling(_accelerating(samples), samples.time_s)


def _accelerating(samples: Samples) -> BoolArray:
    """Returns a mask of the samples with a load acceleration above `GENTLE_DEG_S2`."""
    acceleration = samples.motion.motor_acceleration_deg_s2
    assert acceleration is not None
    return np.asarray(np.abs(acceleration / samples.ratio) > GENTLE_DEG_S2)


SWAY_ARCSEC = 1.0
"""Minimum deviation of an oscillating motor from its command, arcsec at the load."""
SWAY_COUNTS = 1.5
"""Minimum deviation of an oscillating motor from its command, counts; rounding deviates by less."""


def oscillation(measured: Measured, samples: Samples) -> str:
    """Returns a warning if the motor oscillates about its command in slow motion, else an empty text.

    Such a motor reverses where the command does not, so the state of the hysteresis loop is unknown. The
    deviation is a median, because a motor may oscillate after a start or a reversal.
    """
    target, position = measured.record.motor_target_deg, measured.record.motor_position_deg
    if target is None or not samples.commanded:
        return ""
    off = target - position
    for chain in samples.chains:
        rows = chain.rows
        period_s = np.median(np.diff(samples.time_s[rows])) if rows.stop - rows.start > 1 else SETTLE_S
        off[rows] -= uniform_filter1d(off[rows], max(round(SETTLE_S / max(float(period_s), 1e-6)), 1))
    slow = [
        samples.usable & samples.of_kind(kind)
        for kind in samples.kinds
        if kind not in {*RESTING, *ON_THE_WAY}
    ]
    sway_deg = max((median_deviation(off[rows]) for rows in slow if rows.any()), default=0.0)
    least_deg = max(SWAY_ARCSEC / ARCSEC_PER_DEG * samples.ratio, SWAY_COUNTS * samples.count_deg)
    if sway_deg < least_deg:
        return ""
    return (
        f"the motor oscillates about its command in slow motion, by {sway_deg:.2g} deg (expected less "
        f"than {least_deg:.2g}): the hysteresis in this record is not that of the command; tune the drive's "
        "control loops, then record again"
    )


# Selection of the quasi-static samples of a calibration.


MINIMUM_SAMPLES = 8
SETTLE_SHARE = 0.2
"""Maximum fraction of the time to the next turning point that is dropped after a turning point, where the
hysteresis changes too steeply for a load on a spring to follow."""
STANDING_DEG_S = 1e-3
"""Maximum load speed at which an axis counts as being at rest, deg/s."""
GENTLE_DEG_S2 = 40.0
"""Maximum load acceleration of usable samples in motion of unknown kind."""
RESTING = ("reference", "standstill")
SLOW = ("sweep", "sine", "reversal")
"""Kinds of slow legs, whose speed is the default limit of slow motion."""
KNOWN = (*RESTING, *ON_THE_WAY, *SLOW)


def usable_samples(measured: Measured, ratio: float, slow_deg_s: float | None = None) -> Samples:
    """Prepares the samples of a calibration: centres the errors per encoder zero, and marks usable samples.

    ``slow_deg_s`` is the maximum load speed of usable samples, by default that of the slow legs. Raises
    InputError if there are too few samples or the ratio does not match the record.
    """
    count = len(measured.record)
    if count < MINIMUM_SAMPLES:
        raise InputError(f"{count} samples; expected at least {MINIMUM_SAMPLES}: record more")
    samples = observe(measured, ratio, against_command=False)
    middles = [np.median(samples.error_arcsec[samples.zero == each]) for each in range(samples.zeros)]
    turned = [_has_turned(samples.time_s[each.rows], samples.motor_deg[each.rows]) for each in samples.chains]
    return replace(
        samples,
        error_arcsec=samples.error_arcsec - np.array(middles)[samples.zero],
        usable=_slow(samples, slow_deg_s) & ~np.concatenate(turned),
    )


def _slow(samples: Samples, slow_deg_s: float | None) -> BoolArray:
    """Returns a mask of the samples at rest or in slow motion, except within `SETTLE_S` after fast motion.

    Each motion, from a rest or turning point to the next, is slow or fast as a whole, so the start of a fast
    move is not slow. Of moves and steps, only the rests are used. In motions of unknown kind, samples with
    high acceleration are dropped.
    """
    speed = samples.speed_deg_s / samples.ratio
    moving = np.abs(speed)
    own = moving[samples.of_kind(*SLOW) & (moving > 0)]
    if slow_deg_s is None:
        slow_deg_s = 1.2 * float(np.quantile(own, 0.995)) if len(own) else np.inf
    under_way = moving > STANDING_DEG_S
    fast = under_way & samples.of_kind(*ON_THE_WAY)
    fast |= ~samples.of_kind(*KNOWN) & _accelerating(samples)
    # Without a rest between them, consecutive motions differ in kind or direction.
    changes = [np.diff(each) != 0 for each in (under_way, samples.kind, np.sign(speed))]
    first = np.append(0, np.flatnonzero(np.any(changes, axis=0)) + 1)
    fastest = np.repeat(np.maximum.reduceat(moving, first), np.diff(np.append(first, len(samples))))
    fast |= under_way & (fastest > slow_deg_s)
    return ~settling(fast, samples.time_s)


def _has_turned(time: FloatArray, motor_deg: FloatArray) -> BoolArray:
    """Returns a mask of the samples within `SETTLE_S` after a turning point."""
    turned = np.zeros(len(time), dtype=bool)
    turning, _ = branches(motor_deg)
    for first, last in pairwise(turning[1:]):
        settled = time[first] + min(SETTLE_S, SETTLE_SHARE * float(time[last] - time[first]))
        turned[first + 1 : int(np.searchsorted(time, settled, "right"))] = True
    return turned


# Options.


@dataclass(frozen=True, slots=True)
class FitOptions:
    """Options of an identification; the defaults suit the bench's recordings."""

    effects: tuple[Effect, ...] = (USUAL_LOOP,)
    """Effects to fit in addition to the ripple. Undetermined shapes keep the values given here."""
    highest_order: int = 24
    """Highest candidate motor order."""
    load_orders: int = 4
    """Highest load and flexspline order; significant ones are fitted as nuisances."""
    family_wise: float = 0.01
    """Probability that noise alone causes the selection of any order."""
    smallest_arcsec: float = 0.1
    """Minimum amplitude of a selected order, however significant it is."""
    start: Start | None = None
    """Elastic state at the first sample; `Start.FORWARD` after the bench's preconditioning. None fits it."""
    active: TransmissionModel | None = None
    """Model with which to compare. It also provides the shape parameters that the data do not determine."""

    def prototype(self, effect: Effect) -> Effect:
        """Returns an effect of this kind, with parameters from the active model, else from the options."""
        known = (*(self.active.effects if self.active else ()), *self.effects)
        laws = (law for each in known for law in (each, *in_place(each, CATALOGUE.values())))
        return next((law for law in laws if law.name == effect.name), effect)


# Initial values of the fit: the best point of a grid over all shape parameters.


GRID_LOGARITHMIC: Final = 12
GRID_LINEAR: Final = 7
LINEAR_ONLY: Final = Effort(steps=1)


def searched(fit: Separable, effects: tuple[Effect, ...]) -> Solution:
    """Fits the effects, starting from the best point of a grid over their shape parameters."""
    for index, effect in enumerate(effects):
        axes = [each.grid(GRID_LOGARITHMIC if each.logarithmic else GRID_LINEAR) for each in effect.shape]
        names = [each.name for each in effect.shape]
        best = math.inf
        for values in product(*axes):
            other = effect.fitted(effect.coefficients(), dict(zip(names, values, strict=True)))
            found = fit.fit((*effects[:index], other, *effects[index + 1 :]), LINEAR_ONLY)
            if found.chi_square < best and not found.effects[index].violations():
                best, effects = found.chi_square, found.effects
    return fit.fit(effects)


# State between the steps of an identification, and its fits.


PARTS = ("cosine", "sine")
WHOLE_TURN = 0.95
"""Minimum travel that counts as one whole turn, turns."""
COVERED_DEG = 30.0
"""Size of the cells in which the coverage of motor angles is counted."""


class State(NamedTuple):
    """Intermediate state of an identification: data, noise model, selected orders and effects."""

    options: FitOptions
    design: Design
    candidates: tuple[Order, ...]
    waves: FloatArray
    """Cosine and sine columns of the candidates, shape (b, 2 candidates)."""
    nuisances: tuple[str, ...]
    effects: tuple[Effect, ...]
    """All effects except the ripple."""
    noise: NoiseModel = NoiseModel(1.0, 1.0)
    selection: Selection = Selection((), ())
    ripple: Effect | None = None
    """Ripple of the last fit."""
    outliers: Outliers = Outliers(0, 0, 0)
    delay_ms: float = 0.0
    """Encoder delay for which the samples have already been corrected."""

    def precision(self) -> Precision:
        """Returns the precision matrix (inverse covariance) of the current noise model."""
        return Precision(self.noise, self.design.blocks)

    def in_addition(self) -> Nuisances:
        """Returns the columns of the zero offsets and of the nuisances."""
        waves = []
        for order, amplitude_arcsec, phase_deg in self.ripple.waves() if self.ripple else ():
            at = 2 * self.candidates.index(Order.motor(round(order)))
            wave = amplitude_arcsec * np.exp(1j * np.deg2rad(phase_deg))
            turned = wave * (self.waves[:, at] + 1j * self.waves[:, at + 1])
            waves.append((order, turned.real, turned.imag))
        return nuisances_of(self.design, self.nuisances, self.effects, waves)

    def candidate_waves(self) -> Nuisances:
        """Returns the columns of all candidate orders, with unknown amplitudes."""
        return unknown(self.waves, [f"{each} {part}" for each in self.candidates for part in PARTS])

    def columns(self) -> Nuisances:
        """Returns the columns of zero offsets, nuisances and the selected orders of load and flexspline."""
        others = [
            (f"{order} {part}", 2 * at + number)
            for at, order in enumerate(self.candidates)
            if order in self.selection.chosen and order.family is not Family.MOTOR
            for number, part in enumerate(PARTS)
        ]
        picked = self.waves[:, [at for _, at in others]]
        return self.in_addition().and_also(unknown(picked, [name for name, _ in others]))

    def model(self) -> tuple[Effect, ...]:
        """Returns the effects of the model: the ripple of the selected motor orders, and all others."""
        motor = [each.number for each in self.selection.chosen if each.family is Family.MOTOR]
        return ((ripple(motor),) if motor else ()) + self.effects

    def under(self, weighting: Weighting, columns: Nuisances) -> Separable:
        """Returns a solver for effects with this weighting and these additional columns."""
        return Separable(Terms(self.design.blocks.error_arcsec, self.design.columns, weighting, columns))

    def fitted(self) -> Solution:
        """Fits the effects of `model` with the current noise model."""
        return self.under(self.precision(), self.columns()).fit(self.model())

    def information(self) -> System:
        """Returns the normal equations of [candidates | zero offsets, nuisances | effects, their tangents].

        The tangents allow for a refit of the shape parameters with every candidate order.
        """
        precision, nuisances = self.precision(), self.candidate_waves().and_also(self.in_addition())
        found = self.under(precision, nuisances).fit(self.effects, LINEAR_ONLY)
        right = found.jacobian.T @ precision.apply(self.design.blocks.error_arcsec)
        mean, known = np.array(nuisances.prior).T
        right[: len(mean)] += known * mean
        zeros = 2 * len(self.candidates) + np.arange(self.design.samples.zeros)
        return System(found.information, right, np.flatnonzero(known > 0.0), zeros)

    def selected(self, system: System | None = None) -> State:
        """Returns the state with the orders that are significant at the current noise.

        ``system`` is the result of `information`, if it is already known.
        """
        options = self.options
        found = select(
            self.candidates, system or self.information(), options.family_wise, options.smallest_arcsec
        )
        return self._replace(selection=found)

    def after(self, solution: Solution) -> State:
        """Returns the state with the effects of a solution, and the block variances that follow from them."""
        effects = tuple(each for each in solution.effects if not is_ripple(each) and not each.violations())
        own = next(filter(is_ripple, solution.effects), None)
        return self._replace(effects=effects, design=self.design.blurred(effects), ripple=own)

    def remade(self, samples: Samples, weight: FloatArray, delay_ms: float) -> State:
        """Returns the state with blocks rebuilt from delay-corrected samples; outliers have zero weight."""
        design = Design.of(samples, make_blocks(samples, weight), self.design.starts).blurred(self.effects)
        waves = harmonics(design, [each.per_motor_turn for each in self.candidates])
        return self._replace(design=design, waves=waves, delay_ms=delay_ms)


def candidate_orders(design: Design, options: FitOptions) -> tuple[Order, ...]:
    """Returns the candidate orders that the travel can resolve.

    Neighbouring orders are separable over at least one whole turn (Rayleigh criterion). Motor orders need a
    motor turn. Load and flexspline orders need almost a whole load turn.
    """
    ratio = design.samples.ratio
    if turns_covered(design) < WHOLE_TURN:
        return ()
    samples = design.samples
    travel_deg = max(float(np.ptp(samples.motor_deg[samples.zero == each])) for each in range(samples.zeros))
    turns = travel_deg / DEG_PER_TURN
    motor = [Order.motor(number) for number in range(1, options.highest_order + 1)]
    if turns < WHOLE_TURN * ratio:
        return tuple(motor)
    numbers = range(1, options.load_orders + 1)
    return (
        *motor,
        *(Order.load(number, ratio) for number in numbers if number < ratio),
        *(Order.flexspline(number, ratio) for number in numbers if number * turns / ratio > 1.5),
    )


def turns_covered(design: Design) -> float:
    """Returns the range of motor angles covered with one encoder zero, turns; the maximum over all zeros."""
    blocks = design.blocks
    cell = np.floor(blocks.motor_deg / COVERED_DEG).astype(np.intp)
    seen = (len(np.unique(cell[blocks.zero == zero])) for zero in range(design.samples.zeros))
    return max(seen, default=0) * COVERED_DEG / DEG_PER_TURN
