"""A measured and a simulated record of the same commands, side by side: how far apart they are, and where.

Every channel has its unit, and beside each difference stands the noise that the measured channel has: a
simulation can be no nearer than that. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.effects import Channel, FloatArray
from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.twin.stretches import STANDS_COUNTS, stands, unknown_rows
from hdbridge.units import ARCSEC_PER_DEG

# ----------------------------------------------------------------
# Two records of a signal over time, and their spectra. Pure.

SPECTRUM_SAMPLES: Final = 1024
SHORTEST: Final = 32
"""Samples of the shortest part that has a spectrum."""


@dataclass(frozen=True, eq=False)
class Trace:
    """A signal of both records over time, for a picture."""

    time_s: FloatArray
    measured: FloatArray
    simulated: FloatArray

    @property
    def difference(self) -> FloatArray:
        """Measured less simulated."""
        return self.measured - self.simulated


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitude density by frequency, in the signal's unit per root hertz."""

    frequency_hz: FloatArray
    measured: FloatArray
    simulated: FloatArray
    difference: FloatArray


def spectrum_of(trace: Trace, parts: Sequence[slice]) -> Spectrum | None:
    """Welch's estimate over the parts, on an even grid; None where all are too short."""
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
        if len(time_s) < length:
            continue
        grid = np.arange(time_s[0], time_s[-1], period_s)
        if len(grid) < length:
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
# When a load has settled after a stop, and by how much noise moves that. Pure.

SETTLED_ARCSEC: Final = 10.0
"""A load that swings by less than this about where it comes to rest has settled: three motor counts of 8000
at a ratio of 50."""
SETTLED_NOISE: Final = 5.0
"""... or by less than so many times the noise of the load's reading, where that is more."""
OVER_S: Final = 0.04
"""How far it swings is root two times its rms over so long: half a period of the slowest ringing, 15 Hz."""
SHORTEST_SWING: Final = 4
DRAWS: Final = 24


def band_arcsec(noise_arcsec: float) -> float:
    """Within what a load of this noise has settled."""
    return max(SETTLED_ARCSEC, SETTLED_NOISE * noise_arcsec)


def settling_s(time_s: FloatArray, load_arcsec: FloatArray, noise_arcsec: float, band: float) -> float:
    """Time from the first sample, where the command rests, until the load stays settled."""
    length = min(max(SHORTEST_SWING, round(OVER_S / float(np.median(np.diff(time_s))))), len(time_s))
    squares = np.square(load_arcsec - _rest_arcsec(load_arcsec))
    swing = 2.0 * (np.convolve(squares, np.full(length, 1.0 / length), mode="valid") - noise_arcsec**2)
    outside = np.flatnonzero(swing > band**2)
    return float(time_s[outside[-1] + 1] - time_s[0]) if len(outside) else 0.0


def scatter_s(
    time_s: FloatArray, load_arcsec: FloatArray, noise_arcsec: float, band: float, noises: Sequence[float]
) -> float:
    """By how much two settling times of a load that moves so are apart, rms, for readings of these noises."""
    rng = np.random.default_rng(0)
    own = settling_s(time_s, load_arcsec, noise_arcsec, band)
    squares = 0.0
    for each in noises:
        for _ in range(DRAWS):
            noisy = load_arcsec + each * rng.standard_normal(len(load_arcsec))
            squares += (settling_s(time_s, noisy, float(np.hypot(noise_arcsec, each)), band) - own) ** 2
    return float(np.sqrt(squares / DRAWS))


def overshoot_arcsec(load_arcsec: FloatArray, way: float) -> float:
    """How far it goes beyond where it comes to rest; ``way`` is the sign of the motion before."""
    return max(0.0, float(np.max(way * (load_arcsec - _rest_arcsec(load_arcsec)))))


def _rest_arcsec(load_arcsec: FloatArray) -> float:
    return float(np.mean(load_arcsec[-max(SHORTEST_SWING, len(load_arcsec) // 4) :]))


# ----------------------------------------------------------------

Rows = NDArray[np.bool_]
ALL: Final = "all"
"""The kind that stands for the whole record."""
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
"""The command stands so long after a motion for the stop to count."""
SIGHT_S: Final = 1.0
"""How long after a stop settling is looked for, at most: servo axes of this kind settle in tenths of it."""
CALM_S: Final = 0.3
"""After so long at rest what a stop has excited is over, and what is left is noise."""
MOVING_DEG_S: Final = 0.05
"""Motor speed of the command above which it moves."""
LEAST_SAMPLES: Final = 8


@dataclass(frozen=True, slots=True)
class Row:
    """One figure of both records, of one kind of motion."""

    channel: str
    """A signal, `settling_time`, `overshoot`, or `noise_at_rest:` and `noise_in_motion:` with a signal."""
    kind: str
    """Kind of the legs, or `ALL`."""
    unit: str
    measured: float
    """Rms of a signal (the load error's about its mean); mean of a settling time or overshoot; a noise."""
    simulated: float
    difference: float
    """Rms of the difference, sample by sample or stop by stop; of a noise how far the two are apart."""
    noise: float
    """What two equal axes would differ by: the noise of the measured channel, or of the figure."""
    count: int
    """Samples, or stops."""

    @property
    def in_noise(self) -> float:
        """The difference in units of the noise; infinite where there is none."""
        return self.difference / self.noise if self.noise else math.inf if self.difference else 0.0

    @property
    def share(self) -> float:
        """The difference as a share of what was measured."""
        return self.difference / self.measured if self.measured else math.inf if self.difference else 0.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """How far two records are apart."""

    rows: tuple[Row, ...]
    traces: Mapping[str, Trace]
    """By signal."""
    spectra: Mapping[str, Spectrum]

    def row(self, channel: str, kind: str = ALL) -> Row | None:
        """The figure of a channel; None where the records do not have it."""
        return next((each for each in self.rows if (each.channel, each.kind) == (channel, kind)), None)

    def as_dict(self) -> dict[str, Any]:
        """The figures for machines."""
        return {
            "figures": [
                {
                    "channel": each.channel,
                    "kind": each.kind,
                    "unit": each.unit,
                    "measured": each.measured,
                    "simulated": each.simulated,
                    "difference": each.difference,
                    "noise": each.noise,
                    "count": each.count,
                }
                for each in self.rows
            ]
        }


@dataclass(frozen=True, eq=False)
class _Signals:
    """One record's signals, part by part; all of one length."""

    time_s: FloatArray
    command_deg: FloatArray
    load_arcsec: FloatArray
    """The load's reading."""
    by_name: Mapping[str, FloatArray]


def compare(measured: Record, simulated: Record, legs: Sequence[Segment], ratio: float) -> Comparison:
    """The figures, by kind of leg and over all, with traces and spectra.

    Both records have the same rows. What the two encoders' zeros are apart is taken off in each part of the
    measured record, and so is by what command and motor are apart wherever it rests: zeros, too. Rows where
    the load may still ring of what nobody knows are in no figure, nor is the torque of a motor that stands.
    InputError where the rows do not agree, or there is no command.
    """
    if len(measured) != len(simulated):
        raise InputError(
            f"{len(measured)} rows were measured and {len(simulated)} simulated; expected one for one"
        )
    if measured.motor_target_deg is None or simulated.motor_target_deg is None:
        raise InputError(
            f"{measured.source or 'the record'}: no column motor_target_deg; expected the command in each row"
        )
    ends = (*measured.starts[1:], len(measured))
    parts = [slice(start, end) for start, end in zip(measured.starts, ends, strict=True)]
    real, twin = _signals(measured, ratio, parts), _signals(simulated, ratio, parts)
    shared = [name for name in real.by_name if name in twin.by_name]
    for part in parts:
        offset = np.median(real.by_name[LOAD_ERROR][part] - twin.by_name[LOAD_ERROR][part])
        twin.by_name[LOAD_ERROR][part] += offset
    moves = _moving(real, parts)
    calm = ~moves & (_since_motion_s(real.time_s, moves, parts) > CALM_S)
    for part in parts:
        if np.count_nonzero(calm[part]) >= LEAST_SAMPLES:
            apart = real.by_name[FOLLOWING_ERROR][part] - twin.by_name[FOLLOWING_ERROR][part]
            twin.by_name[FOLLOWING_ERROR][part] += np.median(apart[calm[part]])
    motor = measured.motor_position_deg
    count_deg = _least(np.concatenate([np.diff(motor[part]) for part in parts]), motor)
    groups = _groups(measured.time_s, legs, ~unknown_rows(measured, count_deg))
    goes = ~_stands(measured, parts, count_deg)
    rows = [
        row
        for kind, inside in groups.items()
        for name in shared
        for compared in (inside & goes if name == MOTOR_TORQUE else inside,)
        for row in _of_signal(name, kind, compared, (inside & calm, inside & moves), real, twin, parts)
    ]
    stops = list(_stops(real, twin, parts))
    for kind, inside in groups.items():
        rows += _of_stops(kind, [stop for stop in stops if inside[stop.moved]], real.time_s)
    traces = {name: Trace(real.time_s, real.by_name[name], twin.by_name[name]) for name in shared}
    swings = (name for name in shared if name != TEMPERATURE)
    spectra = {name: found for name in swings if (found := spectrum_of(traces[name], parts)) is not None}
    return Comparison(tuple(rows), traces, spectra)


def _signals(record: Record, ratio: float, parts: Sequence[slice]) -> _Signals:
    command = record.motor_target_deg
    assert command is not None
    error = record.transmission_error_arcsec(ratio).copy()
    for part in parts:
        error[part] -= np.mean(error[part])
    by_name = {LOAD_ERROR: error, FOLLOWING_ERROR: command - record.motor_position_deg}
    for name, channel in ((MOTOR_TORQUE, Channel.MOTOR_TORQUE), (TEMPERATURE, Channel.TEMPERATURE)):
        column = record.columns.get(channel.value)
        if column is not None:
            by_name[name] = column
    return _Signals(record.time_s, command, record.load_position_deg * ARCSEC_PER_DEG, by_name)


def _groups(time_s: FloatArray, legs: Sequence[Segment], known: Rows) -> dict[str, Rows]:
    """Which of the known rows belong to each kind of leg; the whole record first."""
    groups = {ALL: known}
    for leg in legs:
        inside = groups.setdefault(leg.kind, np.zeros(len(time_s), dtype=np.bool_))
        inside |= known & (time_s >= leg.start_s) & (time_s <= leg.end_s)
    return {kind: inside for kind, inside in groups.items() if np.count_nonzero(inside) >= LEAST_SAMPLES}


def _moving(real: _Signals, parts: Sequence[slice]) -> Rows:
    """Whether the command moves."""
    moves = np.zeros(len(real.time_s), dtype=np.bool_)
    for part in parts:
        if part.stop - part.start > 1:
            step = np.maximum(np.diff(real.time_s[part]), 1e-9)
            speed = np.abs(np.diff(real.command_deg[part])) / step
            moves[part] = np.concatenate([speed[:1], speed]) > MOVING_DEG_S
    return moves


def _since_motion_s(time_s: FloatArray, moves: Rows, parts: Sequence[slice]) -> FloatArray:
    """How long the command has stood, in each part; endless before its first motion."""
    since = np.full(len(time_s), np.inf)
    for part in parts:
        rows = np.where(moves[part], np.arange(part.start, part.stop), -1)
        last = np.maximum.accumulate(rows)
        seen = np.flatnonzero(last >= 0)
        since[part.start + seen] = time_s[part.start + seen] - time_s[last[seen]]
    return since


def _of_signal(
    name: str,
    kind: str,
    inside: Rows,
    rest_and_motion: tuple[Rows, Rows],
    real: _Signals,
    twin: _Signals,
    parts: Sequence[slice],
) -> Iterator[Row]:
    one, other = real.by_name[name], twin.by_name[name]
    unit = UNITS[name]
    if count := int(np.count_nonzero(inside)):
        apart = _rms(one[inside] - other[inside])
        noise = noise_of(one, inside, parts)
        if name == TEMPERATURE:
            # A replay begins at a reading: its own rounding and that one's are a step together, at most. A
            # reading that stays the same says nothing of how long its step is.
            noise *= math.sqrt(12.0)
            if not noise:
                return
        yield Row(name, kind, unit, _rms(one[inside]), _rms(other[inside]), apart, noise, count)
    for channel, which in zip((NOISE_AT_REST, NOISE_IN_MOTION), rest_and_motion, strict=True):
        count = int(np.count_nonzero(which))
        if count < LEAST_SAMPLES or name == TEMPERATURE:
            continue
        theirs, ours = noise_of(one, which, parts), noise_of(other, which, parts)
        apart = abs(theirs - ours)
        yield Row(
            f"{channel}:{name}", kind, unit, theirs, ours, apart, theirs / math.sqrt(2.0 * count), count
        )


def noise_of(values: FloatArray, which: Rows, parts: Sequence[slice]) -> float:
    """Noise of a signal's samples, rms: what third differences leave, no less than its resolution allows.

    A motion that is smooth over four samples is not in it. A reading in steps of q is off by q / sqrt(12).
    """
    squares = count = 0.0
    resolution = math.inf
    for part in parts:
        third = np.diff(values[part], 3)
        inside = which[part]
        changes = np.diff(values[part])[inside[1:] & inside[:-1]]
        resolution = min(resolution, _least(changes, values))
        whole = inside[3:] & inside[2:-1] & inside[1:-2] & inside[:-3]
        squares += float(np.sum(third[whole] ** 2))
        count += float(np.count_nonzero(whole))
    spread = math.sqrt(squares / count / 20.0) if count else 0.0
    return max(spread, resolution / math.sqrt(12.0) if math.isfinite(resolution) else 0.0)


def _stands(measured: Record, parts: Sequence[slice], count_deg: float) -> Rows:
    """Whether the motor stands: by what torque hangs on a thousandth of a count."""
    target, motor = measured.motor_target_deg, measured.motor_position_deg
    assert target is not None
    still = [
        stands(
            np.diff(target[part], prepend=target[part.start]) != 0.0, motor[part], STANDS_COUNTS * count_deg
        )
        for part in parts
    ]
    return np.concatenate(still)


def _least(changes: FloatArray, values: FloatArray) -> float:
    """The least of a reading's changes, beyond what arithmetic leaves of none."""
    beyond, size = 1e-9 * float(np.max(np.abs(values), initial=1.0)), np.abs(changes)
    return float(np.min(size, where=size > beyond, initial=math.inf))


@dataclass(frozen=True, slots=True)
class _Stop:
    """One stop in both records."""

    moved: int
    """A row of the motion before it."""
    settled_s: tuple[float, float]
    overshoot_arcsec: tuple[float, float]
    noise_arcsec: float
    scatter_s: float
    """By how much the two settling times are apart by noise alone."""


def _stops(real: _Signals, twin: _Signals, parts: Sequence[slice]) -> Iterator[_Stop]:
    """Where the command comes to rest after a motion, and stays."""
    moves = _moving(real, parts)
    for part in parts:
        edges = np.flatnonzero(moves[part][:-1] & ~moves[part][1:]) + part.start + 1
        starts = np.flatnonzero(~moves[part][:-1] & moves[part][1:]) + part.start + 1
        for stop in edges.tolist():
            later = starts[starts > stop]
            end = int(later[0]) if len(later) else part.stop
            end = min(end, int(np.searchsorted(real.time_s, real.time_s[stop] + SIGHT_S)), part.stop)
            if end - stop < LEAST_SAMPLES or real.time_s[end - 1] - real.time_s[stop] < STAND_S:
                continue
            earlier = starts[starts < stop]
            began = int(earlier[-1]) if len(earlier) else part.start
            way = float(np.sign(real.command_deg[stop] - real.command_deg[began]))
            rest = np.zeros(len(real.time_s), dtype=np.bool_)
            rest[stop + (end - stop) // 2 : end] = True
            noises = [noise_of(each.load_arcsec, rest, [part]) for each in (real, twin)]
            loads = [each.load_arcsec[stop:end] for each in (real, twin)]
            times = real.time_s[stop:end]
            band = band_arcsec(noises[0])
            settled = [settling_s(times, *each, band) for each in zip(loads, noises, strict=True)]
            scatter = scatter_s(times, loads[1], noises[1], band, noises)
            beyond = [overshoot_arcsec(each, way) for each in loads]
            yield _Stop(stop - 1, (settled[0], settled[1]), (beyond[0], beyond[1]), noises[0], scatter)


def _of_stops(kind: str, stops: Sequence[_Stop], time_s: FloatArray) -> Iterator[Row]:
    if not stops:
        return
    sample_s = float(np.median(np.diff(time_s)))
    noise = _rms(np.array([each.noise_arcsec for each in stops]))
    scatter = _rms(np.array([each.scatter_s for each in stops]))
    for channel, pairs, own in (
        (SETTLING_TIME, [each.settled_s for each in stops], max(sample_s, scatter)),
        (OVERSHOOT, [each.overshoot_arcsec for each in stops], noise),
    ):
        values = np.array(pairs)
        one, other = (float(each) for each in np.mean(values, axis=0))
        yield Row(
            channel, kind, UNITS[channel], one, other, _rms(values[:, 0] - values[:, 1]), own, len(pairs)
        )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
