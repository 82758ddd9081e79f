"""Comparison of a measured and a simulated record of the same commands.

Each difference is given together with the noise of the measured channel, which is the smallest difference
that a simulation can reach. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hdbridge.analysis.readings import third_deviation
from hdbridge.axis.effects import Channel, FloatArray
from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.twin.replay import standing, unknown_rows
from hdbridge.units import ARCSEC_PER_DEG

# ----------------------------------------------------------------
# One signal in both records, over time and as spectra. Pure.

SPECTRUM_SAMPLES: Final = 1024
SHORTEST: Final = 32
"""Minimum number of samples in a part for a spectrum."""


@dataclass(frozen=True, eq=False)
class Trace:
    """One signal in both records, over time."""

    time_s: FloatArray
    measured: FloatArray
    simulated: FloatArray

    @property
    def difference(self) -> FloatArray:
        """Measured minus simulated."""
        return self.measured - self.simulated


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitude density by frequency, in the signal's unit per root hertz."""

    frequency_hz: FloatArray
    measured: FloatArray
    simulated: FloatArray
    difference: FloatArray


def spectrum_of(trace: Trace, parts: Sequence[slice]) -> Spectrum | None:
    """Estimates the spectrum over the parts by Welch's method; None if all parts are too short."""
    steps = np.concatenate([np.diff(trace.time_s[part]) for part in parts])
    period_s = float(np.median(steps)) if len(steps) else 0.0
    if period_s <= 0.0:
        return None
    longest = max(parts, key=lambda part: part.stop - part.start)
    length = min(SPECTRUM_SAMPLES, longest.stop - longest.start)
    if length < SHORTEST:
        return None
    from scipy.signal import welch  # noqa: PLC0415 - takes a second to load

    powers: list[FloatArray] = []
    weights: list[int] = []
    frequency = np.empty(0)
    for part in parts:
        time_s = trace.time_s[part]
        grid = np.arange(time_s[0], time_s[-1], period_s)
        if min(len(time_s), len(grid)) < length:
            continue
        values = (trace.measured[part], trace.simulated[part], trace.difference[part])
        even = np.stack([np.interp(grid, time_s, each) for each in values])
        frequency, power = welch(even, 1.0 / period_s, nperseg=length, detrend="linear")
        powers.append(power)
        weights.append(len(grid))
    if not powers:
        return None
    mean = np.average(np.stack(powers), axis=0, weights=weights)
    return Spectrum(frequency, *np.sqrt(mean))


# ----------------------------------------------------------------
# Settling time of the load after a stop, and its scatter due to noise. Pure.

SETTLED_ARCSEC: Final = 10.0
"""Amplitude about the rest position below which a load has settled, arcsec: three motor counts at 8000 counts
per turn and ratio 50."""
SETTLED_NOISE: Final = 5.0
"""Lower limit for the amplitude below which a load has settled, in units of the noise of the load reading."""
OVER_S: Final = 0.04
"""Window of the rms amplitude: half a period of the slowest ringing, 15 Hz."""
SHORTEST_SWING: Final = 4
DRAWS: Final = 24


def settling_s(time_s: FloatArray, load_arcsec: FloatArray, noise_arcsec: float, band: float) -> float:
    """Returns the time from the first sample, when the command stops, until the load stays settled."""
    length = min(max(SHORTEST_SWING, round(OVER_S / float(np.median(np.diff(time_s))))), len(time_s))
    squares = np.square(load_arcsec - _rest_arcsec(load_arcsec))
    swing = 2.0 * (np.convolve(squares, np.full(length, 1.0 / length), mode="valid") - noise_arcsec**2)
    outside = np.flatnonzero(swing > band**2)
    return float(time_s[outside[-1] + 1] - time_s[0]) if len(outside) else 0.0


def scatter_s(
    time_s: FloatArray, load_arcsec: FloatArray, noise_arcsec: float, band: float, noises: Sequence[float]
) -> float:
    """Returns the standard deviation, due to noise alone, of the difference of two settling times; s.

    ``noises`` are the noise levels of the two records, arcsec. The estimate uses `DRAWS` random samples at
    each noise level.
    """
    rng = np.random.default_rng(0)
    own = settling_s(time_s, load_arcsec, noise_arcsec, band)
    squares = 0.0
    for each in noises:
        for _ in range(DRAWS):
            noisy = load_arcsec + each * rng.standard_normal(len(load_arcsec))
            squares += (settling_s(time_s, noisy, float(np.hypot(noise_arcsec, each)), band) - own) ** 2
    return float(np.sqrt(squares / DRAWS))


def overshoot_arcsec(load_arcsec: FloatArray, way: float) -> float:
    """Returns the overshoot beyond the rest position; ``way`` is the sign of the preceding motion."""
    return max(0.0, float(np.max(way * (load_arcsec - _rest_arcsec(load_arcsec)))))


def _rest_arcsec(load_arcsec: FloatArray) -> float:
    return float(np.mean(load_arcsec[-max(SHORTEST_SWING, len(load_arcsec) // 4) :]))


# ----------------------------------------------------------------

Rows = NDArray[np.bool_]
ALL: Final = "all"
"""Pseudo-kind of leg: the whole record."""
LOAD_ERROR, FOLLOWING_ERROR, MOTOR_TORQUE = "load_error", "following_error", "motor_torque"
TEMPERATURE: Final = "temperature"
SETTLING_TIME, OVERSHOOT = "settling_time", "overshoot"
NOISE_AT_REST, NOISE_IN_MOTION = "noise_at_rest", "noise_in_motion"
UNITS: Final[Mapping[str, str]] = {
    LOAD_ERROR: "arcsec", FOLLOWING_ERROR: "motor deg", MOTOR_TORQUE: "Nm",
    TEMPERATURE: "\N{DEGREE SIGN}C", SETTLING_TIME: "s", OVERSHOOT: "arcsec",
}  # fmt: skip
TITLES: Final[Mapping[str, str]] = {
    LOAD_ERROR: "load error", FOLLOWING_ERROR: "following error", MOTOR_TORQUE: "motor torque",
    TEMPERATURE: "temperature", SETTLING_TIME: "settling time", OVERSHOOT: "overshoot",
    NOISE_AT_REST: "noise at rest", NOISE_IN_MOTION: "noise in motion",
}  # fmt: skip

STAND_S: Final = 0.2
"""Minimum time for which the command must be at rest after a motion for the stop to be evaluated."""
MAX_SETTLING_S: Final = 1.0
"""Maximum time after a stop in which settling is evaluated; servo axes of this kind settle in tenths of a
second."""
CALM_S: Final = 0.3
"""Time at rest after which the ringing of a stop has ended and only noise remains."""
MOVING_DEG_S: Final = 0.05
"""Motor speed above which the command counts as moving."""
LEAST_SAMPLES: Final = 8


@dataclass(frozen=True, slots=True)
class Row:
    """One metric, compared between the two records for one kind of motion."""

    channel: str
    """A signal, `settling_time`, `overshoot`, or `noise_at_rest:` and `noise_in_motion:` with a signal."""
    kind: str
    """Kind of the legs, or `ALL`."""
    unit: str
    measured: float
    """Rms of a signal (of the load error about its mean), mean of a settling time or overshoot, or a noise
    level."""
    simulated: float
    difference: float
    """Rms difference of samples or stops; for a noise level, the absolute difference."""
    noise: float
    """Expected difference between two identical axes: the noise of the measured channel or of the metric."""
    count: int
    """Number of samples or stops."""

    @property
    def in_noise(self) -> float:
        """Difference in units of the noise; infinite without noise."""
        return self.difference / self.noise if self.noise else math.inf if self.difference else 0.0

    @property
    def share(self) -> float:
        """Difference as a fraction of the measured value."""
        return self.difference / self.measured if self.measured else math.inf if self.difference else 0.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """Metrics, traces and spectra of a measured and a simulated record."""

    rows: tuple[Row, ...]
    traces: Mapping[str, Trace]
    """Traces by signal."""
    spectra: Mapping[str, Spectrum]

    def row(self, channel: str, kind: str = ALL) -> Row | None:
        """Returns the metric of a channel; None if the records lack it."""
        return next((each for each in self.rows if (each.channel, each.kind) == (channel, kind)), None)

    def as_dict(self) -> dict[str, Any]:
        """Returns the metrics for JSON."""
        return {"figures": [asdict(each) for each in self.rows]}


def compare(measured: Record, simulated: Record, legs: Sequence[Segment], ratio: float) -> Comparison:
    """Compares two records by kind of leg and as a whole.

    Both records must have the same rows. In each part of the measured record, zero offsets between the
    encoders, and between command and motor at rest, are removed. Rows in which the load may still ring from
    an unknown motion are excluded, and so is the torque of a motor at standstill. InputError if the numbers
    of rows differ or there is no command.
    """
    if len(measured) != len(simulated):
        raise InputError(
            f"{len(measured)} rows were measured and {len(simulated)} simulated; expected one for one"
        )
    if measured.motor_target_deg is None or simulated.motor_target_deg is None:
        raise InputError(
            f"{measured.source or 'the record'}: no column motor_target_deg; expected the commanded motor "
            "angle in each row"
        )
    ends = (*measured.starts[1:], len(measured))
    parts = [slice(start, end) for start, end in zip(measured.starts, ends, strict=True)]
    time_s, command, motor = measured.time_s, measured.motor_target_deg, measured.motor_position_deg
    moves = _moving(time_s, command, parts)
    calm = ~moves
    for part in parts:
        moved_s = np.maximum.accumulate(np.where(moves[part], time_s[part], -np.inf))
        calm[part] &= time_s[part] - moved_s > CALM_S
    real, twin = _signals(measured, ratio, parts), _signals(simulated, ratio, parts)
    for part in parts:
        twin[LOAD_ERROR][part] += np.median(real[LOAD_ERROR][part] - twin[LOAD_ERROR][part])
        if np.count_nonzero(calm[part]) >= LEAST_SAMPLES:
            apart = real[FOLLOWING_ERROR][part] - twin[FOLLOWING_ERROR][part]
            twin[FOLLOWING_ERROR][part] += np.median(apart[calm[part]])
    traces = {name: Trace(time_s, one, twin[name]) for name, one in real.items() if name in twin}
    count_deg = least_change(np.concatenate([np.diff(motor[part]) for part in parts]), motor)
    groups = _groups(time_s, legs, ~unknown_rows(measured, count_deg))
    # At rest, the torque depends on a thousandth of a count, so it is not compared.
    rests = [standing(part, count_deg) for part in measured.parts()]
    goes = ~np.concatenate([each.stuck | each.still for each in rests])
    rows = [
        row
        for kind, inside in groups.items()
        for name, trace in traces.items()
        for compared in (inside & goes if name == MOTOR_TORQUE else inside,)
        for row in _of_signal(name, kind, compared, (inside & calm, inside & moves), trace, parts)
    ]
    loads = [each.load_position_deg * ARCSEC_PER_DEG for each in (measured, simulated)]
    stops = list(_stops(Trace(time_s, *loads), command, moves, parts))
    for kind, inside in groups.items():
        rows += _of_stops(kind, [stop for stop in stops if inside[stop.moved]], time_s)
    swings = (name for name in traces if name != TEMPERATURE)
    spectra = {name: found for name in swings if (found := spectrum_of(traces[name], parts)) is not None}
    return Comparison(tuple(rows), traces, spectra)


def _signals(record: Record, ratio: float, parts: Sequence[slice]) -> dict[str, FloatArray]:
    """Returns the signals of a record by name; the load error of each part is relative to its mean."""
    error = record.transmission_error_arcsec(ratio).copy()
    for part in parts:
        error[part] -= np.mean(error[part])
    found = {
        LOAD_ERROR: error,
        FOLLOWING_ERROR: record.columns["motor_target_deg"] - record.motor_position_deg,
    }
    for name, channel in ((MOTOR_TORQUE, Channel.MOTOR_TORQUE), (TEMPERATURE, Channel.TEMPERATURE)):
        if channel.value in record.columns:
            found[name] = record.columns[channel.value]
    return found


def _groups(time_s: FloatArray, legs: Sequence[Segment], known: Rows) -> dict[str, Rows]:
    """Returns the mask of the known rows of the whole record and of each kind of leg."""
    groups = {ALL: known}
    for leg in legs:
        inside = groups.setdefault(leg.kind, np.zeros(len(time_s), dtype=np.bool_))
        inside |= known & (time_s >= leg.start_s) & (time_s <= leg.end_s)
    return {kind: inside for kind, inside in groups.items() if np.count_nonzero(inside) >= LEAST_SAMPLES}


def _moving(time_s: FloatArray, command_deg: FloatArray, parts: Sequence[slice]) -> Rows:
    """Returns the mask of rows in which the command moves."""
    moves = np.zeros(len(time_s), dtype=np.bool_)
    for part in parts:
        if part.stop - part.start > 1:
            speed = np.abs(np.diff(command_deg[part])) / np.maximum(np.diff(time_s[part]), 1e-9)
            moves[part] = np.concatenate([speed[:1], speed]) > MOVING_DEG_S
    return moves


def _of_signal(
    name: str,
    kind: str,
    inside: Rows,
    rest_and_motion: tuple[Rows, Rows],
    trace: Trace,
    parts: Sequence[slice],
) -> Iterator[Row]:
    """Yields the rms difference of a signal, and its noise at rest and in motion."""
    one, other, unit = trace.measured, trace.simulated, UNITS[name]
    if count := int(np.count_nonzero(inside)):
        apart = rms(one[inside] - other[inside])
        noise = noise_of(one, inside, parts)
        if name == TEMPERATURE:
            # A replay starts at a rounded reading, so the two rounding errors add up to at most one step. A
            # constant reading does not reveal the size of a step.
            noise *= math.sqrt(12.0)
            if not noise:
                return
        yield Row(name, kind, unit, rms(one[inside]), rms(other[inside]), apart, noise, count)
    for channel, which in zip((NOISE_AT_REST, NOISE_IN_MOTION), rest_and_motion, strict=True):
        count = int(np.count_nonzero(which))
        if count >= LEAST_SAMPLES and name != TEMPERATURE:
            noises = noise_of(one, which, parts), noise_of(other, which, parts)
            own = noises[0] / math.sqrt(2.0 * count)
            yield Row(f"{channel}:{name}", kind, unit, *noises, abs(noises[0] - noises[1]), own, count)


def noise_of(values: FloatArray, which: Rows, parts: Sequence[slice]) -> float:
    """Estimates the noise of a signal from third differences; at least that of its resolution.

    Motion that is smooth over four samples does not contribute, and the median ignores rows without smooth
    motion (a jerk, a reversal). A resolution q causes a noise of q / sqrt(12).
    """
    thirds, resolution = [], math.inf
    for part in parts:
        inside = which[part]
        changes = np.diff(values[part])[inside[1:] & inside[:-1]]
        resolution = min(resolution, least_change(changes, values))
        whole = inside[3:] & inside[2:-1] & inside[1:-2] & inside[:-3]
        thirds.append(np.diff(values[part], 3)[whole])
    third = np.concatenate(thirds)
    spread = third_deviation(third) if len(third) >= LEAST_SAMPLES else 0.0
    return max(spread, resolution / math.sqrt(12.0) if math.isfinite(resolution) else 0.0)


def least_change(changes: FloatArray, values: FloatArray) -> float:
    """Returns the smallest change between readings that exceeds rounding errors."""
    beyond, size = 1e-9 * float(np.max(np.abs(values), initial=1.0)), np.abs(changes)
    return float(np.min(size, where=size > beyond, initial=math.inf))


class _Stop(NamedTuple):
    """One stop in both records."""

    moved: int
    """Last row of the motion before the stop."""
    settled_s: list[float]
    overshoot_arcsec: list[float]
    noise_arcsec: float
    scatter_s: float
    """Rms difference of the two settling times due to noise."""


def _stops(loads: Trace, command_deg: FloatArray, moves: Rows, parts: Sequence[slice]) -> Iterator[_Stop]:
    """Yields the stops, at which the command comes to rest after a motion and stays at rest.

    ``loads`` are the load angles in arcsec, ``moves`` is the mask of rows in which the command moves.
    """
    time_s, both = loads.time_s, (loads.measured, loads.simulated)
    for part in parts:
        edges = np.flatnonzero(moves[part][:-1] & ~moves[part][1:]) + part.start + 1
        starts = np.flatnonzero(~moves[part][:-1] & moves[part][1:]) + part.start + 1
        for stop in edges.tolist():
            later = starts[starts > stop]
            end = int(later[0]) if len(later) else part.stop
            end = min(end, int(np.searchsorted(time_s, time_s[stop] + MAX_SETTLING_S)), part.stop)
            if end - stop < LEAST_SAMPLES or time_s[end - 1] - time_s[stop] < STAND_S:
                continue
            earlier = starts[starts < stop]
            began = int(earlier[-1]) if len(earlier) else part.start
            way = float(np.sign(command_deg[stop] - command_deg[began]))
            rest = np.zeros(len(time_s), dtype=np.bool_)
            rest[stop + (end - stop) // 2 : end] = True
            noises = [noise_of(each, rest, [part]) for each in both]
            band = max(SETTLED_ARCSEC, SETTLED_NOISE * noises[0])
            times, after = time_s[stop:end], [each[stop:end] for each in both]
            yield _Stop(
                stop - 1,
                [settling_s(times, *each, band) for each in zip(after, noises, strict=True)],
                [overshoot_arcsec(each, way) for each in after],
                noises[0],
                scatter_s(times, after[1], noises[1], band, noises),
            )


def _of_stops(kind: str, stops: Sequence[_Stop], time_s: FloatArray) -> Iterator[Row]:
    if not stops:
        return
    sample_s = float(np.median(np.diff(time_s)))
    noise = rms(np.array([each.noise_arcsec for each in stops]))
    scatter = rms(np.array([each.scatter_s for each in stops]))
    for channel, pairs, own in (
        (SETTLING_TIME, [each.settled_s for each in stops], max(sample_s, scatter)),
        (OVERSHOOT, [each.overshoot_arcsec for each in stops], noise),
    ):
        values = np.array(pairs)
        one, other = (float(each) for each in np.mean(values, axis=0))
        yield Row(
            channel, kind, UNITS[channel], one, other, rms(values[:, 0] - values[:, 1]), own, len(pairs)
        )


def rms(values: FloatArray) -> float:
    """Returns the root mean square; 0 for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
