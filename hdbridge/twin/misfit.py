"""Residuals between a recording and its replay, by channel: noise, scales, misfit, and the verdict on a twin.

The replay has no noise, unrounded encoders and torque, and loops that close on a much finer encoder, so the
residuals are smooth in the plant's parameters. The scale of each channel accounts for rounding and noise.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr

from hdbridge.analysis.readings import median_deviation
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import FloatArray
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.truth import Truth
from hdbridge.twin.compare import noise_of, rms
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, with_load_encoder
from hdbridge.twin.replay import (
    RUN_IN_S,
    STANDS_COUNTS,
    Commands,
    commands_of,
    continuous,
    demand_deg,
    legs_of,
    run,
    standing,
    stretches,
    unknown_rows,
)
from hdbridge.units import ARCSEC_PER_DEG, rounded

# ----------------------------------------------------------------
# Residuals between a recording and its replay, by channel, which a fit minimises.

FINEST_STEPS_PER_TURN = 2**40
"""Resolution of the loops' encoder in a smooth replay. One step changes the torque by about 1e-9 of the
rated torque. With a drive's own steps, the smallest change of a parameter would disturb the torque as
much as a relevant change."""
CHANNELS = (FOLLOWING, TORQUE, LOAD)
Mask = NDArray[np.bool_]
UNKNOWN_DEG = 60.0
"""Motor travel after which the elastic state and the loops' integral no longer depend on the time before the
recording, unless both are known (because the gear has no such state, or from the holding torque)."""
LONGEST_LEG_S = 2.0
"""Maximum length of a leg; a longer one is split, because residuals further apart are uncorrelated."""
COARSE_S = 17.0
"""Total duration of the pieces for the first steps of a fit: a sweep, steps and a sine of the plan
`dynamics`, each after its run-in."""
WITHOUT_MOTION = frozenset({"standstill", "reference", "settle"})
"""Kinds of legs that do not add to the variety of motion of a coarse fit."""
HELD_OUT = 4


@dataclass(frozen=True, eq=False)
class Piece:
    """One part of a recording, prepared for replays."""

    commands: Commands
    measured: Mapping[str, FloatArray]
    """Following error in motor degrees, torque in Nm and load angle in arcsec, by channel."""
    counts: Mapping[str, Mask]
    """Mask of the rows that are used, by channel."""
    leg: NDArray[np.intp]
    """Leg number of each row, from zero."""
    kind: tuple[str, ...]
    out: Mask
    """Mask of the rows of held-out legs."""
    rest: Mask
    """Mask of the rows at which the command has been at rest for `RINGING_S`."""


@dataclass(frozen=True, eq=False)
class Data:
    """Recordings prepared for replays of truths like ``base``; columns contain the rows of all pieces."""

    axis: AxisConfig
    base: Truth
    pieces: tuple[Piece, ...]

    @cached_property
    def parts(self) -> list[slice]:
        """Rows of each piece."""
        ends = np.cumsum([len(each.out) for each in self.pieces]).tolist()
        return [slice(first, end) for first, end in pairwise([0, *ends])]

    @cached_property
    def measured(self) -> dict[str, FloatArray]:
        """Measured signals by channel, like `Piece.measured`."""
        return {name: np.concatenate([each.measured[name] for each in self.pieces]) for name in CHANNELS}

    @cached_property
    def counts(self) -> dict[str, Mask]:
        """Mask of the rows that are used, by channel."""
        return {name: np.concatenate([each.counts[name] for each in self.pieces]) for name in CHANNELS}

    @cached_property
    def leg(self) -> NDArray[np.intp]:
        """Leg number of each row, consecutive over all pieces."""
        firsts = np.cumsum([0, *(len(each.kind) for each in self.pieces)])[:-1]
        return np.concatenate([first + each.leg for first, each in zip(firsts, self.pieces, strict=True)])

    @cached_property
    def out(self) -> Mask:
        """Mask of the rows of held-out legs."""
        return np.concatenate([each.out for each in self.pieces])

    @cached_property
    def moving(self) -> Mask:
        """Mask of the rows at which the command moves, or has rested for less than `RINGING_S`."""
        return ~np.concatenate([each.rest for each in self.pieces])

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of all legs, by leg number."""
        return tuple(kind for each in self.pieces for kind in each.kind)


def motor_deg(piece: Piece, axis: AxisConfig) -> FloatArray:
    """Returns the measured motor angle of each row; degrees."""
    return np.asarray(demand_deg(piece.commands, axis) - piece.measured[FOLLOWING], dtype=np.float64)


def held_out_legs(recording: Recording) -> tuple[Segment, ...]:
    """Returns the legs excluded from a fit: every `HELD_OUT`-th of its kind."""
    seen: dict[str, int] = {}
    out = []
    for leg in legs_of(recording):
        seen[leg.kind] = seen.get(leg.kind, 0) + 1
        if seen[leg.kind] % HELD_OUT == 0:
            out.append(leg)
    return tuple(out)


def prepare(recording: Recording, axis: AxisConfig, base: Truth) -> Data:
    """Prepares a recording, with long parts divided into stretches; InputError without a command or with a
    different gear ratio.

    Up to `RUN_IN_S` of the recording before a stretch is replayed as its run-in and is not compared.
    """
    recording.record.check_ratio(axis.gear.ratio, str(axis.path))
    record, legs, held = recording.record, legs_of(recording), held_out_legs(recording)
    begins = [whole.start for whole in continuous(record)]
    unknown = unknown_rows(record, 360.0 / axis.motor_encoder.counts_per_turn)
    pieces = []
    first = 0
    for stretch in (each for part in record.parts() for each in stretches(part, legs)):
        end = first + len(stretch)
        led = int(np.searchsorted(record.time_s, record.time_s[first] - RUN_IN_S))
        led = max(led, *(begin for begin in begins if begin <= first))
        part = record.rows(led, end)
        pieces.append(_piece(part, legs, held, np.arange(led, end) >= first, unknown[led:end], axis, base))
        first = end
    return Data(axis, base, tuple(pieces))


def coarse(data: Data, wanted_s: float = COARSE_S) -> Data:
    """Selects pieces of about ``wanted_s`` in total, first for as many kinds of motion as possible, then for
    different temperatures.
    """
    pieces, left, taken = data.pieces, [*range(len(data.pieces))], list[int]()
    begun = [each.commands.start_c for each in pieces]
    warm_c = [0.0 if None in begun or each is None else each for each in begun]

    def priority(place: int) -> tuple[int, float, float]:
        seen = WITHOUT_MOTION.union(*(pieces[each].kind for each in taken))
        apart_k = min((abs(warm_c[place] - warm_c[each]) for each in taken), default=0.0)
        return len({*pieces[place].kind} - seen), apart_k, -_replayed_s(pieces[place])

    while left:
        place = max(left, key=priority)
        left.remove(place)
        if not taken or sum(_replayed_s(pieces[each]) for each in (*taken, place)) <= wanted_s:
            taken.append(place)
    return replace(data, pieces=tuple(pieces[each] for each in sorted(taken)))


def _replayed_s(piece: Piece) -> float:
    """Returns the duration of a piece with its run-in."""
    return len(piece.commands.counts) * piece.commands.cycle_s


def traces_of(data: Data, truth: Truth) -> dict[str, FloatArray]:
    """Replays a truth smoothly; returns its traces by channel, like `Data.measured`."""
    parts, shown = [each.commands for each in data.pieces], []
    for piece, traces in zip(data.pieces, run(parts, data.axis, smooth(truth), smooth=True), strict=True):
        following = demand_deg(piece.commands, data.axis) - traces["motor_position_deg"]
        shown.append((following, traces["motor_torque_nm"], traces["load_position_deg"] * ARCSEC_PER_DEG))
    return {name: np.concatenate(each) for name, each in zip(CHANNELS, zip(*shown, strict=True), strict=True)}


def residuals(data: Data, truth: Truth) -> dict[str, FloatArray]:
    """Returns measured minus simulated by channel over all rows, shape (n,); zero for rows that are not used.

    Zero offsets are removed in each piece: the zero offset of the load angle is independent of that of the
    motor, and a constant following error of more than a count at rest means that the command has a different
    zero offset. The part of the load residual that follows from the motor's is removed, because a lag of the
    motor delays the load.
    """
    shown = traces_of(data, truth)
    found = {name: data.measured[name] - shown[name] for name in CHANNELS}
    step_deg = rounding(data.axis)[FOLLOWING]
    for piece, rows in zip(data.pieces, data.parts, strict=True):
        if piece.rest.any() and abs(np.median(piece.measured[FOLLOWING][piece.rest])) > (
            STANDS_COUNTS * step_deg
        ):
            found[FOLLOWING][rows] -= np.median(found[FOLLOWING][rows][piece.rest])
    for name, counts in data.counts.items():
        found[name] *= counts
    found[LOAD] = _without_motor_part(data, found[FOLLOWING], found[LOAD])
    return found


def beyond(values: FloatArray, least: float) -> FloatArray:
    """Shrinks values towards zero by ``least`` (soft threshold)."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - least, 0.0), dtype=np.float64)


def _without_motor_part(data: Data, following: FloatArray, load: FloatArray) -> FloatArray:
    """Returns the load's residuals without the part due to the motor, relative to the median of each piece.

    The motor's residuals, without its encoder's rounding, are multiplied by a regression coefficient between
    0 and 1 and subtracted. The coefficient is 1 if the loops are wrong and both shafts lag.
    """
    ahead = -beyond(following, 0.5 * rounding(data.axis)[FOLLOWING]) * ARCSEC_PER_DEG / data.axis.gear.ratio
    motor, shaft = (_about(np.mean, each, data) for each in (ahead, load))
    size = float(motor @ motor)
    share = min(max(float(motor @ shaft) / size, 0.0), 1.0) if size > 0.0 else 0.0
    return _about(np.median, load - share * ahead, data)


def _about(centre: Callable[[FloatArray], Any], load: FloatArray, data: Data) -> FloatArray:
    """Subtracts the centre of each piece from a column of the load; zero for rows that are not used."""
    left, counts = np.zeros(len(load)), data.counts[LOAD]
    for rows in data.parts:
        inside = counts[rows]
        if inside.any():
            left[rows] = (load[rows] - centre(load[rows][inside])) * inside
    return left


def rounding(axis: AxisConfig) -> dict[str, float]:
    """Returns the resolution of a recording by channel, in its unit."""
    return {
        FOLLOWING: 360.0 / axis.motor_encoder.counts_per_turn,
        TORQUE: 1e-3 * axis.drive.rated_torque_nm,
        LOAD: axis.load_encoder.resolution_arcsec,
    }


def smooth(truth: Truth) -> Truth:
    """Returns the truth without noise, with loops that close on a much finer encoder."""
    motor, servo = truth.motor.encoder, truth.servo
    steps = max(FINEST_STEPS_PER_TURN // motor.counts_per_turn, motor.interpolation)
    finer = steps / motor.interpolation
    # Unchecked, beyond the limits of a truth file. The bands are in steps of the loops' encoder.
    loops = servo.model_copy(
        update={
            "integral_dead_band": (servo.integral_dead_band + 0.5) * finer - 0.5,
            "hunting_band": (servo.hunting_band + 0.5) * finer - 0.5,
        }
    )
    encoder = motor.model_copy(update={"interpolation": steps})
    return with_load_encoder(truth, noise_arcsec=0.0).model_copy(
        update={"motor": truth.motor.model_copy(update={"encoder": encoder}), "servo": loops}
    )


def _piece(
    part: Record,
    legs: Sequence[Segment],
    held_out: Sequence[Segment],
    judged: Mask,
    unknown: Mask,
    axis: AxisConfig,
    base: Truth,
) -> Piece:
    """Prepares a part; only ``judged`` rows that are not ``unknown`` are used."""
    commands = commands_of(part, axis, base)
    leg, kinds = _legs(part, legs)
    out = np.zeros(len(part), dtype=np.bool_)
    for each in held_out:
        out |= (part.time_s >= each.start_s) & (part.time_s <= each.end_s)
    travelled = np.abs(np.diff(part.motor_position_deg, prepend=part.motor_position_deg[0]))
    elastic = unknown | (np.cumsum(travelled) < (UNKNOWN_DEG if has_memory(base) else 0.0))
    # Between two parts the drive's loops may have been restarted.
    loops = elastic | (np.cumsum(np.where(judged, travelled, 0.0)) <= UNKNOWN_DEG)
    stuck, still, held = standing(part, 360.0 / axis.motor_encoder.counts_per_turn)
    rests = stuck & still
    torque = part.columns.get("motor_torque_nm")
    if torque is not None:
        # The holding torque at rest is the value of the integral.
        known = held[0] if len(held) else len(loops)
        loops[known:] = unknown[known:]
    measured = {
        FOLLOWING: part.columns["motor_target_deg"] - part.motor_position_deg,
        TORQUE: torque if torque is not None else np.zeros(len(part)),
        LOAD: part.load_position_deg * ARCSEC_PER_DEG,
    }
    # At rest, the position within a count is unknown but constant. All rows of a rest therefore count as a
    # single load reading, and the following error is not used.
    again = np.append(rests[:-1] & rests[1:], False)
    counts = {
        FOLLOWING: judged & ~(unknown | rests),
        TORQUE: judged & ~(stuck | still | loops) & (torque is not None),
        LOAD: judged & ~(elastic | again),
    }
    return Piece(commands, measured, counts, leg, kinds, out, stuck)


def has_memory(truth: Truth) -> bool:
    """Returns True if the gear's angle depends on the history of the motor."""
    gear, load = truth.gear, truth.load_
    return bool(
        gear.hysteresis or gear.second_hysteresis or gear.backlash_arcsec or gear.flank or gear.wear
        or gear.creep or gear.seat or load.presliding or load.coulomb_nm
    )  # fmt: skip


def _legs(part: Record, legs: Sequence[Segment]) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Returns the leg number of each row, from zero, and the legs' kinds; the gap after a leg belongs to this
    leg.
    """
    starts: list[tuple[float, str]] = []
    for each in legs:
        if each.end_s >= part.time_s[0] and each.start_s <= part.time_s[-1]:
            length_s = each.end_s - each.start_s
            pieces = max(1, int(length_s // LONGEST_LEG_S))
            starts += [(each.start_s + place * length_s / pieces, each.kind) for place in range(pieces)]
    if not starts:
        starts = [(float(part.time_s[0]), "motion")]
    starts.sort(key=lambda each: each[0])
    places = np.searchsorted([start for start, _ in starts], part.time_s, side="right") - 1
    return np.maximum(places, 0), tuple(kind for _, kind in starts)


# ----------------------------------------------------------------
# Parallel replays.

MOST_WORKERS: Final = 8
"""Maximum number of threads by default; a fit requests some thirty replays at a time."""


class Replays:
    """Replays of the same recordings; a context manager that owns the threads.

    Compiled replays release Python's lock, so threads do not wait for each other.
    """

    rough: Replays
    """Replays of a few legs of these recordings, in the same threads."""

    def __init__(self, data: Data, workers: int | None = None) -> None:
        self.data = data
        self._pool = ThreadPoolExecutor(workers or min(os.cpu_count() or 1, MOST_WORKERS))
        self.rough = copy(self)
        self.rough.data, self.rough.rough = coarse(data), self.rough

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self._pool.shutdown(cancel_futures=True)

    def __call__(self, truths: Iterable[Truth]) -> list[dict[str, FloatArray]]:
        """Returns the residuals of each truth, in order."""
        return list(self._pool.map(partial(residuals, self.data), truths))


# ----------------------------------------------------------------
# Likelihood of a rounded reading under an unrounded simulation.

FINE = 1e-3
"""Rounding is negligible if half the resolution is below this, in standard deviations."""
OUTLIER_SHARE = 0.02
"""Expected fraction of outliers among the readings. The break-away of a stuck motor and its position at
switch-on are evidence neither of a simulation error nor of a parameter."""


def deviance_residuals(
    off: FloatArray, half: FloatArray, outlier_probability: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns residuals whose half squares are the loss of log likelihood, and their derivative with respect
    to ``off``.

    ``off`` is reading minus simulation, ``half`` half the resolution, both in standard deviations of the
    simulation, shape (n,); ``outlier_probability`` by row. Without resolution, ``off`` is returned
    unchanged.
    """
    size, plain = np.abs(off), half == 0.0
    outlier_probability = np.where(
        half < FINE, outlier_probability * FINE / np.where(plain, 1.0, half), outlier_probability
    )
    half = np.maximum(half, FINE)
    least = surprisal(np.zeros_like(half), half, outlier_probability)
    lost = surprisal(size, half, outlier_probability)
    root = np.sqrt(2.0 * np.maximum(lost - least, 0.0))
    rise = np.exp(lost - 0.5 * np.square(size - half)) * -np.expm1(-2.0 * size * half) / np.sqrt(2.0 * np.pi)
    flat = np.sqrt(2.0 * half * np.exp(least - 0.5 * np.square(half)) / np.sqrt(2.0 * np.pi))
    inner = root < 1e-4
    slope = np.where(inner, flat, rise / np.where(inner, 1.0, root))
    root = np.where(inner, flat * size, root)
    return np.sign(off) * np.where(plain, size, root), np.where(plain, 1.0, slope)


def surprisal(size: FloatArray, half: FloatArray, outlier_probability: FloatArray) -> FloatArray:
    """Returns the negative log probability of a reading at a distance ``size`` >= 0 from the simulation."""
    nearer = log_ndtr(half - size)
    inside = nearer + np.log1p(-np.exp(np.minimum(log_ndtr(-size - half) - nearer, -1e-12)))
    with np.errstate(divide="ignore"):
        return np.asarray(-np.logaddexp(inside, np.log(outlier_probability)), dtype=np.float64)


def deviation(off: FloatArray, step: float, least: float) -> tuple[float, float]:
    """Estimates a simulation's standard deviation from rounded readings (maximum likelihood, >= ``least``).

    Also returns the probability of an outlier.
    """
    size = np.abs(off)
    farthest = max(float(np.max(size)), least)
    outlier_probability = OUTLIER_SHARE / (1.0 - OUTLIER_SHARE) * step / (2.0 * farthest + step)

    def cost(log_deviation: float) -> float:
        each = math.exp(log_deviation)
        half = 0.5 * step / each
        times = min(1.0, half / FINE)
        lost = surprisal(size / each, np.array(max(half, FINE)), np.array(outlier_probability / times))
        return float(np.sum(lost)) - len(size) * math.log(times)

    bounds = (np.log(least), np.log(2.0 * farthest))
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02})
    return float(np.exp(found.x)), outlier_probability


# ----------------------------------------------------------------
# Scales of the residuals: standard deviation of a simulation's error by channel.

MAX_CORRECTED_SHARE = 1.5
"""Maximum fraction of a speed error that a velocity loop corrects within a step; a loop is unstable at
two."""


@dataclass(frozen=True, eq=False)
class Scales:
    """Standard deviation of a simulation's error, and resolution of the readings, by channel.

    Without resolutions, rounding counts as noise.
    """

    deviation: Mapping[str, float]
    step: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(CHANNELS, 0.0))
    outlier_probability: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(CHANNELS, 0.0))
    """Probability of an outlier."""

    def scaled(self, found: Mapping[str, FloatArray]) -> FloatArray:
        """Returns the residuals of all channels, one after the other, in standard deviations."""
        return np.concatenate([found[name] / self.deviation[name] for name in CHANNELS])

    def halves(self, length: int) -> tuple[FloatArray, FloatArray]:
        """Returns half the resolution in standard deviations, and `outlier_probability`, by row.

        Each channel has ``length`` rows.
        """
        by_channel = [
            np.broadcast_to(0.5 * self.step[name] / self.deviation[name], length) for name in CHANNELS
        ]
        outlier_probabilities = [
            self.outlier_probability[name] if self.step[name] else 0.0 for name in CHANNELS
        ]
        return np.concatenate(by_channel), np.repeat(outlier_probabilities, length)

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the noise by channel, rounding included."""
        return {name: float(np.hypot(self.deviation[name], self.step[name] / 12.0**0.5)) for name in CHANNELS}


def noise_floor(data: Data) -> dict[str, float]:
    """Returns the minimum noise of each channel: rounding, and the torque noise from encoder rounding."""
    return Scales(least_deviation(data), rounding(data.axis)).noise


def least_deviation(data: Data) -> dict[str, float]:
    """Returns, by channel, the error of a smooth replay of the true axis beyond the readings' rounding.

    It results from the resolution of the loops' encoder and the load encoder's noise.
    """
    truth = data.base
    encoder = truth.motor.encoder
    fine_deg = 360.0 / (encoder.counts_per_turn * encoder.interpolation)
    return {
        FOLLOWING: fine_deg / 12.0**0.5,
        TORQUE: _torque_noise_nm(truth, math.radians(fine_deg)) / 12.0**0.5,
        LOAD: float(
            np.hypot(truth.load_.encoder.noise_arcsec, fine_deg * ARCSEC_PER_DEG / data.axis.gear.ratio)
        ),
    }


def _torque_noise_nm(truth: Truth, off_rad: float) -> float:
    """Returns the rms torque of the velocity loop due to independent reading errors of this rms.

    Speed is the difference of two readings divided by the step, and the motor responds within the next step.
    The transfer function is K (1 - 1/z)^2 / (dt (1 - (1 - a)/z)) with a = K dt / J; the result is its norm
    times the error.
    """
    gain, step_s = truth.servo.velocity_gain_nm_s_per_rad, truth.substep_s
    share = min(gain * step_s / truth.motor.inertia_kg_m2, MAX_CORRECTED_SHARE)
    norm = math.sqrt(1.0 + (1.0 + share) ** 2 + share**3 / (2.0 - share))
    return gain * off_rad / step_s * norm


def scales(data: Data, found: Mapping[str, FloatArray]) -> Scales:
    """Estimates the scales of the residuals in motion; the error of a smooth replay is their lower bound.

    Residuals at rest are excluded, because they would dominate a recording that rests half of the time.
    """
    least, steps = least_deviation(data), rounding(data.axis)
    given, outlier_probability = dict(least), dict.fromkeys(CHANNELS, 0.0)
    for name, counts in data.counts.items():
        inside = found[name][data.moving & counts]
        if len(inside):
            # At least half of the readings in motion are not outliers.
            typical = median_deviation(beyond(inside, 0.5 * steps[name]))
            given[name], outlier_probability[name] = deviation(inside, steps[name], max(least[name], typical))
    return Scales(given, steps, outlier_probability)


# ----------------------------------------------------------------

ARCSEC_PER_TURN = 360.0 * ARCSEC_PER_DEG


def noise_in_motion(data: Data) -> dict[str, float]:
    """Estimates the noise in motion by channel, in its unit (`compare.noise_of`); at least the rounding.

    At rest, count and torque are constant, so rest is no reference for a simulation in motion.
    """
    floor = noise_floor(data)
    return {
        name: max(floor[name], noise_of(values, data.moving, data.parts))
        for name, values in data.measured.items()
    }


def expected(data: Data) -> Scales:
    """Returns the expected scales of the residuals of the true axis, by channel.

    For following error and torque this is the rounding, because third differences of a torque result mostly
    from motion. The load encoder's noise beyond its rounding is estimated from the recording.
    """
    return Scales(noise_floor(data) | {LOAD: noise_in_motion(data)[LOAD]})


def with_load_noise(truth: Truth, residuals_arcsec: FloatArray) -> Truth:
    """Returns the truth with the load encoder's noise, from differences of residuals between rows.

    ``residuals_arcsec`` are the load's residuals, zero for rows that are not used. Rounding is subtracted.
    """
    encoder = truth.load_.encoder
    inside = residuals_arcsec != 0.0
    steps = np.diff(residuals_arcsec)[inside[1:] & inside[:-1]]
    if not len(steps):
        return truth
    spread = median_deviation(steps) / math.sqrt(2.0)
    rounding = ARCSEC_PER_TURN / encoder.counts_per_turn / math.sqrt(12.0)
    noise_arcsec = round(math.sqrt(max(spread**2 - rounding**2, 0.0)), 4)
    return with_load_encoder(truth, noise_arcsec=noise_arcsec)


# ----------------------------------------------------------------
# Misfit of a twin.

Misfit = Mapping[str, Mapping[str, float]]
"""Rms of the residuals by channel (in its unit) and by kind of leg."""


def misfit_of(
    data: Data, residuals: Mapping[str, FloatArray], rows: Mapping[str, Mask] | None = None
) -> dict[str, dict[str, float]]:
    """Returns the rms of the residuals of each recorded channel by kind of leg; all ``rows`` by default."""
    kinds = np.array(data.kinds)[data.leg]
    found: dict[str, dict[str, float]] = {}
    for name, inside in (rows or data.counts).items():
        for kind in dict.fromkeys(kinds[inside].tolist()):
            found.setdefault(name, {})[kind] = rounded(rms(residuals[name][inside & (kinds == kind)]), 6)
    return found


def signals_of(data: Data) -> dict[str, FloatArray]:
    """Returns the measured signals by channel, in its unit; for the load, its error without its mean."""
    turned_deg = np.concatenate([motor_deg(each, data.axis) for each in data.pieces])
    error = data.measured[LOAD] - ARCSEC_PER_DEG / data.axis.gear.ratio * turned_deg
    return {**data.measured, LOAD: _about(np.mean, error, data)}


SHARE: Final = 0.01
"""Minimum scale of a channel's misfit, as a fraction of its rms signal."""


def units(data: Data) -> dict[str, float]:
    """Returns the scale of each channel's misfit: a hundredth of its rms signal, or its noise if larger."""
    noise = noise_in_motion(data)
    return {
        name: max(noise[name], SHARE * rms(measured[data.counts[name]]))
        for name, measured in signals_of(data).items()
    }


def judged_rows(data: Data) -> dict[str, Mask]:
    """Returns the mask of the rows on which a twin is judged, by channel: the held-out rows, or else all."""
    return {
        name: counts & data.out if np.any(counts & data.out) else counts
        for name, counts in data.counts.items()
    }


def misfit(data: Data, left: Mapping[str, FloatArray]) -> float:
    """Returns the rms residual over all channels, each relative to `units`, on held-out legs if any."""
    scale, rows = units(data), judged_rows(data)
    return rms(np.array([rms(left[name][each] / scale[name]) for name, each in rows.items() if each.any()]))


# ----------------------------------------------------------------
# Verdict on the values of a twin, from its residuals on held-out legs.

NOISE_LEVEL: Final = 1.3
"""Maximum rms residual of an explained channel, in units of the noise in motion. Replays of the true values
of axes 608, 609 and 612 (tools/twin_random_axes.py) leave 0.3 to 1.22."""
MOST_NOISE: Final = 3.0
"""Maximum rms residual of an explained channel, in units of the noise, if it is also at most `MOST_SHARE` of
the signal. Axis 620, whose intervals contain 1 of 18 true values, leaves 2.9 to 28 with its true values."""
MOST_SHARE: Final = 0.05
"""Maximum rms residual for `MOST_NOISE`, as a fraction of the rms signal."""


class Values(StrEnum):
    """Origin of the values of a truth; `provenance.values` in its file."""

    USUAL = "usual"
    """Not fitted: the usual values of axes of this kind."""
    AXIS = "axis"
    """Fitted, the twin explains every channel (`ChannelResidual.explained`), and its legs agree about the
    parameters: the values are those of the axis."""
    REPLAY = "replay"
    """Fitted, but the fit was interrupted, at least one channel has larger residuals, or the legs disagree:
    the twin replays the motion, but its values belong to a different drive."""

    @classmethod
    def of(cls, truth: Truth) -> Values | None:
        """Returns the origin of a truth's values; None for a truth file written by hand."""
        value = truth.provenance.get("values")
        return cls(value) if value is not None else None


@dataclass(frozen=True, slots=True)
class ChannelResidual:
    """Residual of a channel."""

    cause: ClassVar[str] = "unexplained"
    channel: str
    share: float
    """Rms residual over rms signal."""
    times_noise: float
    """Rms residual over the noise in motion."""
    kind: str
    """Kind of the legs with the largest residual."""

    @property
    def text(self) -> str:
        """Describes the residual in words."""
        return (
            f"{self.channel}: residual is {self.times_noise:.3g} times the noise, most of it in legs of the "
            f"kind {self.kind}"
        )

    @property
    def explained(self) -> bool:
        """True if the residual is within the noise, or slightly above it and a small fraction of the
        signal.
        """
        return self.times_noise <= NOISE_LEVEL or (
            self.times_noise <= MOST_NOISE and self.share <= MOST_SHARE
        )


def channel_residuals(
    data: Data, residuals: Mapping[str, FloatArray], noise: Mapping[str, float]
) -> tuple[ChannelResidual, ...]:
    """Returns the residual of each recorded channel, on held-out legs if any.

    ``residuals`` by channel over all rows of the data, ``noise`` by channel in its unit (`noise_in_motion`).
    """
    rows, signals = judged_rows(data), signals_of(data)
    found = []
    for name, by_kind in misfit_of(data, residuals, rows).items():
        left, signal = rms(residuals[name][rows[name]]), rms(signals[name][rows[name]])
        share = left / signal if signal else math.inf
        found.append(
            ChannelResidual(name, share, left / noise[name], max(by_kind, key=lambda kind: by_kind[kind]))
        )
    return tuple(found)


MOST_SCATTER: Final = 9.0
"""Maximum variance of the parameters between legs, relative to that of independent residuals
(`fit.Jackknife`): three times their errors. Of 13 axes of the simulated drive, 11 had at most 4.7; of 15 axes
with other servos, each had at least 19 (tools/twin_random_axes.py, tools/twin_foreign_axes.py)."""


def values_of(left: Sequence[ChannelResidual], scatter: float) -> Values:
    """Returns the origin of fitted values: the axis if all channels are explained and its legs agree about
    the parameters, else a replay.
    """
    explained = all(each.explained for each in left)
    return Values.AXIS if explained and scatter <= MOST_SCATTER else Values.REPLAY
