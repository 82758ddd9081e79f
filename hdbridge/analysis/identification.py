"""What an identification says."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.ndimage import median_filter

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
from hdbridge.effects import USUAL_LOOP, BoolArray, Effect, FloatArray, Start, is_ripple, ripple
from hdbridge.effects.path import branches
from hdbridge.errors import InputError
from hdbridge.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG, DEG_PER_TURN

WORTH = 0.01
"""Share of its rms by which what a model leaves on held-out data must fall at least.

A model that is better by less changes no stepping test, and noise alone offers it: a second calibration of
the unchanged demo axis leaves 0.8 % less.
"""


@dataclass(frozen=True, slots=True)
class NoiseFigures:
    """How noisy the record is, and how far the model's residual is above that."""

    standing_arcsec: float | None
    """Rms about the mean of each rest; None where the axis never stood for long enough."""
    laps_arcsec: float | None
    """What two passes over the same angles in one direction differ by, over the root of two."""
    model: NoiseModel
    """White noise and wanders as the intervals use them, from the residual."""
    residual_arcsec: float
    """Rms that the model, as it is written, leaves of a sample, about its zero."""
    fitted_arcsec: float
    """The same with all that was fitted in addition and is not written: delay, rounding, other orders."""
    samples: int
    """Used by the fit."""
    effective_samples: float
    """Independent samples of the residual's size that would fix the zero as well as these do."""


@dataclass(frozen=True, slots=True)
class Outliers:
    """Samples that stand out alone and were given no weight."""

    samples: int
    longest_run: int


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """One question to the residual."""

    name: str
    """motor_angle, load_angle, direction, time, whiteness, noise_level."""
    passed: bool
    size_arcsec: float
    """How large what was found is."""
    text: str


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How well a model fitted to the rest of a record tells the part that was left out."""

    gain: Gain | None
    """Of the model alone against the active one, or none, each about its zero; None where nothing was held
    out.
    """
    in_addition: Gain | None
    """The same with all that is fitted in addition to the model (delay, load orders) taken off of both."""
    fitted_arcsec: float
    """Rms that the fit leaves of the same data, with all that is fitted in addition to the model."""
    text: str

    @property
    def improves(self) -> bool:
        """Whether the model is worth having.

        With the nuisances taken off, what it leaves falls by more than chance and by at least `WORTH` of its
        rms; alone it is not worse.
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
        """Whether the model leaves more of what was left out than the active one, or none, does."""
        return self.gain is not None and self.gain.recovered < 0.0


@dataclass(frozen=True, slots=True)
class Nuisance:
    """Something that was fitted in addition to the model so that it does not bend it."""

    name: str
    text: str
    value: float
    half_width: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Block means for plots, all shape (b,)."""

    time_s: FloatArray
    motor_deg: FloatArray
    load_deg: FloatArray
    direction: FloatArray
    """1, -1, or 0 at rest."""
    kind: tuple[str, ...]
    """Names that ``kind_index`` points into."""
    kind_index: np.ndarray[Any, np.dtype[np.intp]]
    error_arcsec: FloatArray
    """Observed, zero taken off."""
    predicted_arcsec: FloatArray
    """The model's effects."""
    residual_arcsec: FloatArray
    """Observed minus model, about the zeros that suit it."""
    orders_arcsec: FloatArray
    """Observed without hysteresis, zero and nuisances."""


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """The model that a record shows, and how far it can be trusted."""

    model: TransmissionModel
    """With ``uncertainty``: 95 % half widths, nested like the parameters."""
    intervals: tuple[Interval, ...]
    zeros_arcsec: tuple[float, ...]
    """Offset of each absolute zero against the median of its record's error."""
    nuisances: tuple[Nuisance, ...]
    noise: NoiseFigures
    outliers: Outliers
    orders: tuple[Line, ...]
    """Of the motor, in the model."""
    spectrum: tuple[Line, ...]
    """All orders that were looked for."""
    residual_tests: tuple[ResidualTest, ...]
    held_out: HeldOut
    traces: Traces
    warnings: tuple[str, ...]
    """What the data cannot say, in words."""

    def interval(self, effect: str, parameter: str) -> Interval:
        """The interval of one parameter; KeyError where it was not fitted."""
        for each in self.intervals:
            if (each.effect, each.parameter) == (effect, parameter):
                return each
        raise KeyError(f"{effect}: {parameter}")


# Noise as the axis itself shows it, without any model: at rest, and between one lap and the next.


SHORTEST_REST_S = 1.0
LONGEST_GAP_S = 0.5
LAP_BIN_DEG = 30.0
WINDOW = 51
"""Samples whose median an outlier is compared with."""
OUTLYING = 6.0
"""Robust standard deviations."""


def standing_arcsec(samples: Samples) -> float | None:
    """Noise of the load encoder at rest: rms about the mean of each rest.

    A motor that rests between two counts of its encoder flickers, which is no noise of the load; a sine or
    sweep that creeps within a count seems to rest, while the load goes on.
    """
    still = samples.usable & (np.abs(samples.speed_deg_s) < REST_DEG_S)
    still &= ~samples.of_kind(*SLOW)
    # What was not recorded may have been a motion.
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
    """Rms by which passes in the same direction differ, over the root of two; means over `LAP_BIN_DEG`."""
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
                # The first cells of a pass are on the travel across the hysteresis.
                keep = slice(5, None) if sign > 0 else slice(None, -5)
                passes[sign].append(dict(zip(cells[keep].tolist(), means[keep].tolist(), strict=True)))
    differences = [
        earlier[cell] - later[cell]
        for each in passes.values()
        for earlier, later in pairwise(each)
        for cell in earlier.keys() & later.keys()
    ]
    return float(np.sqrt(np.mean(np.square(differences)) / 2.0)) if len(differences) >= 8 else None


def outlying(residual: FloatArray, count_arcsec: float = 0.0) -> tuple[FloatArray, Outliers]:
    """Weights (n,), 0 for samples far from the median of their neighbours; NaN residuals keep 1.

    Compared with neighbours and not with the model, so that what the model lacks is not thrown away, and a
    step that stays (lost counts) is left in for all to see. ``count_arcsec`` is the motor encoder's count at
    the load: a motor between two counts reads now the one and now the other, and only their mean is right.
    """
    weight = np.ones(len(residual))
    index = np.flatnonzero(np.isfinite(residual))
    if len(index) < WINDOW:
        return weight, Outliers(0, 0)
    values = residual[index]
    off = np.abs(values - median_filter(values, WINDOW, mode="nearest"))
    scale = max(median_deviation(off), 0.1)
    out = off > OUTLYING * scale + count_arcsec
    weight[index[out]] = 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], out, [False]]).astype(np.int8)))
    runs = edges[1::2] - edges[::2]
    return weight, Outliers(int(np.count_nonzero(out)), int(np.max(runs, initial=0)))


# Which samples of a calibration are near enough to standing to be used, by what the axis was doing.


MINIMUM_SAMPLES = 8
SETTLE_SHARE = 0.2
"""After a turn, where the hysteresis rises too steeply for a load on a spring to follow, no more than this
share of the travel to the next one is left out."""
STANDING_DEG_S = 1e-3
"""Load speed below which an axis stands."""
GENTLE_DEG_S2 = 40.0
"""Load acceleration that a motion of which nothing is known may have."""
RESTING = ("reference", "standstill")
SLOW = ("sweep", "sine", "reversal")
"""Legs whose own speed is what is meant by slow."""
KNOWN = (*RESTING, *ON_THE_WAY, *SLOW)


def usable_samples(measured: Measured, ratio: float, slow_deg_s: float | None = None) -> Samples:
    """Samples, errors about the median of each zero. InputError where there is too little, or the ratio is
    not this gear's.

    ``slow_deg_s`` is the load speed up to which samples are used; by default the one of the slow legs.
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
    """Samples at rest and in slow motions, not within `SETTLE_S` after fast ones.

    A motion counts as a whole, from rest or turn to the next: the start of a fast move is no slow motion. Of
    moves and steps only the rests are used. Where nothing is known of a record, what accelerates is left out.
    """
    speed, acceleration = samples.speed_deg_s / samples.ratio, samples.motion.motor_acceleration_deg_s2
    assert acceleration is not None
    moving = np.abs(speed)
    own = moving[samples.of_kind(*SLOW) & (moving > 0)]
    if slow_deg_s is None:
        slow_deg_s = 1.2 * float(np.quantile(own, 0.995)) if len(own) else np.inf
    under_way = moving > STANDING_DEG_S
    fast = under_way & samples.of_kind(*ON_THE_WAY)
    fast |= ~samples.of_kind(*KNOWN) & (np.abs(acceleration / samples.ratio) > GENTLE_DEG_S2)
    # Motions that follow one another without a rest are distinguished by their kind and direction.
    changes = [np.diff(each) != 0 for each in (under_way, samples.kind, np.sign(speed))]
    first = np.append(0, np.flatnonzero(np.any(changes, axis=0)) + 1)
    fastest = np.repeat(np.maximum.reduceat(moving, first), np.diff(np.append(first, len(samples))))
    fast |= under_way & (fastest > slow_deg_s)
    return ~settling(fast, samples.time_s)


def _has_turned(time: FloatArray, motor_deg: FloatArray) -> BoolArray:
    """Samples within `SETTLE_S` after a turn."""
    turned = np.zeros(len(time), dtype=bool)
    turning, _ = branches(motor_deg)
    for first, last in pairwise(turning[1:]):
        settled = time[first] + min(SETTLE_S, SETTLE_SHARE * float(time[last] - time[first]))
        turned[first + 1 : int(np.searchsorted(time, settled, "right"))] = True
    return turned


# What an identification may be told.


@dataclass(frozen=True, slots=True)
class FitOptions:
    """All have defaults that suit the bench's own recordings."""

    effects: tuple[Effect, ...] = (USUAL_LOOP,)
    """Fitted in addition to the ripple. Where data cannot say, their shapes stay as given here."""
    highest_order: int = 24
    """Motor orders up to this are looked for."""
    load_orders: int = 4
    """Orders of the load turn and of the flexspline that are fitted in addition to the model if they show."""
    family_wise: float = 0.01
    """Chance that noise alone puts any order in."""
    smallest_arcsec: float = 0.1
    """Orders below this are left out however certain they are."""
    start: Start | None = None
    """Elastic state at the first sample: `Start.FORWARD` after the bench's pre-conditioning; None: by fit."""
    active: TransmissionModel | None = None
    """The model that the new one has to beat, and whose shapes it falls back on."""

    def prototype(self, effect: Effect) -> Effect:
        """The active model's effect of the same name, else the effect."""
        active = self.active.effects if self.active else ()
        return next((each for each in active if each.name == effect.name), effect)


# Where to begin: the best point of a grid over all shapes.


GRID_LOGARITHMIC: Final = 12
GRID_LINEAR: Final = 7
LINEAR_ONLY: Final = Effort(steps=1)


def searched(fit: Separable, effects: tuple[Effect, ...]) -> Solution:
    """The minimum that the best point of a grid over each effect's shapes leads to."""
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


# What the steps of an identification hand on, and the fits that are made of it.


PARTS = ("cosine", "sine")
WHOLE_TURN = 0.95
"""Turns that count as one."""
COVERED_DEG = 30.0
"""A motor angle was seen when some angle within the same cell of this size was."""


class State(NamedTuple):
    """Where an identification stands."""

    options: FitOptions
    design: Design
    candidates: tuple[Order, ...]
    waves: FloatArray
    """Columns of the candidates, (b, 2 candidates)."""
    nuisances: tuple[str, ...]
    effects: tuple[Effect, ...]
    """All but the ripple."""
    noise: NoiseModel = NoiseModel(1.0, 1.0)
    selection: Selection = Selection((), ())
    ripple: Effect | None = None
    """As last fitted."""
    outliers: Outliers = Outliers(0, 0)
    delay_ms: float = 0.0
    """By which the samples have been put right already."""

    def precision(self) -> Precision:
        """Of the present noise model."""
        return Precision(self.noise, self.design.blocks)

    def in_addition(self) -> Nuisances:
        """Zeros and nuisances."""
        waves = []
        for order, amplitude_arcsec, phase_deg in self.ripple.waves() if self.ripple else ():
            at = 2 * self.candidates.index(Order.motor(round(order)))
            wave = amplitude_arcsec * np.exp(1j * np.deg2rad(phase_deg))
            turned = wave * (self.waves[:, at] + 1j * self.waves[:, at + 1])
            waves.append((order, turned.real, turned.imag))
        return nuisances_of(self.design, self.nuisances, self.effects, waves)

    def candidate_waves(self) -> Nuisances:
        """All candidates."""
        return unknown(self.waves, [f"{each} {part}" for each in self.candidates for part in PARTS])

    def columns(self) -> Nuisances:
        """Zeros and nuisances, and the chosen orders that are not the motor's."""
        others = [
            (f"{order} {part}", 2 * at + number)
            for at, order in enumerate(self.candidates)
            if order in self.selection.chosen and order.family is not Family.MOTOR
            for number, part in enumerate(PARTS)
        ]
        picked = self.waves[:, [at for _, at in others]]
        return self.in_addition().and_also(unknown(picked, [name for name, _ in others]))

    def model(self) -> tuple[Effect, ...]:
        """The chosen motor orders as the ripple, and the other effects."""
        motor = [each.number for each in self.selection.chosen if each.family is Family.MOTOR]
        return ((ripple(motor),) if motor else ()) + self.effects

    def under(self, weighting: Weighting, columns: Nuisances) -> Separable:
        """Fits of effects."""
        return Separable(Terms(self.design.blocks.error_arcsec, self.design.columns, weighting, columns))

    def fitted(self) -> Solution:
        """The minimum near where the model stands."""
        return self.under(self.precision(), self.columns()).fit(self.model())

    def information(self) -> System:
        """J' K^-1 J and J' K^-1 y of [candidates | zeros and nuisances | effects and their tangents].

        With the tangents in, shapes are refitted with every order that is tried.
        """
        precision, nuisances = self.precision(), self.candidate_waves().and_also(self.in_addition())
        found = self.under(precision, nuisances).fit(self.effects, LINEAR_ONLY)
        right = found.jacobian.T @ precision.apply(self.design.blocks.error_arcsec)
        mean, known = np.array(nuisances.prior).T
        right[: len(mean)] += known * mean
        return found.information, right

    def selected(self, system: System | None = None) -> State:
        """With the orders that this noise lets one see; ``system`` is `information`, where it is at hand."""
        options = self.options
        found = select(
            self.candidates, system or self.information(), options.family_wise, options.smallest_arcsec
        )
        return self._replace(selection=found)

    def after(self, solution: Solution) -> State:
        """With a solution's effects, and the blur that they bring."""
        effects = tuple(each for each in solution.effects if not is_ripple(each) and not each.violations())
        own = next(filter(is_ripple, solution.effects), None)
        return self._replace(effects=effects, design=self.design.blurred(effects), ripple=own)

    def remade(self, samples: Samples, weight: FloatArray, delay_ms: float) -> State:
        """With corrected samples and without outliers."""
        design = Design.of(samples, make_blocks(samples, weight), self.design.starts).blurred(self.effects)
        waves = harmonics(design, [each.per_motor_turn for each in self.candidates])
        return self._replace(design=design, waves=waves, delay_ms=delay_ms)


def candidate_orders(design: Design, options: FitOptions) -> tuple[Order, ...]:
    """Orders to look for: what the travel resolves.

    Neighbouring orders are apart from each other, and from all else that varies along the travel, from a
    whole turn on (Rayleigh): orders of the motor need a motor turn, those of load and flexspline enough of a
    load turn.
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
    """Motor turns of different angles that were seen about one zero."""
    blocks = design.blocks
    cell = np.floor(blocks.motor_deg / COVERED_DEG).astype(np.intp)
    seen = (len(np.unique(cell[blocks.zero == zero])) for zero in range(design.samples.zeros))
    return max(seen, default=0) * COVERED_DEG / DEG_PER_TURN
